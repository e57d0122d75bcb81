"""Finds out why a link to a router fails: Zenoh reports nothing but a timeout.

One TLS handshake by the standard library, beside Zenoh, distinguishes the cases: no server listens;
the router refuses our certificate, or we its; one side speaks TLS and the other does not.
"""

import re
import socket
import ssl
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from team.keys.credentials import Credentials

TIMEOUT_S = 1.0
"""Timeout [s] of each step; a router on a busy machine that takes longer is tried again."""
_ENDPOINT = re.compile(r"(?P<protocol>\w+)/(?P<host>\[[^]]+\]|[^:/?#]+):(?P<port>\d+)")
_ALERTS = {
    "UNKNOWN_CA": "it is of another authority than the router's: copy ca.pem and both files of "
    "this node from one folder",
    "CERTIFICATE_EXPIRED": "it has expired by the router's clock: renew it, or put the clock right",
    "CERTIFICATE_REQUIRED": "it wants one: give --keys DIR",
    "CERTIFICATE_UNKNOWN": "it does not take it for one of its team",
    "BAD_CERTIFICATE": "it does not take it for one of its team",
    "DECRYPT_ERROR": "it is of another authority than the router's, of the same name",
}


def why_refused(connect: str, keys: "Credentials | None") -> str | None:
    """The reason in words, with the remedy; None: no server listens there, or TLS is not the
    reason.
    """
    at = _ENDPOINT.match(connect)
    if at is None:
        return None
    host, port = at["host"].strip("[]"), int(at["port"])
    try:
        link = socket.create_connection((host, port), TIMEOUT_S)
    except OSError:
        return None
    with link:
        return _without_keys(link, connect) if keys is None else _with(link, host, connect, keys)


def router_ends(connect: str, keys: "Credentials") -> float | None:
    """When the router's certificate expires [s since 1970]; None where that can not be read now."""
    at = _ENDPOINT.match(connect)
    if at is None:
        return None
    host, port = at["host"].strip("[]"), int(at["port"])
    try:
        with (
            socket.create_connection((host, port), TIMEOUT_S) as link,
            keys.context().wrap_socket(link, server_hostname=host) as tls,
        ):
            shown = tls.getpeercert()
    except OSError:
        return None
    ends = None if shown is None else shown.get("notAfter")
    return ssl.cert_time_to_seconds(ends) if isinstance(ends, str) else None


def _with(link: socket.socket, host: str, connect: str, keys: "Credentials") -> str | None:
    try:
        context = keys.context()
    except OSError as error:
        return f"{keys.certificate} or its key can not be read any more: {error.strerror or error}"
    try:
        tls = context.wrap_socket(link, server_hostname=host)
    except ssl.SSLCertVerificationError as error:
        return (
            f"{connect}: the router's certificate is not good: {error.verify_message}. If the host "
            "is not in it: `teamslam keys TEAM -o DIR --router HOST`; if it is of another "
            f"authority than {keys.authority}: copy both from one folder"
        )
    except ssl.SSLError as error:
        return _alerted(error, connect, keys)
    except OSError as error:
        return f"{connect}: what listens there speaks no TLS ({error}): a router without --keys?"
    with tls:
        try:  # TLS 1.3: what the router says of our certificate comes after the handshake
            tls.recv(1)
        except ssl.SSLError as error:
            return _alerted(error, connect, keys)
        except OSError:
            return None
    return None


def _alerted(error: ssl.SSLError, connect: str, keys: "Credentials") -> str:
    reason = error.reason or str(error)
    for alert, meaning in _ALERTS.items():
        if alert in reason:
            return f"{connect}: the router refuses {keys.certificate}: {meaning}"
    return f"{connect}: what listens there speaks no TLS ({reason}): a router without --keys?"


def _without_keys(link: socket.socket, connect: str) -> str | None:
    """Whether it is a router with keys, which answers a greeting in TLS."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname = False
    context.verify_mode = ssl.CERT_NONE
    try:
        with context.wrap_socket(link):
            pass
    except OSError:
        return None
    return f"{connect}: the router there has keys and refuses whoever has none: give --keys DIR"
