import random

import msgspec
import pytest

from teamslam.central.attendance import TeamAttendance
from teamslam.central.config import CentralConfig
from teamslam.central.node import CentralNode, make_centre
from teamslam.team.robot.node import RobotNode
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.codec import WireError, decoded, encoded
from tests import build
from tests.teams import Submaps, config, driven, of, published, stream

CONFIG = CentralConfig(tick_s=3.0, broadcast_s=3.0)
STREAMS = {name: stream(name, 12, y=y) for name, y in (("r1", 0.0), ("r2", 1.0))}
SUBMAPS = Submaps(list(STREAMS.values()))
STARTS = {name: published(each)[0] for name, each in STREAMS.items()}
END = build.end(**{name: len(each) for name, each in STREAMS.items()})


def alive(name, *, here=True):
    return build.liveliness(node=f"robot/{name}", alive=here)


def progress(name, stamp_s, submaps):
    return build.progress(stamp_ns=round(stamp_s * 1e9), robot=name, submaps=submaps)


def done(name, submaps=4, incarnation=1):
    counts = {"measurements": 31, "steps": 12, "submaps": submaps}
    return build.done(stamp_ns=12 * 10**9, robot=name, incarnation=incarnation, **counts)


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
    assert (fused.provisional, fused.members) == (False, build.version(r1=0, r2=0))


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
    said = [x for name in SUBMAPS for x in (STARTS[name], alive(name), *SUBMAPS[name])]
    return [*said, END, done("r1"), done("r2")]


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
    order = build.withdrawal(robot="r2", reason="flat")
    centre.hears(*SUBMAPS["r1"], *SUBMAPS["r2"][:2], order, done("r1"), END)
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


class Looking:
    def __init__(self, robots: list[str]) -> None:
        self.here = dict.fromkeys(robots, 0)
        self.attendance = TeamAttendance(
            robots,
            lambda last: self.here[last.robot] >= last.submaps,
            lambda stream: self.here[stream[0]],
        )

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
                    message: m.Message = alive(robot, here=draw.random() < 0.7)
                case 1 if draw.random() < 0.1:
                    message = build.given_up(node=f"robot/{robot}", by="x", reason="y")
                case 8:
                    message = build.end(**dict.fromkeys(ROBOTS, 9))
                case 9:
                    message = build.done(robot=robot, measurements=9, submaps=submaps)
                case _:
                    counts = {"measurements": 3, "submaps": submaps}
                    message = build.progress(stamp_ns=at, robot=robot, **counts)
            team.attendance.take(message)
            if not isinstance(message, m.End):
                team.here[robot] = draw.randint(team.here[robot], submaps)
            if draw.random() < 0.02:
                team.attendance.withdrawn = frozenset(draw.sample(ROBOTS, 2))
            assert team.attendance.watermark_ns == team.watermark_anew_ns, (seed, at)
            concluded = team.attendance.is_concluded()
            settled = all(team.attendance.is_settled(r) for r in ROBOTS)
            whole = team.attendance.end is not None and settled
            assert concluded == whole
            ended += whole
    assert ended


# Live teams: robots with drivers.


LIVE = {name: stream(name, 9, y=y) for name, y in (("r1", 0.0), ("r2", 1.0))}


def head(robot, count, state="ended", incarnation=1):
    return m.StreamHead(
        stamp_ns=0, robot=robot, incarnation=incarnation, measurements=count, state=state
    )


ORDER = build.team_end(reason="it rains")


class Live:
    def __init__(self, *robots, admit=False):
        self.centre = CentralNode(CentralConfig(), robots, admit=admit)
        self.said = self.centre.begin()

    def tell(self, *messages):
        for message in messages:
            if self.centre.refusal(message) is None:
                self.said += self.centre.handle(message)
        return self

    def robot(self, name, *, state="ended"):
        measured = published(LIVE[name])
        self.tell(build.liveliness(node=f"robot/{name}"))
        node = RobotNode(config(name))
        out = driven(node, measured, end=False)
        out += node.handle(head(name, len(measured), state))
        out += [] if state == "ended" else node.handle(ORDER)
        self.tell(measured[0], head(name, len(measured), state), *(o.message for o in out))
        return self

    @property
    def final(self):
        return self.centre.final


def test_a_driver_that_comes_back_is_waited_for_again():
    team = Live("r1", "r2").robot("r1").tell(build.initial_pose(incarnation=2)).robot("r2")
    assert team.final is None
    team.tell(head("r1", 1, "left", 2), ORDER)
    assert team.final is None  # the process has not confirmed this yet


def test_an_operator_ends_a_team_some_of_which_never_came():
    team = Live("r1", "r2", "r3").robot("r1").tell(ORDER)
    assert [o.channel for o in team.said if isinstance(o.message, m.TeamEnd)] == [ch.TEAM_END]
    assert team.final.lost == ()
    assert not team.final.provisional


@pytest.mark.parametrize(("state", "lost"), [("left", ()), ("open", ("r1",))])
def test_whose_driver_was_away_at_the_end_is_lost_unless_it_had_said_its_last_counter(state, lost):
    team = Live("r1").robot("r1", state=state)
    assert team.final is None
    team.tell(ORDER)
    assert team.final.lost == lost
    assert team.final.provisional == bool(lost)


def test_a_robot_that_nobody_has_named_is_admitted_only_where_the_scenario_says_so():
    closed = Live("r1").robot("r1")
    assert closed.final is not None
    refused = CentralNode(CentralConfig(), ["r1"])
    assert "not in this team" in refused.refusal(build.initial_pose(robot="r2"))
    absurd = Live("r1", admit=True).tell(build.initial_pose(robot="r2", incarnation=2**62))
    assert list(absurd.centre.robots) == ["r1"]
    team = Live("r1", admit=True).tell(build.initial_pose(robot="r2")).robot("r1")
    assert team.final is None
    assert team.centre.status().warnings == ("admitted, though not in the scenario: r2",)
    team.robot("r2")
    assert {member.robot for member in team.final.members} == {"r1", "r2"}


def test_the_map_of_a_live_team_is_that_of_the_same_streams_of_a_world():
    live = Live("r1", "r2").robot("r1").robot("r2")
    world = Live("r1", "r2")
    counts = {}
    for name, each in LIVE.items():
        measured = published(each)
        counts[name] = len(measured)
        said = driven(RobotNode(config(name)), measured)
        world.tell(measured[0], *(o.message for o in said))
    world.tell(build.end(**counts))
    assert world.final.digest == live.final.digest
    assert world.final.means == live.final.means


def test_nothing_waits_for_a_robot_whose_driver_has_not_come_or_is_away():
    team = Live("r1", "r2", "r3").robot("r1", state="open")
    attendance = team.centre.attendance
    assert attendance.watermark_ns == attendance.robots["r1"].progress.stamp_ns
    team.tell(build.liveliness(node="source/r1", alive=False))
    assert attendance.watermark_ns == float("inf")


def robot_with(count):
    node = RobotNode(config("r1"))
    measured = published(LIVE["r1"])
    node.handle(build.liveliness(node="source/r1"))
    for each in measured[:count]:
        node.handle(each)
    return node, measured


def test_a_robot_asks_for_what_its_driver_has_numbered_and_it_has_not():
    node, measured = robot_with(5)
    assert node.request() is None
    node.handle(head("r1", 12, "open"))
    assert (node.request().first, node.request().last) == (5, 11)
    node.handle(build.liveliness(node="source/r1", alive=False))
    assert node.request() is None
    assert "its driver is away after measurement 4" in node.status().warnings[0]
    assert len(measured) > 12


def test_a_robot_that_is_told_to_end_waits_for_its_driver_and_ends_without_one():
    node, measured = robot_with(5)
    assert of(node.handle(ORDER), ch.ROBOT_DONE) == []
    (done,) = of(node.handle(build.liveliness(node="source/r1", alive=False)), ch.ROBOT_DONE)
    assert done.measurements == 5
    node, measured = robot_with(len(LIVE["r1"]))
    node.handle(ORDER)
    out = node.handle(head("r1", len(measured)))
    (done,) = of(out, ch.ROBOT_DONE)
    assert done.measurements == len(measured)
    assert of(out, ch.ROBOT_HEAD) == [head("r1", len(measured))]  # when its driver has gone
