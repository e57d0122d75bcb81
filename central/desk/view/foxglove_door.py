"""Controls access to Foxglove's WebSocket: viewers of this machine, no page of a foreign origin.

The SDK's server accepts any origin, so it listens at a random address of loopback and a random
port. Viewers connect to this proxy: it checks Host and Origin as the page's server does, then
forwards every frame in both directions.
"""

import asyncio
import secrets
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http import HTTPStatus
from urllib.parse import urlsplit

from websockets.asyncio.client import ClientConnection, connect
from websockets.asyncio.server import ServerConnection, serve
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response
from websockets.typing import Subprotocol

LOOPBACK = ("127.0.0.1", "localhost", "::1")
VIEWERS = ("https://app.foxglove.dev", "file://")
"""Origins of viewers beside this machine's own: Foxglove in a browser, and on a desktop."""
PROTOCOLS = tuple(map(Subprotocol, ("foxglove.sdk.v1", "foxglove.websocket.v1")))


def hidden_host() -> str:
    """An address of loopback that no page can guess; where there is only one, that."""
    host = f"127.{secrets.randbelow(254) + 1}.{secrets.randbelow(256)}.{secrets.randbelow(254) + 1}"
    try:
        socket.create_server((host, 0)).close()
    except OSError:
        return LOOPBACK[0]
    return host


def refusal(listening_at: str, host: str, origins: list[str]) -> str | None:
    """Why a request for `host` from a page of these origins is refused; None: it is not.

    listening_at: our own address; on loopback a request under another name is refused (DNS
    rebinding).
    """
    if listening_at in LOOPBACK and _name(host) not in LOOPBACK:
        return f"{host!r} is not this machine\n"
    if len(origins) > 1:
        return "two origins\n"
    for origin in origins:
        at = urlsplit(origin)
        own = (host and at.netloc == host) or (at.hostname or "") in LOOPBACK
        if not (own or origin in VIEWERS):
            return f"{origin!r} is another page's origin\n"
    return None


def _name(host: str) -> str:
    return urlsplit(f"//{host}").hostname or ""


@contextmanager
def door(host: str, port: int, behind: str) -> Iterator[int]:
    """Listen, on a thread, for viewers of the server at `behind`; yields the port. Raises
    OSError.
    """
    loop = asyncio.new_event_loop()
    outcome: list[tuple[int, asyncio.Event] | BaseException] = []
    ready = threading.Event()

    async def main() -> None:
        stop = asyncio.Event()
        try:
            server = await serve(
                lambda viewer: _handed_on(viewer, behind),
                host,
                port,
                process_request=lambda viewer, request: _answer(host, viewer, request),
                subprotocols=PROTOCOLS,
                compression=None,
                max_size=None,
            )
        except OSError as error:
            outcome.append(error)
            ready.set()
            return
        async with server:
            outcome.append((int(next(iter(server.sockets)).getsockname()[1]), stop))
            ready.set()
            await stop.wait()

    thread = threading.Thread(
        target=lambda: loop.run_until_complete(main()), name="foxglove door", daemon=True
    )
    thread.start()
    ready.wait()
    (found,) = outcome
    if isinstance(found, BaseException):
        thread.join()
        loop.close()
        raise found
    try:
        yield found[0]
    finally:
        loop.call_soon_threadsafe(found[1].set)
        thread.join()
        loop.close()


def _answer(listening_at: str, viewer: ServerConnection, request: Request) -> Response | None:
    hosts = request.headers.get_all("Host")
    why = refusal(listening_at, hosts[0] if hosts else "", request.headers.get_all("Origin"))
    return None if why is None else viewer.respond(HTTPStatus.FORBIDDEN, why)


async def _handed_on(viewer: ServerConnection, behind: str) -> None:
    chosen = PROTOCOLS if viewer.subprotocol is None else (viewer.subprotocol,)
    async with connect(behind, subprotocols=chosen, compression=None, max_size=None) as server:
        ways = [
            asyncio.ensure_future(_pour(*each)) for each in ((viewer, server), (server, viewer))
        ]
        await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
        for way in ways:
            way.cancel()
    await viewer.close()


async def _pour(
    source: ServerConnection | ClientConnection, sink: ServerConnection | ClientConnection
) -> None:
    try:
        async for frame in source:
            await sink.send(frame)
    except ConnectionClosed:
        pass
