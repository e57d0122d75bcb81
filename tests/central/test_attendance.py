"""The team's watermark and end, updated by each message, equal those of all robots' states."""

import random

from teamslam.central.attendance import TeamAttendance
from teamslam.team.wire import messages as m
from tests import build

ROBOTS = [f"r{k}" for k in range(6)]
END = build.end(**dict.fromkeys(ROBOTS, 9))


def progress(robot: str, stamp_ns: int, submaps: int) -> m.Progress:
    return build.progress(
        stamp_ns=stamp_ns, node=f"robot/{robot}", robot=robot, measurements=3, submaps=submaps
    )


def done(robot: str, submaps: int) -> m.Done:
    return build.done(robot=robot, measurements=9, steps=3, submaps=submaps)


class Looking:
    """An attendance, and how many submaps of each robot are here."""

    def __init__(self, robots: list[str]) -> None:
        self.attendance = TeamAttendance.of(robots, self.dealt, self.count)
        self.here = dict.fromkeys(robots, 0)

    def count(self, stream: tuple[str, int]) -> int:
        return self.here[stream[0]]

    def dealt(self, last: m.Done) -> bool:
        return self.here[last.robot] >= last.submaps

    @property
    def watermark_ns(self) -> float:
        return self.attendance.watermark_ns

    @property
    def watermark_anew_ns(self) -> float:
        least = float("inf")
        for name, robot in self.attendance.robots.items():
            if robot.lost or self.attendance.is_settled(name):
                continue
            said = robot.progress
            if said is None or self.here[name] < said.submaps:
                return float("-inf")
            least = min(least, said.stamp_ns)
        return least


def test_watermark_and_end_are_those_of_a_look_at_every_robot() -> None:
    ended = 0
    for seed in range(40):
        draw, team = random.Random(seed), Looking(ROBOTS)
        for at in range(120):
            robot = draw.choice(ROBOTS)
            submaps = at // 20
            match draw.randrange(8 if at < 60 else 10):
                case 0:
                    message: m.Message = build.liveliness(
                        node=f"robot/{robot}", alive=draw.random() < 0.7
                    )
                case 1 if draw.random() < 0.1:
                    message = m.GivenUp(stamp_ns=0, node=f"robot/{robot}", by="x", reason="y")
                case 8:
                    message = END
                case 9:
                    message = done(robot, submaps)
                case _:
                    message = progress(robot, at, submaps)
            team.attendance.take(message)
            if not isinstance(message, m.End):
                team.here[robot] = draw.randint(team.here[robot], submaps)
            if draw.random() < 0.02:
                team.attendance.withdrawn = frozenset(draw.sample(ROBOTS, 2))
            assert team.watermark_ns == team.watermark_anew_ns, (seed, at)
            concluded = team.attendance.is_concluded()
            settled = all(team.attendance.is_settled(r) for r in ROBOTS)
            whole = team.attendance.end is not None and settled
            assert concluded == whole
            ended += whole
    assert ended
