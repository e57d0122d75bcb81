"""Shows a log: the page, and Foxglove's WebSocket beside it."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from central.desk.view.foxglove_server import FoxgloveFeed
from central.desk.view.server import Feed, serving
from team.recording.tail import Tail


@dataclass(frozen=True)
class Shown:
    """The addresses at which a log is shown."""

    url: str
    foxglove: str
    feed: Feed


@contextmanager
def session(
    log: Path, host: str, port: int, foxglove_port: int, *, growing: bool
) -> Iterator[Shown]:
    """Show a log until the context ends; raises ServerError where a port is taken.

    growing: its recorder may still be running, or has not begun.
    """
    # Every reader that comes and goes is told of on the console otherwise.
    logging.getLogger("websockets").setLevel(logging.WARNING)
    with FoxgloveFeed(host, foxglove_port, live=growing) as foxglove:
        feed = Feed(Tail(log), foxglove)
        with serving(feed, host, port, growing=growing) as url:
            yield Shown(url, foxglove.url, feed)
