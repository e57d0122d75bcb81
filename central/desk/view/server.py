"""Serve a log: page with a WebSocket stream of frames, and Foxglove's WebSocket.

Pages of another origin or host name (DNS rebinding) are refused. Foxglove's SDK accepts any origin,
so its server listens at a random loopback address and port behind a proxy.
"""

import asyncio
import errno
import logging
import os
import socket
import threading
from collections.abc import Collection, Iterator
from contextlib import AsyncExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from http import HTTPStatus
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from websockets.asyncio.client import ClientConnection, connect
from websockets.asyncio.server import Server, ServerConnection, serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response
from websockets.typing import Subprotocol

from teamslam.central.desk.view.export import VIEWED, Viewing
from teamslam.central.desk.view.page_frames import CHANNELS, PageFrames
from teamslam.team.recording.reader import LogError, Tail
from teamslam.team.wire.bus import BusError

if TYPE_CHECKING:
    from teamslam.central.desk.view.foxglove_server import FoxgloveServer

LOOPBACK = ("127.0.0.1", "localhost", "::1")
VIEWERS = (*LOOPBACK, "https://app.foxglove.dev", "file://")
"""Origins of viewers: this machine's hosts and Foxglove."""
PROTOCOLS = tuple(map(Subprotocol, ("foxglove.sdk.v1", "foxglove.websocket.v1")))
STREAM = "/stream"
LOOK_S = 0.2  # polling period [s] of a growing log
_BATCH_BYTES = 500_000
_TYPES = {
    ".html": "text/html",
    ".js": "text/javascript",
    ".css": "text/css",
    ".svg": "image/svg+xml",
}
_HEADERS = {
    "Content-Security-Policy": (
        "default-src 'self'; connect-src 'self' ws: wss:; style-src 'self' 'unsafe-inline'"
    ),
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
    "Connection": "close",
}


class ServerError(BusError):
    """The page cannot be served at this address."""


def page_files() -> dict[str, tuple[str, bytes]]:
    """Type and bytes of every page file by path."""
    folder = files("teamslam.central.desk.view").joinpath("page").iterdir()
    of = ((file, _TYPES.get(Path(file.name).suffix)) for file in folder)
    found = {f"/{file.name}": (kind, file.read_bytes()) for file, kind in of if kind is not None}
    return found | {"/": found["/index.html"]}


@dataclass
class Feed:
    """Read a growing log and store its frames.

    foxglove: receives every view once, in order. error: why reading ended early.
    """

    tail: Tail
    foxglove: "FoxgloveServer | None" = None
    frames: list[str] = field(default_factory=list)
    error: str | None = None
    ended: bool = False
    _page: PageFrames = field(default_factory=PageFrames)
    _viewing: Viewing = field(default_factory=Viewing)
    _greeted: bool = False

    def read_more(self, *, growing: bool) -> bool:
        """Read new samples; return whether there were any."""
        try:
            samples = self.tail.more()
        except (LogError, OSError) as error:
            self.error, samples, growing = str(error), [], False
        if self.tail.log is not None and not self._greeted:
            self._greeted = True
            log = self.tail.log
            if self.foxglove is not None:
                self.foxglove.team = log.team
            self._page.hello(log.team, log.metadata, self.tail.path.name, live=growing)
        for sample in samples:
            self._page.count(sample)
            for each, channel, message in self._viewing.inputs([sample], CHANNELS):
                self._page.take(channel, message)
                views = self._viewing.draw(each, channel, message) if channel in VIEWED else []
                for view in views:
                    if self.foxglove is not None:
                        self.foxglove.publish(view)
        if samples:
            self.frames += self._page.flush(self._viewing.node.now_ns)
        elif self.tail.ended or not growing:
            self.frames += self._page.end(self._faults())
            self.ended = True
        return bool(samples)

    def _faults(self) -> list[str]:
        faults = [] if self.error is None else [self.error]
        if self.tail.damaged:
            faults.append(
                f"{self.tail.damaged} damaged parts of the log were left out; `teamslam log check` "
                "names them"
            )
        return faults


def refusal(
    listening_at: str, host: str, origins: list[str], others: Collection[str] = ()
) -> str | None:
    """Reason to refuse a request for `host` from these origins, or None.

    listening_at: own address; a loopback request under another name is refused. others: further
    permitted origins or hosts.
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


def _refuse(
    listening_at: str, viewer: ServerConnection, request: Request, others: Collection[str] = ()
) -> Response | None:
    hosts, origins = (request.headers.get_all(name) for name in ("Host", "Origin"))
    why = refusal(listening_at, hosts[0] if hosts else "", origins, others)
    return None if why is None else viewer.respond(HTTPStatus.FORBIDDEN, why)


async def _proxy(host: str, port: int, behind: str) -> Server:
    return await serve(
        lambda viewer: _forward(viewer, behind), host, port,
        process_request=lambda viewer, request: _refuse(host, viewer, request, VIEWERS),
        subprotocols=PROTOCOLS, compression=None, max_size=None,
    )  # fmt: skip


async def _forward(viewer: ServerConnection, behind: str) -> None:
    chosen = PROTOCOLS if viewer.subprotocol is None else (viewer.subprotocol,)
    async with connect(behind, subprotocols=chosen, compression=None, max_size=None) as server:
        ways = [asyncio.ensure_future(_pump(*way)) for way in ((viewer, server), (server, viewer))]
        await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
        for way in ways:
            way.cancel()
    await viewer.close()


async def _pump(
    source: ServerConnection | ClientConnection, sink: ServerConnection | ClientConnection
) -> None:
    with suppress(ConnectionClosed):
        async for frame in source:
            await sink.send(frame)


class _PageServer:
    def __init__(self, feed: Feed, host: str, *, growing: bool) -> None:
        self._feed = feed
        self._host = host
        self._growing = growing
        self._files = page_files()
        self._frame_ready = asyncio.Condition()

    async def start(self, port: int) -> Server:
        return await serve(
            self._stream, self._host, port, process_request=self._answer, compression=None,
            max_size=1024,
        )  # fmt: skip

    async def read(self, stop: asyncio.Event) -> None:
        while not (self._feed.ended or stop.is_set()):
            some = await asyncio.to_thread(self._feed.read_more, growing=self._growing)
            async with self._frame_ready:
                self._frame_ready.notify_all()
            if not some:
                await asyncio.sleep(LOOK_S)

    def _answer(self, connection: ServerConnection, request: Request) -> Response | None:
        refused = _refuse(self._host, connection, request)
        path = urlsplit(request.path).path
        if refused is not None or path == STREAM:
            return refused
        if path not in self._files:
            return connection.respond(HTTPStatus.NOT_FOUND, "no such file\n")
        kind, body = self._files[path]
        of_file = {"Content-Type": f"{kind}; charset=utf-8", "Content-Length": str(len(body))}
        return Response(HTTPStatus.OK, "OK", Headers(of_file | _HEADERS), body)

    async def _stream(self, connection: ServerConnection) -> None:
        sent = 0
        frames = self._feed.frames
        with suppress(ConnectionClosed):
            while True:
                while sent < len(frames):
                    batch, size = [], 0
                    while sent < len(frames) and size < _BATCH_BYTES:
                        batch.append(frames[sent])
                        size += len(frames[sent])
                        sent += 1
                    await connection.send(f"[{','.join(batch)}]")
                async with self._frame_ready:
                    if sent == len(frames):
                        try:
                            await asyncio.wait_for(self._frame_ready.wait(), 5.0)
                        except TimeoutError:  # detects a closed page
                            await connection.ping()


@dataclass(frozen=True)
class Shown:
    """Addresses of a shown log; foxglove: may be empty."""

    url: str
    foxglove: str
    feed: Feed


@contextmanager
def session(
    log: Path, host: str, port: int, foxglove_port: int | None, *, growing: bool
) -> Iterator[Shown]:
    """Show a log until the context ends; raises ServerError for a taken port.

    foxglove_port: None: only the page. growing: the recorder may still run.
    """
    # The library logs every connection otherwise.
    logging.getLogger("websockets").setLevel(logging.WARNING)
    if foxglove_port is None:
        with serving(Feed(Tail(log)), host, port, growing=growing) as shown:
            yield shown
        return
    from teamslam.central.desk.view.foxglove_server import FoxgloveServer

    with (
        FoxgloveServer() as foxglove,
        serving(Feed(Tail(log), foxglove), host, port, foxglove_port, growing=growing) as shown,
    ):
        yield shown


@contextmanager
def serving(
    feed: Feed, host: str, port: int, foxglove_port: int = 0, *, growing: bool
) -> Iterator[Shown]:
    """Serve page and Foxglove on a thread. Raises ServerError."""
    runner, stop = asyncio.Runner(), asyncio.Event()
    page = _PageServer(feed, host, growing=growing)
    at = f"[{host}]" if ":" in host else host
    servers: list[Server] = []

    async def serve_all() -> None:
        async with AsyncExitStack() as listening:
            for server in servers:
                await listening.enter_async_context(server)
            await asyncio.gather(page.read(stop), stop.wait())

    def run() -> None:
        with runner:
            runner.run(serve_all())

    thread = threading.Thread(target=run, name="page", daemon=True)
    try:
        servers.append(runner.run(page.start(port)))
        url, foxglove_url = f"http://{at}:{_port_of(servers[0])}/", ""
        if feed.foxglove is not None:
            servers.append(runner.run(_proxy(host, foxglove_port, feed.foxglove.url)))
            foxglove_url = f"ws://{at}:{_port_of(servers[1])}"
    except OSError as error:
        stop.set()  # close a server that already listens
        run()
        if isinstance(error, socket.gaierror) or error.errno == errno.EADDRNOTAVAIL:
            raise ServerError(
                f"--host {host}: {_reason(error)}; give an address of this machine"
            ) from error
        what, number, option = "the page", port, "--port"
        if servers:
            what, number, option = "Foxglove", foxglove_port, "--foxglove-port"
        raise ServerError(
            f"can not serve {what} at {host}:{number}: {_reason(error)}; choose another {option}, "
            "0 for any free one"
        ) from error
    loop = runner.get_loop()
    thread.start()
    try:
        yield Shown(url, foxglove_url, feed)
    finally:
        loop.call_soon_threadsafe(stop.set)
        thread.join(5.0)


def free_port(host: str, port: int) -> int:
    """Return `port`, or 0 (any free one) if it is taken."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        socket.create_server((host, port), family=family).close()
    except OSError as error:
        return 0 if error.errno == errno.EADDRINUSE else port
    return port


def _reason(error: OSError) -> str:
    number = error.errno or 0
    return os.strerror(number) if number > 0 else error.strerror or str(error)


def _port_of(server: Server) -> int:
    return int(next(iter(server.sockets)).getsockname()[1])
