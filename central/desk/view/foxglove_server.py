"""Foxglove's WebSocket: a team's views in Foxglove or Lichtblick, of a log or of a run.

A log can be played, paused and searched there; of a run the views are sent as they are made. A new
subscriber gets the newest view of its topic at once.
"""

import socket
import threading
import time
from bisect import bisect_right
from contextlib import ExitStack
from typing import Self

import foxglove
from foxglove import Channel, Context, Schema
from foxglove.websocket import (
    Capability,
    ChannelView,
    Client,
    PlaybackCommand,
    PlaybackControlRequest,
    PlaybackState,
    PlaybackStatus,
    ServerListener,
    WebSocketServer,
)

from central.desk.view.foxglove_door import door, hidden_host
from central.desk.view.server import ServerError
from team.recording.schemas import declaration_of
from team.wire.bus import Sample

TURN_S = 0.05
MOST_BYTES = 400_000_000
"""Most bytes of views that are stored for playing; the rest of a longer log is left out."""


class Views:
    """The views of one team as Foxglove's channels; the newest of each can be sent again."""

    def __init__(self) -> None:
        self.context = Context()
        self._channels: dict[str, Channel] = {}
        self._newest: dict[str, Sample] = {}
        self._team = ""
        self._lock = threading.Lock()

    def name(self, team: str) -> None:
        """Set the team's name; before the first view."""
        self._team = team

    def introduce(self, key: str) -> Channel:
        """The channel of a key, offered from now on."""
        with self._lock:
            channel = self._channels.get(key)
            if channel is None:
                channel = self._channels[key] = self._made(key)
            return channel

    def say(self, view: Sample) -> None:
        """Send a view to the subscribers."""
        channel = self.introduce(view.key)
        with self._lock:
            self._newest[view.key] = view
        channel.log(view.payload, log_time=max(view.stamp_ns, 0))

    def again(self, topic: str) -> None:
        """Send the newest view of a topic once more."""
        with self._lock:
            found = [v for key, v in self._newest.items() if self._topic(key) == topic]
        for view in found:
            self._channels[view.key].log(view.payload, log_time=max(view.stamp_ns, 0))

    def _topic(self, key: str) -> str:
        return f"team/{self._team}/{key}"

    def _made(self, key: str) -> Channel:
        declaration = declaration_of(key)
        assert declaration is not None
        schema = Schema(
            name=declaration.schema, encoding=declaration.schema_encoding, data=declaration.text
        )
        return Channel(
            self._topic(key),
            schema=schema,
            message_encoding=declaration.encoding,
            context=self.context,
        )


class Player(ServerListener):
    """Plays recorded views by their stamps, controlled by the viewer."""

    def __init__(self, views: Views, recorded: list[Sample]) -> None:
        self._views = views
        self._recorded = recorded
        self._stamps = [view.stamp_ns for view in recorded]
        self._lock = threading.Lock()
        self.playing = False
        self.speed = 1.0
        self.now_ns = 0
        self._sent = 0
        for key in dict.fromkeys(view.key for view in recorded):
            views.introduce(key)
        self._jump(self.span_ns[0])

    @property
    def span_ns(self) -> tuple[int, int]:
        """The first and last stamp of the views."""
        return (self._stamps[0], self._stamps[-1]) if self._stamps else (0, 1)

    def on_subscribe(self, client: Client, channel: ChannelView) -> None:
        """Send the newest view of the topic at once."""
        self._views.again(channel.topic)

    def on_playback_control_request(self, request: PlaybackControlRequest) -> PlaybackState:
        """Play, pause, change the speed, or jump."""
        play = request.playback_command == PlaybackCommand.Play
        self.ask(request.seek_time, request.playback_speed, play=play)
        return self.state(did_seek=request.seek_time is not None, request_id=request.request_id)

    def ask(self, seek_ns: int | None, speed: float, *, play: bool) -> None:
        """Jump to a time, if one is given; then play at this speed, or pause."""
        with self._lock:
            self.playing = play
            self.speed = speed or 1.0
            if seek_ns is not None:
                self._jump(seek_ns)

    def state(self, *, did_seek: bool = False, request_id: str | None = None) -> PlaybackState:
        """The state of playing."""
        at_end = self.now_ns >= self.span_ns[1]
        status = (
            PlaybackStatus.Ended if at_end
            else PlaybackStatus.Playing if self.playing
            else PlaybackStatus.Paused
        )  # fmt: skip
        return PlaybackState(status, self.now_ns, self.speed, did_seek, request_id)

    def turn(self, passed_s: float) -> bool:
        """Advance by this time and send the views that are due; returns whether it is playing."""
        with self._lock:
            if not self.playing:
                return False
            end_ns = self.span_ns[1]
            self.now_ns = min(self.now_ns + round(passed_s * self.speed * 1e9), end_ns)
            until = bisect_right(self._stamps, self.now_ns)
            for view in self._recorded[self._sent : until]:
                self._views.say(view)
            self._sent = until
            self.playing = self.now_ns < end_ns
            return True

    def _jump(self, to_ns: int) -> None:
        """Send every topic's newest view at that time."""
        self.now_ns = min(max(to_ns, self.span_ns[0]), self.span_ns[1])
        self._sent = bisect_right(self._stamps, self.now_ns)
        newest: dict[str, Sample] = {}
        for view in self._recorded[: self._sent]:
            newest[view.key] = view
        for view in newest.values():
            self._views.say(view)


class _Newest(ServerListener):
    def __init__(self, views: Views) -> None:
        self._views = views

    def on_subscribe(self, client: Client, channel: ChannelView) -> None:
        self._views.again(channel.topic)


class FoxgloveFeed:
    """Sends the views of a log to Foxglove: of a run at once, of a log when all of it has been
    read.

    Raises ServerError where it can not listen.
    """

    def __init__(self, host: str, port: int, *, live: bool) -> None:
        self._host, self._live = host, live
        self._views = Views()
        self._recorded: list[Sample] = []
        self._bytes = 0
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._server: WebSocketServer | None = None
        self._door = ExitStack()
        self._port = port if port or live else _free_port(host)
        if live:
            self._server = self._started([Capability.Time], _Newest(self._views), None)
        else:
            _check_free(host, self._port)

    @property
    def url(self) -> str:
        """The address for Foxglove; a log is available once it has been read."""
        return f"ws://{self._host}:{self._port}"

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
        self._door.close()
        if self._server is not None:
            self._server.stop()

    def begin(self, team: str) -> None:
        """Set the team's name."""
        self._views.name(team)

    def say(self, view: Sample) -> None:
        """Take one view."""
        if self._live:
            self._views.say(view)
            if self._server is not None:
                self._server.broadcast_time(max(view.stamp_ns, 0))
        elif self._bytes < MOST_BYTES:
            self._recorded.append(view)
            self._bytes += len(view.payload)

    def end(self) -> None:
        """The log has been read: from now on it can be played."""
        if self._live or not self._recorded or self._stop.is_set():
            return
        player = Player(self._views, sorted(self._recorded, key=lambda view: view.stamp_ns))
        capabilities = [Capability.Time, Capability.PlaybackControl]
        server = self._started(capabilities, player, player.span_ns)
        self._server = server

        def run() -> None:
            before = time.monotonic()
            while not self._stop.wait(TURN_S):
                now = time.monotonic()
                if player.turn(now - before):
                    server.broadcast_time(player.now_ns)
                    if not player.playing:
                        server.broadcast_playback_state(player.state())
                before = now

        self._thread = threading.Thread(target=run, name="foxglove", daemon=True)
        self._thread.start()

    def _started(
        self,
        capabilities: list[Capability],
        listener: Player | _Newest,
        span_ns: tuple[int, int] | None,
    ) -> WebSocketServer:
        """The SDK's server at a hidden address, and the proxy at the requested one."""
        hidden = hidden_host()
        server = foxglove.start_server(
            name="teamslam",
            host=hidden,
            port=0,
            context=self._views.context,
            capabilities=capabilities,
            server_listener=listener,
            playback_time_range=span_ns,
        )
        behind = f"ws://{hidden}:{server.port}"
        try:
            self._port = self._door.enter_context(door(self._host, self._port, behind))
        except OSError as error:
            server.stop()
            raise taken(self._host, self._port) from error
        return server


def taken(host: str, port: int) -> ServerError:
    """The error that the address can not be listened at."""
    return ServerError(
        f"can not serve Foxglove at {host}:{port}: the port is taken or the address is not this "
        "machine's; choose another --foxglove-port, 0 for any free one"
    )


def _check_free(host: str, port: int) -> None:
    try:
        socket.create_server((host, port), family=_family(host)).close()
    except OSError as error:
        raise taken(host, port) from error


def _free_port(host: str) -> int:
    with socket.create_server((host, 0), family=_family(host)) as found:
        return int(found.getsockname()[1])


def _family(host: str) -> socket.AddressFamily:
    return socket.AF_INET6 if ":" in host else socket.AF_INET
