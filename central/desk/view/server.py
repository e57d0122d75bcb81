"""Serve a log: page with a WebSocket stream of frames, and Foxglove's WebSocket.

A new connection receives every frame of the log, then new ones. Pages of another origin or host
name (DNS rebinding) are refused.
"""

import asyncio
import errno
import logging
import os
import socket
import threading
from collections.abc import Iterator
from contextlib import AsyncExitStack, contextmanager, nullcontext
from dataclasses import dataclass, field
from http import HTTPStatus
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from websockets.asyncio.server import Server, ServerConnection, serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from teamslam.central.desk.peers_as_centre import PeersAsCentre, with_centre_messages
from teamslam.central.desk.view.export import VIEWED, Viewing, for_viewer
from teamslam.central.desk.view.foxglove_proxy import proxy, refuse
from teamslam.central.desk.view.page_frames import CHANNELS, PageFrames
from teamslam.team.recording.reader import LogError
from teamslam.team.recording.tail import Tail
from teamslam.team.wire.bus import BusError, Sample

if TYPE_CHECKING:
    from teamslam.central.desk.view.foxglove_server import FoxgloveServer

STREAM = "/stream"
LOOK_S = 0.2
"""Polling period [s] of a growing log."""
_BATCH_BYTES = 500_000
_TYPES = {
    ".html": "text/html",
    ".js": "text/javascript",
    ".css": "text/css",
    ".svg": "image/svg+xml",
}
_POLICY = "default-src 'self'; connect-src 'self' ws: wss:; style-src 'self' 'unsafe-inline'"


class ServerError(BusError):
    """The page cannot be served at this address."""


def page_files() -> dict[str, tuple[str, bytes]]:
    """Type and bytes of every page file by path."""
    found = {}
    for file in files("teamslam.central.desk.view").joinpath("page").iterdir():
        suffix = Path(file.name).suffix
        if suffix in _TYPES:
            found[f"/{file.name}"] = (_TYPES[suffix], file.read_bytes())
    found["/"] = found["/index.html"]
    return found


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
    _centre: PeersAsCentre = field(default_factory=PeersAsCentre)
    _greeted: bool = False

    def read_more(self, *, growing: bool) -> bool:
        """Read new samples; return whether there were any. A finished log ends here."""
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
            for each in with_centre_messages(self._centre, [sample]):
                self._take(each)
        if samples:
            self.frames += self._page.flush(self._viewing.node.now_ns)
        elif self.tail.ended or not growing:
            self.frames += self._page.end(self._faults(), complete=True)
            self.ended = True
        return bool(samples)

    def _take(self, sample: Sample) -> None:
        input_ = for_viewer(sample, CHANNELS)
        if input_ is None:
            return
        self._page.take(*input_)
        if input_[0].name in VIEWED:
            for view in self._viewing.take(sample, input_):
                if self.foxglove is not None:
                    self.foxglove.publish(view)

    def _faults(self) -> list[str]:
        found = [] if self.error is None else [self.error]
        if self.tail.damaged:
            found.append(
                f"{self.tail.damaged} damaged parts of the log were left out; "
                "`teamslam log check` names them"
            )
        return found


class PageServer:
    """Server of one page in its own event loop."""

    def __init__(self, feed: Feed, host: str, *, growing: bool) -> None:
        self._feed = feed
        self._host = host
        self._growing = growing
        self._files = page_files()
        self._frame_ready = asyncio.Condition()

    async def start(self, port: int) -> Server:
        """Listen. Raises OSError."""
        return await serve(
            self._stream,
            self._host,
            port,
            process_request=self._answer,
            compression=None,
            max_size=1024,
        )

    async def read(self, stop: asyncio.Event) -> None:
        """Read the log until its end or `stop`."""
        while not (self._feed.ended or stop.is_set()):
            some = await asyncio.to_thread(self._feed.read_more, growing=self._growing)
            async with self._frame_ready:
                self._frame_ready.notify_all()
            if not some:
                await asyncio.sleep(LOOK_S)

    def _answer(self, connection: ServerConnection, request: Request) -> Response | None:
        refused = refuse(self._host, connection, request)
        path = urlsplit(request.path).path
        if refused is not None or path == STREAM:
            return refused
        if path not in self._files:
            return connection.respond(HTTPStatus.NOT_FOUND, "no such file\n")
        kind, body = self._files[path]
        headers = Headers(
            {
                "Content-Type": f"{kind}; charset=utf-8",
                "Content-Length": str(len(body)),
                "Content-Security-Policy": _POLICY,
                "X-Content-Type-Options": "nosniff",
                "Cache-Control": "no-store",
                "Connection": "close",
            }
        )
        return Response(HTTPStatus.OK, "OK", headers, body)

    async def _stream(self, connection: ServerConnection) -> None:
        sent = 0
        frames = self._feed.frames
        try:
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
                        await self._wait(connection)
        except ConnectionClosed:
            pass

    async def _wait(self, connection: ServerConnection) -> None:
        """Wait for news or a timeout, and detect a closed page."""
        try:
            await asyncio.wait_for(self._frame_ready.wait(), 5.0)
        except TimeoutError:
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
    with nullcontext() if foxglove_port is None else _foxglove_server() as foxglove:
        feed = Feed(Tail(log), foxglove)
        with serving(feed, host, port, foxglove_port or 0, growing=growing) as shown:
            yield shown


def _foxglove_server() -> "FoxgloveServer":
    from teamslam.central.desk.view.foxglove_server import FoxgloveServer

    return FoxgloveServer()


@contextmanager
def serving(
    feed: Feed, host: str, port: int, foxglove_port: int = 0, *, growing: bool
) -> Iterator[Shown]:
    """Serve page and Foxglove on a thread. Raises ServerError."""
    runner, stop = asyncio.Runner(), asyncio.Event()
    page = PageServer(feed, host, growing=growing)
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
            servers.append(runner.run(proxy(host, foxglove_port, feed.foxglove.url)))
            foxglove_url = f"ws://{at}:{_port_of(servers[1])}"
    except OSError as error:
        stop.set()  # close a server that already listens
        run()
        if isinstance(error, socket.gaierror) or error.errno == errno.EADDRNOTAVAIL:
            raise ServerError(
                f"--host {host}: {_reason(error)}; give an address of this machine"
            ) from error
        what, number, option = (
            ("Foxglove", foxglove_port, "--foxglove-port")
            if servers
            else ("the page", port, "--port")
        )
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
    try:
        socket.create_server((host, port), family=_family(host)).close()
    except OSError as error:
        return 0 if error.errno == errno.EADDRINUSE else port
    return port


def _family(host: str) -> socket.AddressFamily:
    return socket.AF_INET6 if ":" in host else socket.AF_INET


def _reason(error: OSError) -> str:
    """The system's text for an error; asyncio's repeats the address."""
    number = error.errno or 0
    return os.strerror(number) if number > 0 else error.strerror or str(error)


def _port_of(server: Server) -> int:
    return int(next(iter(server.sockets)).getsockname()[1])
