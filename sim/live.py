"""What a user sees while a team runs: a live table in a terminal, plain lines elsewhere."""

import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager

from rich import box
from rich.console import Console, Group
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from sim.launch import Watch
from team.wire import messages as m

LINE_S = 5.0
"""Wall time between two plain lines."""
PATIENCE_S = 8.0
"""Processes start slowly on a busy machine: nobody is missed before."""


@contextmanager
def shown(title: str) -> Iterator[Callable[[Watch], None]]:
    """A function that shows the state of a run again and again, fit for where it is printed."""
    console = Console(stderr=True)
    if console.is_terminal and sys.stderr.isatty():
        with Live(console=console, refresh_per_second=4, transient=True) as live:
            yield lambda watch: live.update(_view(title, watch))
    else:
        yield _Lines(console).show


class _Lines:
    """Plain lines: one every LINE_S, and every warning once."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._due = 0.0
        self._said: set[str] = set()

    def show(self, watch: Watch) -> None:
        for warning in _warnings(watch):
            if warning not in self._said:
                self._said.add(warning)
                self._print(watch, f"warning: {warning}")
        now = time.monotonic()
        if now < self._due or "world" not in watch.statuses:
            return
        self._due = now + LINE_S
        world = watch.statuses["world"].figures
        robots = [s for n, s in sorted(watch.statuses.items()) if n.startswith("robot/")]
        if watch.statuses["world"].state == "waiting":
            self._print(watch, f"waiting: {len(robots)} of {watch.robots} robots")
            return
        submaps = sum(int(r.figures.get("submaps", 0)) for r in robots)
        fused = watch.fused
        landmarks = 0 if fused is None else len(fused.ids) // 4
        self._print(
            watch,
            f"{_done(world):4.0%}  team time {world.get('team_time_s', 0.0):.0f} s, "
            f"{len(robots)} robots, {submaps} submaps, {landmarks} landmarks in the team's map",
        )

    def _print(self, watch: Watch, text: str) -> None:
        elapsed = time.monotonic() - watch.began
        self._console.print(
            f"[{elapsed:6.1f} s] {text}", markup=False, highlight=False, soft_wrap=True
        )


def _done(world: Mapping[str, float]) -> float:
    total = world.get("of", 0.0)
    return world.get("readings", 0.0) / total if total else 0.0


def _warnings(watch: Watch) -> list[str]:
    """Failures and what the nodes warn of; that some are not there yet is none for a while."""
    texts = []
    if time.monotonic() - watch.began > PATIENCE_S:
        texts = [f"{node}: {w}" for node, s in sorted(watch.statuses.items()) for w in s.warnings]
    return [*watch.failures, *texts]


def _view(title: str, watch: Watch) -> Group:
    elapsed = time.monotonic() - watch.began
    world = watch.statuses.get("world")
    head = Text(f"{title}   {elapsed:.1f} s", style="bold")
    parts: list[Text | Table] = [head]
    if world is not None:
        bar = Table.grid(padding=(0, 2))
        bar.add_row(
            ProgressBar(total=1.0, completed=_done(world.figures), width=50),
            f"{_done(world.figures):.0%}",
            f"team time {world.figures.get('team_time_s', 0.0):,.0f} s",
        )
        parts.append(bar)
        parts.append(
            Text(
                f"{world.figures.get('readings', 0.0):,.0f} of "
                f"{world.figures.get('of', 0.0):,.0f} readings, world {world.state}"
            )
        )
    parts.append(_robots(watch.statuses))
    parts.append(Text(_map_line(watch)))
    parts += [Text(w, style="yellow") for w in _warnings(watch)[-4:]]
    return Group(*parts)


_COLUMNS = (
    ("steps", "steps", "{:,.0f}"),
    ("submaps", "submaps", "{:.0f}"),
    ("particles", "particles", "{:.0f}"),
    ("landmarks", "landmarks", "{:.0f}"),
    ("pose_sigma_m", r"pose σ \[m]", "{:.2f}"),
    ("messages_per_s", "msg/s", "{:,.0f}"),
    ("bytes_per_s", "B/s", "{:,.0f}"),
)


def _robots(statuses: Mapping[str, m.Status]) -> Table:
    table = Table(box=box.SIMPLE)
    table.add_column("robot")
    for _, heading, _ in _COLUMNS:
        table.add_column(heading, justify="right")
    table.add_column("state")
    for node, status in sorted(statuses.items()):
        if node.startswith("robot/"):
            figures = [
                f.format(status.figures[key]) if key in status.figures else "–"
                for key, _, f in _COLUMNS
            ]
            table.add_row(node.removeprefix("robot/"), *figures, status.state)
    return table


def _map_line(watch: Watch) -> str:
    fused, central, world = watch.fused, watch.statuses.get("central"), watch.statuses.get("world")
    if fused is None:
        return "no fused map yet"
    figures = {} if central is None else central.figures
    lag_s = 0.0 if world is None else max(0.0, 1e-9 * (world.stamp_ns - fused.stamp_ns))
    return (
        f"team map by {fused.rule}, {lag_s:.0f} s behind: {len(fused.ids) // 4} landmarks from "
        f"{figures.get('submaps', 0.0):.0f} submaps, {figures.get('broadcasts', 0.0):.0f} maps sent"
    )
