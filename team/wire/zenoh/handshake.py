"""Diagnose a failing link to a router, for which Zenoh reports only a timeout.

Only evidence in one TLS handshake refuses a link: an alert about our certificate, a router
certificate that fails verification, an answer that is not TLS. A timeout or a network error is a
reason to wait.
"""

import re
import socket
import ssl
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from teamslam.team.keys.credentials import Credentials

TIMEOUT_S = 1.0  # timeout [s] of each step of a handshake
_ENDPOINT = re.compile(r"(?P<protocol>\w+)/(?P<host>\[[^]]+\]|[^:/?#]+):(?P<port>\d+)")
_ALERTS = {
    "UNKNOWN_CA": "it is of another authority than the router's: copy ca.pem and both files of "
    "this node from one folder",
    "CERTIFICATE_EXPIRED": "it has expired by the router's clock: renew it, or put the clock right",
    "CERTIFICATE_REQUIRED": "it requires one: give --keys DIR",
    "CERTIFICATE_UNKNOWN": "it is not one of its team",
    "BAD_CERTIFICATE": "it is not one of its team",
    "DECRYPT_ERROR": "it is of another authority than the router's, of the same name",
}
_NOT_TLS = ("WRONG_VERSION_NUMBER", "PACKET_LENGTH_TOO_LONG", "UNKNOWN_PROTOCOL", "HTTP_REQUEST")
"""OpenSSL's reasons for an answer that is not TLS."""


@dataclass(frozen=True)
class Examined:
    """Result of one handshake.

    refused: why there can be no link, with the remedy. waits_for: why there is no link yet; empty
    after success. router_ends: expiry of the router's certificate [s since 1970]. accepts:
    connections are accepted, though perhaps not answered.
    """

    refused: str | None = None
    waits_for: str = ""
    router_ends: float | None = None
    accepts: bool = False


def examine(connect: str, keys: "Credentials | None", timeout_s: float = TIMEOUT_S) -> Examined:
    """Make one handshake with the router; takes at most three times `timeout_s`."""
    at = _ENDPOINT.match(connect)
    if at is None:
        return Examined()
    host, port = at["host"].strip("[]"), int(at["port"])
    try:
        link = socket.create_connection((host, port), timeout_s)
    except TimeoutError:
        return Examined(waits_for="no answer")
    except ConnectionRefusedError:
        return Examined(waits_for="nothing listens there")
    except OSError as error:
        return Examined(waits_for=error.strerror or str(error))
    with link:
        if keys is None:
            return replace(_examine_plain(link, connect), accepts=True)
        return replace(_examine_tls(link, host, connect, keys), accepts=True)


def _examine_tls(link: socket.socket, host: str, connect: str, keys: "Credentials") -> Examined:
    try:
        context = keys.context()
    except OSError as error:  # as while a renewed pair is copied
        reason = error.strerror or str(error)
        return Examined(waits_for=f"{keys.certificate} or its key can not be read: {reason}")
    try:
        tls = context.wrap_socket(link, server_hostname=host)
    except ssl.SSLCertVerificationError as error:
        return Examined(
            f"{connect}: the router's certificate is invalid: {error.verify_message}. If the host "
            "is not in it: `teamslam keys TEAM -o DIR --router HOST`; if it is of another "
            f"authority than {keys.authority}: copy both from one folder"
        )
    except OSError as error:
        return _explain_failure(error, connect, keys)
    with tls:
        ends = (tls.getpeercert() or {}).get("notAfter")
        router_ends = ssl.cert_time_to_seconds(ends) if isinstance(ends, str) else None
        try:  # TLS 1.3: the router's answer to our certificate comes after the handshake
            tls.recv(1)
        except TimeoutError:
            pass
        except OSError as error:
            return _explain_failure(error, connect, keys)
    return Examined(router_ends=router_ends)


def _explain_failure(error: OSError, connect: str, keys: "Credentials") -> Examined:
    if isinstance(error, TimeoutError):
        return Examined(waits_for="connections are accepted, TLS is not answered")
    reason = (error.reason if isinstance(error, ssl.SSLError) else error.strerror) or str(error)
    for alert, meaning in _ALERTS.items():
        if "ALERT" in reason and alert in reason:
            return Examined(f"{connect}: the router refuses {keys.certificate}: {meaning}")
    if reason in _NOT_TLS:
        return Examined(
            f"{connect}: the answer there is not TLS ({reason}): is it a router without --keys?"
        )
    return Examined(waits_for=f"the TLS handshake was broken off ({reason})")


def _examine_plain(link: socket.socket, connect: str) -> Examined:
    """Test for a router with keys, which answers a greeting in TLS."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname = False
    context.verify_mode = ssl.CERT_NONE
    try:
        with context.wrap_socket(link):
            pass
    except OSError:
        return Examined(waits_for="connections are accepted and not answered")
    return Examined(f"{connect}: the router there requires keys: give --keys DIR")
