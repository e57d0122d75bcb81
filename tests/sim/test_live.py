"""The plain lines of a run."""

from io import StringIO

import pytest
from rich.console import Console

from sim import live
from sim.launch import Watch
from team.wire import messages as m


def status(node: str, state: str, **figures: float) -> m.Status:
    return m.Status(0, node, state, figures, ())


def test_plain_lines_count_the_robots_that_have_come_while_the_world_waits(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(live, "LINE_S", 0.0)
    out = StringIO()
    lines = live._Lines(Console(file=out, width=100))
    watch = Watch(robots=3)
    watch.statuses["world"] = status("world", "waiting", readings=0.0, of=100.0)
    watch.statuses["robot/r1"] = status("robot/r1", "waiting")
    lines.show(watch)
    watch.statuses["world"] = status("world", "publishing", readings=50.0, of=100.0)
    lines.show(watch)
    waiting, running = out.getvalue().splitlines()
    assert waiting.endswith("] waiting: 1 of 3 robots")
    assert " 50%  team time 0 s, 1 robots" in running
