"""How far a team is, kept from message to message, is what looking at every robot anew says."""

import random

from central.attendance import TeamAttendance
from team.wire import messages as m

ROBOTS = [f"r{k}" for k in range(6)]
END = m.End(
    stamp_ns=0,
    streams=tuple(m.StreamEnd(robot=r, incarnation=1, measurements=9) for r in ROBOTS),
)


def progress(robot: str, stamp_ns: int, submaps: int) -> m.Progress:
    return m.Progress(
        stamp_ns=stamp_ns,
        node=f"robot/{robot}",
        robot=robot,
        incarnation=1,
        measurements=3,
        submaps=submaps,
    )


def done(robot: str, submaps: int) -> m.Done:
    return m.Done(
        stamp_ns=0, robot=robot, incarnation=1, measurements=9, steps=3, submaps=submaps, ledger=()
    )


class Looking:
    """An attendance, how many submaps of each robot are here, and who was asked about."""

    def __init__(self, robots: list[str]) -> None:
        self.attendance = TeamAttendance.of(robots, self.dealt, self.count)
        self.here = dict.fromkeys(robots, 0)
        self.asked: list[str] = []

    def count(self, stream: tuple[str, int]) -> int:
        self.asked.append(stream[0])
        return self.here[stream[0]]

    def dealt(self, last: m.Done) -> bool:
        self.asked.append(last.robot)
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
                    message: m.Message = m.Liveliness(
                        stamp_ns=0, node=f"robot/{robot}", alive=draw.random() < 0.7
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


def test_what_one_robot_says_costs_no_look_at_the_others() -> None:
    robots = [f"r{k}" for k in range(200)]
    team = Looking(robots)
    for robot in robots:
        team.attendance.take(progress(robot, 5, 0))
    assert team.watermark_ns == 5
    team.asked.clear()
    for k, robot in enumerate(robots):
        team.attendance.take(progress(robot, 7, 0))
        assert team.watermark_ns == (7 if k == len(robots) - 1 else 5)
    assert len(team.asked) == len(robots)
    team.attendance.take(END.__class__(stamp_ns=0, streams=tuple(
        m.StreamEnd(robot=r, incarnation=1, measurements=9) for r in robots
    )))  # fmt: skip
    team.asked.clear()
    for k, robot in enumerate(robots):
        team.attendance.take(done(robot, 0))
        assert team.attendance.is_concluded() == (k == len(robots) - 1)
    assert len(team.asked) < 12 * len(robots), "each was asked about a few times, not each time"
