"""Shows a running team: a live table in a terminal, plain lines elsewhere."""

import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING

from rich import box
from rich.console import Console, Group
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from central.desk.evaluation.events import without_decimals
from sim.launch.watch import DRIVERS, Watch, team_time
from team.wire import messages as m

if TYPE_CHECKING:
    from sim.launch.truth import LiveErrors

LINE_S = 5.0
"""Wall time between two plain lines."""
REPEAT_S = 60.0
"""Wall time after which a line is repeated that says nothing new."""
SETTLED_S = 5.0
"""A warning that a node withdraws sooner [s], as while a team starts, is not printed as a line."""
PATIENCE_S = 8.0
"""Time [s] before absent nodes are warned of: processes start slowly on a busy machine."""


@contextmanager
def shown(title: str) -> Iterator[Callable[[Watch], None]]:
    """A function that shows the state of a run again and again, in the form that fits the
    output.
    """
    console = Console(stderr=True)
    if console.is_terminal and sys.stderr.isatty():
        with Live(console=console, refresh_per_second=4, transient=True) as live:
            yield lambda watch: live.update(_view(title, watch))
    else:
        lines = _Lines(console)
        try:
            yield lines.show
        finally:
            lines.end()


class _Lines:
    """Plain lines: one every LINE_S, and every warning once."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._due = 0.0
        self._shown: set[str] = set()
        self._since: dict[str, float] = {}
        self._last: Watch | None = None
        self._noted = 0
        self._line = ""
        self._line_s = 0.0

    def show(self, watch: Watch) -> None:
        if self._last is None and watch.place:
            self._print(watch, f"other commands reach the team by {watch.place}")
        self._last = watch
        for note in watch.notes[self._noted :]:
            self._print(watch, note)
        self._noted = len(watch.notes)
        self._warn(watch, SETTLED_S)
        for words in () if watch.fused is None else watch.fused.joined:
            if words not in self._shown:
                self._shown.add(words)
                self._print(watch, words)
        now = time.monotonic()
        if now < self._due or watch.world is None:
            return
        self._due = now + LINE_S
        line = self._progress(watch, watch.world)
        if line != self._line or now - self._line_s >= REPEAT_S:
            self._line, self._line_s = line, now
            self._print(watch, line)

    def _progress(self, watch: Watch, world: m.Status) -> str:
        """The line on how far the team is; of what a live team waits for it says who and what."""
        robots = [s for n, s in sorted(watch.statuses.items()) if n.startswith("robot/")]
        if world.state == "waiting":
            lacking = world.warnings if _is_live(watch) and len(robots) >= watch.robots else ()
            self._shown |= {without_decimals(f"{DRIVERS}: {text}") for text in lacking}
            return "; ".join(lacking) or f"waiting: {len(robots)} of {watch.robots} robots"
        submaps = sum(int(r.figures.get("submaps", 0)) for r in robots)
        fused = watch.fused
        landmarks = 0 if fused is None else len(fused.ids) // 4
        consistency = _consistency(watch)
        return (
            f"{_share(watch):>4}  {team_time(world)}, "
            f"{len(robots)} robots, {submaps} submaps, {landmarks} landmarks in the team's map"
            f"{'; ' if consistency else ''}{consistency}"
        )

    def end(self) -> None:
        """Print the warnings that are left at the end, however short they have lasted."""
        if self._last is not None:
            self._warn(self._last, 0.0)

    def _warn(self, watch: Watch, settled_s: float) -> None:
        now, warnings = time.monotonic(), _warnings(watch)
        self._since = {w: self._since.get(w, now) for w in map(without_decimals, warnings)}
        for warning in warnings:
            key = without_decimals(warning)
            lasting = warning in watch.failures or now - self._since[key] >= settled_s
            if lasting and key not in self._shown:
                self._shown.add(key)
                self._print(watch, f"warning: {warning}")

    def _print(self, watch: Watch, text: str) -> None:
        elapsed = time.monotonic() - watch.began
        self._console.print(
            f"[{elapsed:6.1f} s] {text}", markup=False, highlight=False, soft_wrap=True
        )


def _taken(watch: Watch) -> tuple[float, float]:
    """How many of the world's measurements the robots have consumed, and their number; the world
    may be far ahead of them.
    """
    total = 0.0 if watch.world is None else watch.world.figures.get("of", 0.0)
    robots = (s for node, s in watch.statuses.items() if node.startswith("robot/"))
    taken = sum(robot.figures.get("measurements", 0.0) for robot in robots)
    return min(taken, total), total


def _done(watch: Watch) -> float:
    """The share of the world's measurements that the robots have consumed."""
    taken, total = _taken(watch)
    return taken / total if total else 0.0


def _is_live(watch: Watch) -> bool:
    """Whether drivers measure, and no world."""
    return watch.world is not None and watch.world.node == DRIVERS


def _warnings(watch: Watch) -> list[str]:
    """The failures, and the nodes' warnings; absent nodes are warned of after PATIENCE_S only.

    While the team starts every node lacks every other: the world's warning stands for all.
    """
    if time.monotonic() - watch.began <= PATIENCE_S:
        return list(watch.failures)
    world = watch.world
    statuses = sorted(watch.statuses.items())
    if world is None:
        statuses = (
            [("recorder", watch.statuses["recorder"])] if "recorder" in watch.statuses else []
        )
        texts = [f"{node}: {'; '.join(s.warnings)}" for node, s in statuses if s.warnings]
    elif world.state == "waiting":
        texts = [f"{world.node}: {w}" for w in world.warnings]
    else:
        statuses += [(world.node, world)] if watch.drivers else []
        texts = [f"{node}: {w}" for node, status in statuses for w in status.warnings]
    return [*watch.failures, *texts]


def _share(watch: Watch) -> str:
    """The progress in words: it is not known how much drivers will measure yet."""
    if not _is_live(watch):
        return f"{_done(watch):.0%}"
    taken, total = _taken(watch)
    return f"{taken:,.0f} of {total:,.0f} measurements mapped"


def _view(title: str, watch: Watch) -> Group:
    elapsed = time.monotonic() - watch.began
    world = watch.world
    parts: list[Text | Table] = [Text(f"{title}   {elapsed:.1f} s", style="bold")]
    if watch.place:
        parts.append(Text(f"other commands reach the team by {watch.place}", style="dim"))
    robots = {n: s for n, s in sorted(watch.statuses.items()) if n.startswith("robot/")}
    if world is None or world.state == "waiting":
        parts.append(Text(f"starting: {len(robots)} of {watch.robots} robots are there"))
    else:
        bar = Table.grid(padding=(0, 2))
        bar.add_row(
            ProgressBar(total=1.0, completed=_done(watch), width=36),
            _share(watch),
            f"{team_time(world)}, {world.node} {world.state}",
        )
        parts.append(bar)
    if robots:
        parts.append(_robots(robots, watch.errors))
    parts += [Text(line) for line in _map_lines(watch)]
    parts += [Text(words) for words in (() if watch.fused is None else watch.fused.joined)]
    parts += [Text(note) for note in watch.notes[-4:]]
    parts += [Text(w, style="yellow") for w in _warnings(watch)[-4:]]
    return Group(*parts)


_COLUMNS = (
    ("steps", "\nsteps", "{:,.0f}"),
    ("submaps", "sub-\nmaps", "{:,.0f}"),
    ("landmarks", "land-\nmarks", "{:,.0f}"),
    ("pose_sigma_m", "pose\nσ [m]", "{:.2f}"),
    ("nis_per_dof", "NIS\n/dof", "{:.2f}"),
    ("messages_per_s", "\nmsg/s", "{:,.0f}"),
    ("bytes_per_s", "\nB/s", "{:,.0f}"),
)
_PEER_HEADINGS = ("set\nhere", "oldest\n[s]", "same\nset")
_NEWEST = "set_newest_s."
_SHOWN_AT_MOST = 12
"""Most robots with a row of their own: a table that is higher than the terminal would be cut."""


def _robots(statuses: Mapping[str, m.Status], errors: "LiveErrors") -> Table:
    """A row for each robot; NEES and coverage of its poses where there is a truth."""
    table = Table(box=box.SIMPLE, padding=(0, 1, 0, 0))
    judged = any(errors.of(n.removeprefix("robot/")).count for n in statuses)
    table.add_column(Text("\nrobot"), no_wrap=True)
    headings = [heading for _, heading, _ in _COLUMNS] + ["NEES\n/dof", "in\n95 %"] * judged
    for heading in headings:
        table.add_column(Text(heading), justify="right", no_wrap=True)
    peers = any("set_submaps" in status.figures for status in statuses.values())
    for heading in _PEER_HEADINGS if peers else ():
        table.add_column(Text(heading), justify="right", no_wrap=True)
    table.add_column(Text("\nstate"), no_wrap=True)
    for node, status in list(statuses.items())[:_SHOWN_AT_MOST]:
        robot = node.removeprefix("robot/")
        cells = [
            form.format(status.figures[key]) if key in status.figures else "–"
            for key, _, form in _COLUMNS
        ]
        if judged:
            tally = errors.of(robot)
            cells += [_number(tally.mean, ".2f"), _number(tally.coverage, ".0%")]
        cells += _peer_cells(robot, statuses) if peers else []
        table.add_row(robot, *cells, status.state)
    if len(statuses) > _SHOWN_AT_MOST:
        table.add_row(f"… {len(statuses) - _SHOWN_AT_MOST} more")
    return table


def _peer_cells(robot: str, statuses: Mapping[str, m.Status]) -> list[str]:
    """How much of the set a robot has, the age of the newest submap that it has of the others, and
    how many of these have the same set.
    """
    figures = statuses[f"robot/{robot}"].figures
    sets = [status.figures.get("set_submaps", 0.0) for status in statuses.values()]
    newest = {
        name.removeprefix(_NEWEST): at for name, at in figures.items() if name.startswith(_NEWEST)
    }
    ages = [newest[robot] - at for name, at in newest.items() if name != robot and robot in newest]
    return [
        f"{figures.get('set_submaps', 0.0):.0f}/{max(sets):.0f}",
        f"{max(0.0, *ages):.0f}" if ages else "–",
        f"{figures.get('set_agrees', 0.0):.0f}",
    ]


def _map_lines(watch: Watch) -> list[str]:
    """The contents of the team's map, and its warnings."""
    fused, central, world = watch.fused, watch.statuses.get("central"), watch.world
    if fused is None:
        return ["no fused map yet"]
    figures = {} if central is None else central.figures
    lag_s = 0.0 if world is None else max(0.0, 1e-9 * (world.stamp_ns - fused.stamp_ns))
    lines = [
        f"team map by {fused.rule}, {lag_s:.0f} s behind: {len(fused.ids) // 4} landmarks from "
        f"{figures.get('submaps', 0.0):.0f} submaps, {figures.get('broadcasts', 0.0):.0f} maps sent"
    ]
    consistency = _consistency(watch)
    return [*lines, consistency] if consistency else lines


def _consistency(watch: Watch) -> str:
    """The consistency monitor's figures; against the truth NEES and coverage of the map's
    landmarks.
    """
    central, landmarks = watch.statuses.get("central"), watch.errors.landmarks
    figures = {} if central is None else central.figures
    parts = [
        f"{words} {figures[name]:.2f}"
        for name, words in (
            ("joint_cost_per_dof", "joint cost per dof"),
            ("covariance_scale", "covariance scale"),
        )
        if name in figures
    ]
    if landmarks.count:
        parts.append(f"landmark NEES per dof {landmarks.mean:.2f}")
        parts.append(f"{landmarks.coverage:.0%} within 95 %")
    return ", ".join(parts)


def _number(value: float | None, form: str) -> str:
    return "–" if value is None else f"{value:{form}}"
