"""Show a running team: a live table in a terminal, plain lines elsewhere."""

import math
import re
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING

from rich import box
from rich.console import Console, Group
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from teamslam.central.desk.names import in_order, not_joined, short, without_decimals
from teamslam.sim.launch.watch import DRIVERS, Watch, team_time
from teamslam.team.recording.inventory import MISSING
from teamslam.team.wire import messages as m

if TYPE_CHECKING:
    from teamslam.sim.launch.live_errors import LiveErrors

AHEAD_S = 10.0  # smallest reported lead of the world over the map [s]
NAMED = 5  # most missing robots that are named
PATIENCE_S = 8.0  # time [s] before absent nodes are reported


def _count_consumed(watch: Watch) -> tuple[float, float]:
    total = 0.0 if watch.world is None else watch.world.figures.get("of", 0.0)
    robots = (s for node, s in watch.statuses.items() if node.startswith("robot/"))
    taken = sum(robot.figures.get("measurements", 0.0) for robot in robots)
    return min(taken, total), total


def done(watch: Watch) -> float:
    """Consumed share of the measurements."""
    taken, total = _count_consumed(watch)
    return taken / total if total else 0.0


def is_live(watch: Watch) -> bool:
    """Whether drivers measure instead of a world."""
    return watch.world is not None and watch.world.node == DRIVERS


def warnings(watch: Watch, silent_s: float = 0.0) -> list[str]:
    """Failures and node warnings; absent nodes after PATIENCE_S only.

    The messages that the log lacks are among the notes of the run's result.
    silent_s: age [s] beyond which a warning is dropped; 0: never.
    """
    if time.monotonic() - watch.began <= PATIENCE_S:
        return list(watch.failures)
    world = watch.world
    statuses = [(node, watch.statuses[node]) for node in in_order(watch.statuses)]
    if world is None:
        recorder = watch.statuses.get("recorder")
        waits = recorder is not None and recorder.warnings
        texts = [f"recorder: {'; '.join(waits)}"] if waits else []
    elif world.state == "waiting":
        texts = [f"{world.node}: {w}" for w in world.warnings]
    else:
        statuses += [(world.node, world)] if watch.drivers else []
        oldest = time.monotonic() - silent_s if silent_s else -math.inf
        fresh = [s for s in statuses if watch.last_message.get(s[0], math.inf) >= oldest]
        texts = [f"{node}: {w}" for node, status in fresh for w in status.warnings]
    texts = [each for each in texts if not each.startswith(f"recorder: {MISSING}")]
    return [*watch.failures, *(each for each in texts if not any(not_joined([each])))]


def _starting(watch: Watch) -> str:
    missing = watch.missing_robots
    more = f" and {len(missing) - NAMED} more" if len(missing) > NAMED else ""
    awaited = ", ".join(missing[:NAMED]) + more if missing else "the first measurements"
    count = len(watch.robots)
    return f"{count - len(missing)} of {count} robots have started; waiting for {awaited}"


def share(watch: Watch) -> str:
    """Progress as text."""
    if not is_live(watch):
        return f"{done(watch):.0%}"
    taken, total = _count_consumed(watch)
    return f"{taken:,.0f} of {total:,.0f} measurements mapped"


def times(watch: Watch, world: m.Status) -> str:
    """Describe the map's team time, and a world far ahead."""
    now_s = ahead_s = world.figures.get("team_time_s", 0.0)
    if watch.fused is not None and watch.fused.stamp_ns:
        ahead_s = 1e-9 * (world.stamp_ns - watch.fused.stamp_ns)
    if is_live(watch) or ahead_s < AHEAD_S:
        return team_time(world)
    at_s = max(0.0, now_s - ahead_s)
    return f"team time {at_s:,.0f} s (the world is {ahead_s:,.0f} s ahead of the map)"


def _unjoined_robots(watch: Watch) -> list[tuple[str, str]]:
    return [] if watch.fused is None else list(not_joined(watch.fused.reasons))


def consistency(watch: Watch) -> str:
    """Describe the monitor's figures; with truth, the coverage."""
    central, landmarks = watch.statuses.get("central"), watch.errors.landmarks
    figures = {} if central is None else central.figures
    names = ("joint_cost_per_dof", "covariance_scale")
    parts = [f"{n.replace('_', ' ')} {figures[n]:.2f}" for n in names if n in figures]
    if landmarks.count:
        parts.append(f"{landmarks.coverage:.0%} of landmarks within 95 %")
    return ", ".join(parts)


LINE_S = 5.0  # wall time between plain lines
REPEAT_S = 60.0  # wall time after which an unchanged line is repeated
SETTLED_S = 5.0  # a warning withdrawn within this time [s] is not printed
MOST_ALIKE = 3  # most lines of warnings that differ in their numbers only
_NUMBERS = re.compile(r"-?\d+(\.\d+)?")


@contextmanager
def show_live(title: str) -> Iterator[Callable[[Watch], None]]:
    """Yield a function that repeatedly shows a run's state."""
    console = Console(stderr=True)
    if console.is_terminal and sys.stderr.isatty():
        with Live(console=console, refresh_per_second=4, transient=True) as live:
            yield lambda watch: live.update(_view(title, watch, console.width))
    else:
        lines = _Lines(console)
        try:
            yield lines.show
        finally:
            lines.end()


class _Lines:
    def __init__(self, console: Console) -> None:
        self._console = console
        self._due = 0.0
        self._shown: set[str] = set()
        self._alike: dict[str, int] = {}
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
        for words in () if watch.fused is None or watch.fused.final else watch.fused.joined:
            who_and_when = words.partition(":")[0]
            if who_and_when not in self._shown:
                self._shown.add(who_and_when)
                self._print(watch, short(words))
        now = time.monotonic()
        if now < self._due or watch.world is None:
            return
        self._due = now + LINE_S
        line = self._progress(watch, watch.world)
        if line != self._line or now - self._line_s >= REPEAT_S:
            self._line, self._line_s = line, now
            self._print(watch, line)

    def _progress(self, watch: Watch, world: m.Status) -> str:
        robots = [s for n, s in watch.statuses.items() if n.startswith("robot/")]
        if world.state == "waiting":
            missing = watch.missing_robots
            lacking = world.warnings if is_live(watch) and not missing else ()
            self._shown |= {without_decimals(f"{DRIVERS}: {text}") for text in lacking}
            return "; ".join(lacking) or _starting(watch)
        submaps = sum(int(r.figures.get("submaps", 0)) for r in robots)
        fused = watch.fused
        landmarks = 0 if fused is None else len(fused.ids) // 4
        waiting = ", ".join(who for who, _ in _unjoined_robots(watch))
        apart = f"; not joined yet: {waiting}" if waiting else ""
        consistent = consistency(watch)
        return (
            f"{share(watch):>4}  {times(watch, world)}, "
            f"{len(robots)} robots, {submaps} submaps, {landmarks} landmarks in the team's map"
            f"{apart}{'; ' if consistent else ''}{consistent}"
        )

    def end(self) -> None:
        if self._last is not None:
            fused = self._last.fused
            final = fused.reasons if fused is not None and fused.final else ()
            self._shown |= {without_decimals(f"central: {reason}") for reason in final}
            self._warn(self._last, 0.0)

    def _warn(self, watch: Watch, settled_s: float) -> None:
        now, found = time.monotonic(), warnings(watch, silent_s=settled_s)
        self._since = {w: self._since.get(w, now) for w in map(without_decimals, found)}
        for warning in found:
            key = without_decimals(warning)
            lasting = warning in watch.failures or now - self._since[key] >= settled_s
            if not lasting or key in self._shown:
                continue
            self._shown.add(key)
            kind = _NUMBERS.sub("#", warning)
            self._alike[kind] = self._alike.get(kind, 0) + 1
            if self._alike[kind] <= MOST_ALIKE or warning in watch.failures:
                more = "; more like this: in the report" * (self._alike[kind] == MOST_ALIKE)
                self._print(watch, f"warning: {warning}{more}")

    def _print(self, watch: Watch, text: str) -> None:
        elapsed = time.monotonic() - watch.began
        self._console.print(
            f"[{elapsed:6.1f} s] {text}", markup=False, highlight=False, soft_wrap=True
        )


def _view(title: str, watch: Watch, width: int) -> Group:
    elapsed = time.monotonic() - watch.began
    world = watch.world
    parts: list[Text | Table] = [Text(f"{title}   {elapsed:.1f} s", style="bold")]
    if watch.place:
        parts.append(Text(f"other commands reach the team by {watch.place}", style="dim"))
    robots = {n: watch.statuses[n] for n in in_order(watch.statuses) if n.startswith("robot/")}
    if world is None or world.state == "waiting":
        parts.append(Text(_starting(watch)))
    else:
        bar = Table.grid(padding=(0, 2))
        bar.add_row(ProgressBar(total=1.0, completed=done(watch), width=36), share(watch))
        parts += [bar, Text(f"{times(watch, world)}, {world.node} {world.state}")]
    if robots:
        parts.append(_robots(robots, watch.errors, width))
    parts += [Text(line) for line in _map_lines(watch)]
    parts += [Text(short(words)) for words in (() if watch.fused is None else watch.fused.joined)]
    parts += [Text(note) for note in watch.notes[-4:]]
    parts += [Text(w, style="yellow") for w in warnings(watch)[-4:]]
    return Group(*parts)


_COLUMNS = (
    ("steps", "\nsteps", ",.0f"),
    ("submaps", "sub-\nmaps", ",.0f"),
    ("landmarks", "land-\nmarks", ",.0f"),
    ("pose_sigma_m", "pose\nσ [m]", ".2f"),
    ("nis_per_dof", "NIS\n/dof", ".2f"),
    ("messages_per_s", "\nmsg/s", ",.0f"),
    ("bytes_per_s", "\nB/s", ",.0f"),
)
_LEFT_OUT_FIRST = ("messages_per_s", "bytes_per_s", "landmarks")
"""Columns left out, in this order, until the table fits the terminal."""
_PEER_HEADINGS = ("set\nhere", "oldest\n[s]", "same\nset")
_NEWEST = "set_newest_s."
_SHOWN_AT_MOST = 12  # most robots with a row each
UNBOUNDED = 1000  # terminal columns in which a table takes all that it needs


def _robots(statuses: Mapping[str, m.Status], errors: "LiveErrors", width: int) -> Table:
    for count in range(len(_LEFT_OUT_FIRST) + 1):
        table = _table(statuses, errors, _LEFT_OUT_FIRST[:count])
        if Console(width=UNBOUNDED).measure(table).maximum <= width:
            break
    return table


def _table(
    statuses: Mapping[str, m.Status], errors: "LiveErrors", left_out: Sequence[str]
) -> Table:
    columns = [each for each in _COLUMNS if each[0] not in left_out]
    table = Table(box=box.SIMPLE, padding=(0, 1, 0, 0))
    judged = any(errors.of(n.removeprefix("robot/")).count for n in statuses)
    peers = any("set_submaps" in status.figures for status in statuses.values())
    headings = [heading for _, heading, _ in columns]
    headings += ["NEES\n/dof", "in\n95 %"] * judged + [*_PEER_HEADINGS] * peers
    table.add_column(Text("\nrobot"), no_wrap=True)
    for heading in headings:
        table.add_column(Text(heading), justify="right", no_wrap=True)
    table.add_column(Text("\nstate"), no_wrap=True)
    for node, status in list(statuses.items())[:_SHOWN_AT_MOST]:
        robot = node.removeprefix("robot/")
        cells = [_number(status.figures.get(key), form) for key, _, form in columns]
        if judged:
            tally = errors.of(robot)
            cells += [_number(tally.mean, ".2f"), _number(tally.coverage, ".0%")]
        cells += _peer_cells(robot, statuses) if peers else []
        table.add_row(robot, *cells, status.state)
    if len(statuses) > _SHOWN_AT_MOST:
        table.add_row(f"… {len(statuses) - _SHOWN_AT_MOST} more")
    return table


def _peer_cells(robot: str, statuses: Mapping[str, m.Status]) -> list[str]:
    """Share of the set, age of the others' newest submap, robots with the same set."""
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
    fused, central = watch.fused, watch.statuses.get("central")
    if fused is None:
        return ["no fused map yet"]
    figures = {} if central is None else central.figures
    lines = [
        f"team map by {fused.rule}: {len(fused.ids) // 4} landmarks from "
        f"{figures.get('submaps', 0.0):.0f} submaps, {figures.get('broadcasts', 0.0):.0f} maps sent"
    ]
    lines += filter(None, [consistency(watch)])
    return lines + [f"not joined yet: {who}: {why}" for who, why in _unjoined_robots(watch)]


def _number(value: float | None, form: str) -> str:
    return "–" if value is None else f"{value:{form}}"
