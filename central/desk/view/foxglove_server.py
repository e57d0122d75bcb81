"""Foxglove WebSocket: views of a log or run, by the SDK of the extra `foxglove`."""

import logging
import secrets
import socket
import threading
from typing import Self

import foxglove
from foxglove import Channel, Context, Schema
from foxglove.websocket import Capability, ChannelView, Client, ServerListener

from teamslam.team.recording.recorder import declaration_of
from teamslam.team.wire.bus import Sample


class FoxgloveServer(ServerListener):
    """SDK server at a hidden loopback address."""

    def __init__(self) -> None:
        self.team = ""  # team name; set before the first view
        self._context = Context()
        self._channels: dict[str, Channel] = {}
        self._newest: dict[str, Sample] = {}
        self._lock = threading.Lock()
        foxglove.set_log_level(logging.WARNING)  # it prints its hidden address otherwise
        hidden = _hidden_host()
        self._server = foxglove.start_server(
            name="teamslam",
            host=hidden,
            port=0,
            context=self._context,
            capabilities=[Capability.Time],
            server_listener=self,
        )
        self.url = f"ws://{hidden}:{self._server.port}"

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._server.stop()

    def publish(self, view: Sample) -> None:
        """Send a view to its topic's subscribers."""
        topic = f"team/{self.team}/{view.key}"
        with self._lock:
            if topic not in self._channels:
                self._channels[topic] = self._channel(topic, view.key)
            self._newest[topic] = view
        self._send(topic)
        self._server.broadcast_time(max(view.stamp_ns, 0))

    def on_subscribe(self, client: Client, channel: ChannelView) -> None:
        """Send the topic's newest view."""
        self._send(channel.topic)

    def _send(self, topic: str) -> None:
        with self._lock:
            view = self._newest.get(topic)
        if view is not None:
            self._channels[topic].log(view.payload, log_time=max(view.stamp_ns, 0))

    def _channel(self, topic: str, key: str) -> Channel:
        declaration = declaration_of(key)
        assert declaration is not None
        schema = Schema(
            name=declaration.schema, encoding=declaration.schema_encoding, data=declaration.text
        )
        return Channel(
            topic, schema=schema, message_encoding=declaration.encoding, context=self._context
        )


def _hidden_host() -> str:
    """Loopback address that no page can guess."""
    host = f"127.{secrets.randbelow(254) + 1}.{secrets.randbelow(256)}.{secrets.randbelow(254) + 1}"
    try:
        socket.create_server((host, 0)).close()
    except OSError:
        return "127.0.0.1"
    return host
