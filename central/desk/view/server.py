"""The page's server: files and one stream of frames over a WebSocket, for this machine alone.

A new connection gets every frame of the log from the first on, then the new ones. A page of another
origin may not connect, nor one that uses another name for this machine (DNS rebinding).
"""

import asyncio
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http import HTTPStatus
from importlib.resources import files
from pathlib import Path
from typing import Protocol, runtime_checkable
from urllib.parse import urlsplit

from websockets.asyncio.server import Server, ServerConnection, serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from central.desk.view.export import Viewing, for_viewer
from central.desk.view.page_frames import PageFrames
from team.recording.reader import LogError
from team.recording.tail import Tail
from team.wire.bus import BusError, Sample

STREAM = "/stream"
LOOK_S = 0.2
"""Time [s] between two looks at a log that is being written."""
_BATCH_BYTES = 500_000
_TYPES = {
    ".html": "text/html",
    ".js": "text/javascript",
    ".css": "text/css",
    ".svg": "image/svg+xml",
}
_POLICY = "default-src 'self'; connect-src 'self' ws: wss:; style-src 'self' 'unsafe-inline'"
_LOOPBACK = ("127.0.0.1", "localhost", "[::1]")


class ServerError(BusError):
    """The page can not be served at this address."""


def page_files() -> dict[str, tuple[str, bytes]]:
    """(type, bytes) of every file of the page by its path."""
    found = {}
    for file in files("central.desk.view").joinpath("page").iterdir():
        suffix = Path(file.name).suffix
        if suffix in _TYPES:
            found[f"/{file.name}"] = (_TYPES[suffix], file.read_bytes())
    found["/"] = found["/index.html"]
    return found


@runtime_checkable
class Audience(Protocol):
    """Receives the views of a log as they are made."""

    def begin(self, team: str) -> None:
        """Receive the team's name."""

    def say(self, view: Sample) -> None:
        """Receive one view."""

    def end(self) -> None:
        """There are no more views."""


@dataclass
class Feed:
    """Reads a log as it grows, and stores the frames of it.

    audience: receives every view, once, in order. error: why reading ended early.
    """

    tail: Tail
    audience: Audience | None = None
    frames: list[str] = field(default_factory=list)
    error: str | None = None
    ended: bool = False
    _page: PageFrames = field(default_factory=PageFrames)
    _viewing: Viewing = field(default_factory=Viewing)
    _greeted: bool = False

    def look(self, *, growing: bool) -> bool:
        """Read what is new; returns whether there was anything. A log that does not grow
        ends here.
        """
        try:
            samples = self.tail.more()
        except (LogError, OSError) as error:
            self.error, samples, growing = str(error), [], False
        if self.tail.log is not None and not self._greeted:
            self._greeted = True
            if self.audience is not None:
                self.audience.begin(self.tail.log.team)
            log = self.tail.log
            self._page.hello(log.team, log.metadata, self.tail.path.name, live=growing)
        for sample in samples:
            input_ = for_viewer(sample)
            self._page.take(sample, input_)
            for view in self._viewing.take(sample, input_):
                if self.audience is not None:
                    self.audience.say(view)
        if samples:
            self.frames += self._page.flush(self._viewing.node.now_ns)
        elif self.tail.ended or not growing:
            try:
                if self.audience is not None:
                    self.audience.end()
            except (
                BusError
            ) as error:  # its port was taken meanwhile: the page is shown all the same
                self.error = str(error)
            self.frames += self._page.end(self._wrong(), complete=True)
            self.ended = True
        return bool(samples)

    def _wrong(self) -> list[str]:
        """The faults of the log, in words."""
        found = [] if self.error is None else [self.error]
        if self.tail.damaged:
            found.append(
                f"{self.tail.damaged} damaged parts of the log were left out; "
                "`teamslam log check` names them"
            )
        return found


class PageServer:
    """Serves one page at a host and port; to be run in an event loop of its own."""

    def __init__(self, feed: Feed, host: str, *, growing: bool) -> None:
        self._feed = feed
        self._host = host
        self._growing = growing
        self._files = page_files()
        self._frame_ready = asyncio.Condition()

    async def start(self, port: int) -> tuple[Server, int]:
        """Listen; the server, and the port that it is bound to."""
        server = await serve(
            self._stream,
            self._host,
            port,
            process_request=self._answer,
            compression=None,
            max_size=1024,
        )
        return server, int(next(iter(server.sockets)).getsockname()[1])

    async def read(self, stop: asyncio.Event) -> None:
        """Read the log until its end or until `stop`."""
        while not (self._feed.ended or stop.is_set()):
            some = await asyncio.to_thread(self._feed.look, growing=self._growing)
            async with self._frame_ready:
                self._frame_ready.notify_all()
            if not some:
                await asyncio.sleep(LOOK_S)

    def _answer(self, connection: ServerConnection, request: Request) -> Response | None:
        host = request.headers.get("Host", "")
        if self._host in ("127.0.0.1", "localhost", "::1") and not _is_loopback(host):
            return connection.respond(HTTPStatus.FORBIDDEN, f"{host!r} is not this machine\n")
        path = urlsplit(request.path).path
        if path == STREAM:
            origin = request.headers.get("Origin")
            if origin is not None and urlsplit(origin).netloc != host:
                return connection.respond(HTTPStatus.FORBIDDEN, "another page's origin\n")
            return None
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
        """Until there is news, or a while has passed; a page that has gone is noticed."""
        try:
            await asyncio.wait_for(self._frame_ready.wait(), 5.0)
        except TimeoutError:
            await connection.ping()


def _is_loopback(host: str) -> bool:
    return host.rpartition(":")[0] in _LOOPBACK or host in _LOOPBACK


@contextmanager
def serving(feed: Feed, host: str, port: int, *, growing: bool) -> Iterator[str]:
    """Serve the page on a thread until the context ends; yields its URL. Raises ServerError."""
    ready = threading.Event()
    ends: dict[str, object] = {}

    async def main() -> None:
        stop = asyncio.Event()
        loop = asyncio.get_running_loop()
        ends["stop"] = lambda: loop.call_soon_threadsafe(stop.set)
        page = PageServer(feed, host, growing=growing)
        try:
            server, ends["port"] = await page.start(port)
        except OSError as error:
            ends["error"] = error
            return
        finally:
            ready.set()
        async with server:
            await asyncio.gather(page.read(stop), stop.wait())

    thread = threading.Thread(target=lambda: asyncio.run(main()), name="page", daemon=True)
    thread.start()
    ready.wait()
    error = ends.get("error")
    if isinstance(error, OSError):
        raise ServerError(
            f"can not serve the page at {host}:{port}: {error.strerror}; "
            "choose another --port, 0 for any free one"
        )
    shown = f"[{host}]" if ":" in host else host
    try:
        yield f"http://{shown}:{ends['port']}/"
    finally:
        stop = ends["stop"]
        assert callable(stop)
        stop()
        thread.join(5.0)
