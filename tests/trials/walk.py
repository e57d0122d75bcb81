"""The walk of one measurement: the files and functions between a scan and the prior that returns.

    python -m tests.trials.walk [SCENARIO] [--final] [--functions]

A profiler around `handle` of every robot and of the centre, in memory, until the last running map.
For each file: its lines, those of the functions entered, and the files that call it.
"""

import argparse
import sys
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import CodeType, FrameType
from typing import Any, TypeVar

from teamslam.central.config import CentralConfig
from teamslam.central.node import CentralNode, make_centre
from teamslam.sim.in_memory.team import run_team
from teamslam.sim.scenarios.scenario import load
from teamslam.sim.scenarios.source import streams_of
from teamslam.team.config import Exchange, RobotConfig
from teamslam.team.robot.node import RobotNode, robot_node
from teamslam.team.wire import messages as m
from tests.support import ROOT

PRODUCT = ("team", "central", "sim")  # the folders of the product
Node = TypeVar("Node", RobotNode, CentralNode)


@dataclass
class Walk:
    """Functions entered inside `handle`, by code object: calls, and the files of the callers.

    final: whether messages that end the run count.
    """

    final: bool = False
    calls: Counter[CodeType] = field(default_factory=Counter)
    callers: defaultdict[str, set[str]] = field(default_factory=lambda: defaultdict(set))
    _product: dict[str, bool] = field(default_factory=dict)

    def around(self, node: RobotNode | CentralNode) -> None:
        handle = node.handle

        def profiled(message: m.Message) -> Any:
            if not self.final and _ends(message):
                return handle(message)
            sys.setprofile(self._note)
            try:
                return handle(message)
            finally:
                sys.setprofile(None)

        node.handle = profiled  # type: ignore[method-assign]

    def _note(self, frame: FrameType, event: str, _: object) -> None:
        code = frame.f_code
        if event != "call" or not self._is_product(code.co_filename):
            return
        self.calls[code] += 1
        caller = frame.f_back
        while caller is not None and not self._is_product(caller.f_code.co_filename):
            caller = caller.f_back
        if caller is not None and caller.f_code.co_filename != code.co_filename:
            self.callers[code.co_filename].add(caller.f_code.co_filename)

    def _is_product(self, name: str) -> bool:
        known = self._product.get(name)
        if known is None:
            path = Path(name).resolve()
            known = path.is_file() and path.is_relative_to(ROOT)
            known = known and path.relative_to(ROOT).parts[0] in PRODUCT
            self._product[name] = known
        return known


def _ends(message: m.Message) -> bool:
    return isinstance(message, m.End | m.TeamEnd | m.Done) or (
        isinstance(message, m.FusedMap) and message.final
    )


@dataclass(frozen=True)
class Row:
    name: str
    lines: int
    entered: int
    functions: Sequence[tuple[str, int]]
    callers: Sequence[str]


def rows_of(walk: Walk) -> Iterator[Row]:
    """Summarise a walk by file; lines of nested functions count once."""
    by_file: defaultdict[str, list[CodeType]] = defaultdict(list)
    for code in walk.calls:
        by_file[code.co_filename].append(code)
    for name, codes in sorted(by_file.items()):
        entered: set[int] = set()
        for code in codes:
            ends = [end for _, end, _, _ in code.co_positions() if end is not None]
            entered.update(range(code.co_firstlineno, max(ends) + 1))
        yield Row(
            _relative(name),
            len(Path(name).read_text("utf-8").splitlines()),
            len(entered),
            sorted((code.co_qualname, walk.calls[code]) for code in codes),
            sorted(map(_relative, walk.callers[name])),
        )


def _relative(name: str) -> str:
    return str(Path(name).resolve().relative_to(ROOT))


def walked(scenario_name: str, *, final: bool) -> Walk:
    walk, scenario = Walk(final), load(scenario_name)

    def robot(config: RobotConfig, exchange: Exchange) -> RobotNode:
        return _profiled(robot_node(config, exchange), walk)

    def central(config: CentralConfig, robots: list[str]) -> CentralNode:
        return _profiled(make_centre(config, robots), walk)

    for _ in run_team(scenario, streams_of(scenario), robot, central):
        pass
    return walk


def _profiled(node: Node, walk: Walk) -> Node:
    walk.around(node)
    return node


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scenario", nargs="?", default="waypoints")
    parser.add_argument("--final", action="store_true", help="with the final map")
    parser.add_argument("--functions", action="store_true", help="list the functions entered")
    options = parser.parse_args()
    rows = list(rows_of(walked(options.scenario, final=options.final)))
    write: Callable[[str], object] = sys.stdout.write
    for row in rows:
        callers = [each for each in row.callers if each != row.name]
        more = f" and {len(callers) - 2} more" if len(callers) > 2 else ""
        write(f"{row.name:58}{row.lines:5}{row.entered:6}  {', '.join(callers[:2])}{more}\n")
        for name, calls in row.functions if options.functions else ():
            write(f"    {name} {calls}\n")
    total, entered = sum(row.lines for row in rows), sum(row.entered for row in rows)
    write(f"{len(rows)} files of {total} lines, {entered} lines of functions entered\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
