import random

import msgspec
import pytest

from teamslam.central.attendance import TeamAttendance
from teamslam.central.config import CentralConfig
from teamslam.central.node import make_centre
from teamslam.team.wire import channels as ch
from teamslam.team.wire import messages as m
from teamslam.team.wire.codec import WireError, decoded, encoded
from tests import build
from tests.teams import Submaps, of, published, stream

CONFIG = CentralConfig(tick_s=3.0, broadcast_s=3.0)
STREAMS = {name: stream(name, 12, y=y) for name, y in (("r1", 0.0), ("r2", 1.0))}
SUBMAPS = Submaps(list(STREAMS.values()))
STARTS = {name: published(each)[0] for name, each in STREAMS.items()}
END = build.end(**{name: len(each) for name, each in STREAMS.items()})


def alive(name, *, here=True):
    return build.liveliness(node=f"robot/{name}", alive=here)


def progress(name, stamp_s, submaps, incarnation=1):
    return build.progress(
        stamp_ns=round(stamp_s * 1e9),
        node=f"robot/{name}",
        robot=name,
        incarnation=incarnation,
        submaps=submaps,
    )


def done(name, submaps=4, incarnation=1):
    return build.done(
        stamp_ns=12_000_000_000,
        robot=name,
        incarnation=incarnation,
        measurements=31,
        steps=12,
        submaps=submaps,
    )


class Centre:
    def __init__(self, config=CONFIG, robots=("r1", "r2")):
        self.node = make_centre(config, robots)
        self.said = self.node.begin()

    def hears(self, *messages):
        out = [o for message in messages for o in self.node.handle(message)]
        self.said += out
        return out

    @property
    def maps(self):
        return of(self.said, ch.FUSED_MAP)

    @property
    def final(self):
        (final,) = of(self.said, ch.FINAL_MAP)
        return final


def joined(*, robots=("r1", "r2"), config=CONFIG):
    centre = Centre(config)
    centre.hears(*(STARTS[r] for r in robots), *(alive(r) for r in robots))
    return centre


def test_a_tick_closes_when_every_live_robot_has_passed_it():
    centre = joined()
    centre.hears(SUBMAPS["r1"][0], progress("r1", 3, 1))
    assert centre.maps == [], "r2 has said nothing yet"
    centre.hears(SUBMAPS["r2"][0], progress("r2", 2.9, 1))
    assert centre.maps == []
    centre.hears(progress("r2", 3, 1))
    (fused,) = centre.maps
    assert (fused.provisional, fused.members) == (
        False,
        build.version(r1=0, r2=0),
    )


def test_a_set_that_is_handed_in_again_gives_the_same_final_map_and_closes_nothing_before():
    members = [*STARTS.values(), *SUBMAPS.every(), done("r1"), done("r2")]
    centre = joined()
    centre.hears(progress("r1", 12, 4), progress("r2", 12, 4), *members, END)
    first = centre.final
    centre.node.restart()
    assert not centre.node.finished
    out = centre.hears(*STARTS.values(), SUBMAPS["r1"][0], SUBMAPS["r2"][0])
    assert of(out, ch.FUSED_MAP) == [], "the progress of before covers submaps that are missing"
    (final,) = of(centre.hears(*members), ch.FINAL_MAP)
    assert encoded(final) == encoded(first)


def test_a_submap_is_acknowledged_after_the_map_that_it_gave():
    centre = joined(robots=("r1",))
    centre.hears(alive("r2"), alive("r2", here=False), progress("r1", 3, 1))
    out = centre.hears(SUBMAPS["r1"][0])
    assert [o.channel.name for o in out] == ["fused_map", "prior", "central_progress"]
    assert out[-1].message.submaps == 1
    (again,) = centre.hears(SUBMAPS["r1"][0])
    assert again.message.submaps == 1


def everything():
    return [
        *(x for name in SUBMAPS for x in (STARTS[name], alive(name), *SUBMAPS[name])),
        END,
        done("r1"),
        done("r2"),
    ]


def test_the_final_map_comes_once_when_everybody_is_done_and_everything_is_here():
    messages = everything()
    for last in (END, done("r2"), SUBMAPS["r2"][3], SUBMAPS["r1"][0], STARTS["r1"]):
        centre = Centre()
        centre.hears(*(x for x in messages if x != last))
        assert not centre.node.finished
        centre.hears(last)
        assert centre.node.finished
        assert centre.node.final == centre.final
        centre.hears(*messages, alive("r1", here=False))
        assert centre.final.members == build.version(r1=3, r2=3)


def given_up(robot):
    return build.given_up(node=f"robot/{robot}", reason="it fell into the water")


def test_a_robot_that_is_lost_at_the_end_is_waited_for_until_it_is_given_up():
    centre = joined()
    centre.hears(*SUBMAPS["r1"], *SUBMAPS["r2"][:2], done("r1"), END, alive("r2", here=False))
    assert not centre.node.finished
    assert centre.node.awaited == ["r2"]
    centre.hears(given_up("r2"))
    assert centre.final.members == build.version(r1=3, r2=1)
    assert (centre.final.lost, centre.final.provisional) == (("r2",), True)
    assert "r2 is given up" in centre.node.status().warnings[0]


def test_a_robot_that_is_lost_and_comes_back_is_not_lost_and_the_map_is_that_of_all():
    away, whole = joined(), joined()
    away.hears(*SUBMAPS["r1"], *SUBMAPS["r2"][:2], done("r1"), END, alive("r2", here=False))
    away.hears(alive("r2"), *SUBMAPS["r2"][2:], done("r2"))
    whole.hears(*SUBMAPS["r1"], *SUBMAPS["r2"], done("r1"), done("r2"), END)
    assert away.final == whole.final
    assert (away.final.lost, away.final.provisional) == ((), False)


def test_a_robot_that_was_withdrawn_and_has_left_is_not_waited_for_and_not_lost():
    centre = joined()
    centre.hears(
        *SUBMAPS["r1"],
        *SUBMAPS["r2"][:2],
        build.withdrawal(robot="r2", reason="flat"),
    )
    centre.hears(done("r1"), END)
    assert not centre.node.finished, "it is there, and may still say what it did"
    centre.hears(alive("r2", here=False))
    assert (centre.final.withdrawn, centre.final.lost) == (("r2",), ())
    assert not centre.final.provisional


def test_a_robot_that_died_after_its_last_word_with_a_submap_lost_is_waited_for_too():
    centre = joined()
    centre.hears(*SUBMAPS["r1"], SUBMAPS["r2"][0], SUBMAPS["r2"][2], done("r1"), done("r2"), END)
    centre.hears(alive("r2", here=False))
    assert not centre.node.finished
    centre.hears(given_up("r2"))
    assert centre.final.missing == build.version(r2=1)
    assert centre.final.lost == ("r2",)


def test_a_refused_submap_does_not_hold_up_the_team():
    centre = joined()
    torn = msgspec.structs.replace(SUBMAPS["r2"][1], first_measurement=0)
    out = centre.hears(SUBMAPS["r2"][0], torn, *SUBMAPS["r2"][2:])
    acknowledged = [o.message.submaps for o in out if o.channel is ch.CENTRAL_PROGRESS]
    assert acknowledged == [1, 2, 3, 4], "the robot has its credit"
    centre.hears(*SUBMAPS["r1"], done("r1"), done("r2"), END)
    assert centre.final.members == build.version(r1=3, r2=0)
    assert centre.node.status().figures["refused"] == 1.0
    assert "overlap" in centre.node.warnings[0]


def test_the_last_word_of_an_earlier_incarnation_is_not_the_last():
    centre = joined()
    end = msgspec.structs.replace(
        END, streams=(END.streams[0], m.StreamEnd(robot="r2", incarnation=2, measurements=9))
    )
    centre.hears(*SUBMAPS["r1"], *SUBMAPS["r2"], done("r1"), end, done("r2"))
    assert not centre.node.finished
    second = [msgspec.structs.replace(x, incarnation=2) for x in SUBMAPS["r2"][:2]]
    start = build.initial_pose(robot="r2", incarnation=2)
    centre.hears(start, *second, done("r2", 2, incarnation=2))
    assert centre.node.finished
    again = joined()
    again.hears(
        *SUBMAPS["r1"], *SUBMAPS["r2"], done("r1"), done("r2", 2, incarnation=2), done("r2"), end
    )
    assert not again.node.finished, "in whichever order they come"
    again.hears(start, *second)
    assert encoded(again.final) == encoded(centre.final)


def test_the_submaps_of_a_robot_are_given_to_its_next_life():
    centre = joined()
    centre.hears(SUBMAPS["r1"][0], SUBMAPS["r1"][1], SUBMAPS["r1"][3])

    def answer(robot):
        request = encoded(build.submaps_request(robot=robot))
        return [decoded(reply) for reply in centre.node.answer_submaps(request)]

    assert answer("r1") == [STARTS["r1"], *SUBMAPS["r1"][:2]]
    assert answer("r2") == answer("r9") == []
    with pytest.raises(WireError):
        centre.node.answer_submaps(b"\x93nonsense")


def test_what_a_robot_has_sent_by_its_word_and_is_not_here_is_wanted():
    centre = joined()
    centre.hears(SUBMAPS["r1"][0], progress("r1", 9.0, 3), progress("r2", 3.0, 0))
    (wanted,) = centre.node.lacking()
    assert (wanted.robot, wanted.incarnation, wanted.first) == ("r1", 1, 1)
    centre.hears(SUBMAPS["r1"][1], SUBMAPS["r1"][2])
    assert centre.node.lacking() == []
    centre.hears(done("r2", 4))
    (wanted,) = centre.node.lacking()
    assert (wanted.robot, wanted.incarnation, wanted.first) == ("r2", 1, 0)


ROBOTS = [f"r{k}" for k in range(6)]
END_ATTENDANCE = build.end(**dict.fromkeys(ROBOTS, 9))


def progress_attendance(robot: str, stamp_ns: int, submaps: int) -> m.Progress:
    return build.progress(
        stamp_ns=stamp_ns, node=f"robot/{robot}", robot=robot, measurements=3, submaps=submaps
    )


def done_attendance(robot: str, submaps: int) -> m.Done:
    return build.done(robot=robot, measurements=9, steps=3, submaps=submaps)


class Looking:
    def __init__(self, robots: list[str]) -> None:
        self.attendance = TeamAttendance(robots, self.dealt, self.count)
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


def test_watermark_and_end_are_those_of_a_look_at_every_robot():
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
                    message = build.given_up(node=f"robot/{robot}", by="x", reason="y")
                case 8:
                    message = END_ATTENDANCE
                case 9:
                    message = done_attendance(robot, submaps)
                case _:
                    message = progress_attendance(robot, at, submaps)
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
