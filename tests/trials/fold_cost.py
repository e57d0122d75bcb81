"""The cost of a peer's fold: CPU of a robot that folds always, on request, or at the end only.

    python -m tests.trials.fold_cost [SCENARIO] [--steps N]

In memory, all in reach; the second robot folds after one and two thirds. For each way: CPU time in
total, of its fold until the streams end, of its fold in all, and of the rest.
"""

import argparse
import json
import sys
import time
from collections.abc import Callable
from typing import Any, TypeVar

from teamslam.central.peers.fold import FoldWhen, PeerFold
from teamslam.central.peers.robot import PeerRobot
from teamslam.sim.scenarios.scenario import Scenario, load, with_options
from teamslam.sim.scenarios.source import streams_of
from teamslam.team.config import RobotConfig
from teamslam.team.wire import messages as m
from teamslam.team.wire.bus import Outgoing, Sample
from teamslam.team.wire.codec import encoded
from tests.air import Air
from tests.peer_team import PeerTeam, peer_world
from tests.scenarios import with_world

T = TypeVar("T")


class Clock:
    def __init__(self) -> None:
        self.s = 0.0
        self._depth = 0

    def of(self, work: Callable[[], T]) -> T:
        self._depth += 1
        began = time.process_time()
        try:
            return work()
        finally:
            self._depth -= 1
            if not self._depth:
                self.s += time.process_time() - began


class TimedFold(PeerFold):
    clock: Clock

    def _give(self, message: m.Message) -> list[Outgoing]:
        return self.clock.of(lambda: super(TimedFold, self)._give(message))

    def refresh(self) -> list[Outgoing]:
        return self.clock.of(lambda: super(TimedFold, self).refresh())


class Timed(PeerRobot):
    """A peer whose CPU time is counted."""

    def __init__(self, scenario: Scenario, config: RobotConfig, when: FoldWhen) -> None:
        names = [each.id for each in scenario.robots]
        super().__init__(config, scenario.central, names, scenario.exchange, when)
        self.whole, self.driving_s = Clock(), 0.0
        self.fold.__class__ = TimedFold
        self.fold.clock = Clock()  # type: ignore[attr-defined]

    def handle_sample(self, message: m.Message, sample: Sample) -> list[Outgoing]:
        if isinstance(message, m.End):
            self.driving_s = self.fold.clock.s  # type: ignore[attr-defined]
        return self.whole.of(lambda: super(Timed, self).handle_sample(message, sample))

    def tick(self, now_s: float) -> list[Outgoing]:
        return self.whole.of(lambda: super(Timed, self).tick(now_s))


def measured(name: str, steps: int) -> dict[str, Any]:
    scenario = with_world(with_options(load(name), centre=False), steps=steps)
    ways: dict[str, FoldWhen] = {each.id: "end" for each in scenario.robots}
    first, second = (each.id for each in scenario.robots[:2])
    ways |= {first: "always", second: "request"}
    team = PeerTeam(scenario, Air(), lambda of, config: Timed(of, config, ways[config.id]))
    end_ns = max(int(each.stamps_ns[-1]) for each in streams_of(scenario).streams)
    due = [end_ns // 3, 2 * end_ns // 3]
    request = encoded(m.FoldRequest(stamp_ns=0))

    def ask(now: PeerTeam) -> None:
        if due and now.now_ns >= due[0]:
            due.pop(0)
            node = now.seats[second].node
            assert isinstance(node, Timed)
            node.whole.of(lambda: node.answer_fold(request))

    for _ in team.run(peer_world(scenario, streams_of(scenario)), ask):
        pass
    found = {}
    for robot in (first, second, scenario.robots[-1].id):
        node = team.seats[robot].node
        assert isinstance(node, Timed)
        fold_s = node.fold.clock.s  # type: ignore[attr-defined]
        found[f"{ways[robot]} ({robot})"] = {
            "cpu_s": round(node.whole.s, 3),
            "fold_while_driving_s": round(node.driving_s, 3),
            "fold_s": round(fold_s, 3),
            "without_fold_s": round(node.whole.s - fold_s, 3),
        }
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scenario", nargs="?", default="random-10")
    parser.add_argument("--steps", type=int, default=150)
    options = parser.parse_args()
    for way, row in measured(options.scenario, options.steps).items():
        sys.stdout.write(f"{way}: {json.dumps(row)}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
