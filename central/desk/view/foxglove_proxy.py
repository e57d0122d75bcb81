"""Restrict the page and Foxglove's WebSocket to viewers of this machine and permitted origins.

The SDK's server accepts any origin, so it listens at a random loopback address and port behind this
proxy, which checks Host and Origin.
"""

import asyncio
import secrets
import socket
from collections.abc import Collection
from http import HTTPStatus
from urllib.parse import urlsplit

from websockets.asyncio.client import ClientConnection, connect
from websockets.asyncio.server import Server, ServerConnection, serve
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response
from websockets.typing import Subprotocol

LOOPBACK = ("127.0.0.1", "localhost", "::1")
VIEWERS = (*LOOPBACK, "https://app.foxglove.dev", "file://")
"""Origins of viewers: this machine's hosts and Foxglove."""
PROTOCOLS = tuple(map(Subprotocol, ("foxglove.sdk.v1", "foxglove.websocket.v1")))


def hidden_host() -> str:
    """Loopback address that no page can guess."""
    host = f"127.{secrets.randbelow(254) + 1}.{secrets.randbelow(256)}.{secrets.randbelow(254) + 1}"
    try:
        socket.create_server((host, 0)).close()
    except OSError:
        return LOOPBACK[0]
    return host


def refusal(
    listening_at: str, host: str, origins: list[str], others: Collection[str] = ()
) -> str | None:
    """Reason to refuse a request for `host` from these origins, or None.

    listening_at: own address; a loopback request under another name is refused (DNS rebinding).
    others: further permitted origins or hosts.
    """
    if listening_at in LOOPBACK and (urlsplit(f"//{host}").hostname or "") not in LOOPBACK:
        return f"{host!r} is not this machine\n"
    if len(origins) > 1:
        return "two origins\n"
    for origin in origins:
        at = urlsplit(origin)
        if not ((host and at.netloc == host) or at.hostname in others or origin in others):
            return f"{origin!r} is another page's origin\n"
    return None


def refuse(
    listening_at: str, viewer: ServerConnection, request: Request, others: Collection[str] = ()
) -> Response | None:
    """Response to a refused request; None if permitted."""
    hosts = request.headers.get_all("Host")
    why = refusal(
        listening_at, hosts[0] if hosts else "", request.headers.get_all("Origin"), others
    )
    return None if why is None else viewer.respond(HTTPStatus.FORBIDDEN, why)


async def proxy(host: str, port: int, behind: str) -> Server:
    """Listen for viewers of the SDK's server at `behind`. Raises OSError."""
    return await serve(
        lambda viewer: _forward(viewer, behind),
        host,
        port,
        process_request=lambda viewer, request: refuse(host, viewer, request, VIEWERS),
        subprotocols=PROTOCOLS,
        compression=None,
        max_size=None,
    )


async def _forward(viewer: ServerConnection, behind: str) -> None:
    chosen = PROTOCOLS if viewer.subprotocol is None else (viewer.subprotocol,)
    async with connect(behind, subprotocols=chosen, compression=None, max_size=None) as server:
        ways = [
            asyncio.ensure_future(_pump(*each)) for each in ((viewer, server), (server, viewer))
        ]
        await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
        for way in ways:
            way.cancel()
    await viewer.close()


async def _pump(
    source: ServerConnection | ClientConnection, sink: ServerConnection | ClientConnection
) -> None:
    try:
        async for frame in source:
            await sink.send(frame)
    except ConnectionClosed:
        pass
