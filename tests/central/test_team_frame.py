from collections import deque
from functools import cache

import msgspec
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings, strategies as st

from teamslam.central.config import CentralConfig
from teamslam.central.node import CentralNode
from teamslam.team.driver.node import SourceNode
from teamslam.team.robot.node import RobotNode
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.arrays import floats, from_ids, ids
from teamslam.team.wire.bus import Outgoing
from teamslam.team.wire.message_order import is_newer_map
from tests import build
from tests.teams import config, published, stream

STEPS = 9
PATH_Y = {"alpha": 0.0, "bravo": 1.0, "charlie": -1.0}
"""The robots drive along the x axis, each on its own line, and see the same five landmarks."""
OWN_IDS = 100  # added to the landmark ids of a robot that has none in common with the others


@cache
def measured(robot: str, *, started: bool, apart: bool) -> list[m.Measurement]:
    found = published(stream(robot, STEPS, known=started, y=PATH_Y[robot]))
    offset = OWN_IDS * ord(robot[0]) if apart else 0
    return [renamed(each, offset) for each in found]


def renamed(measurement: m.Measurement, offset: int) -> m.Measurement:
    if not isinstance(measurement, m.Observations):
        return measurement
    return msgspec.structs.replace(measurement, ids=from_ids(ids(measurement.ids, "ids") + offset))


class Team:
    """Robots and a centre; submaps wait until they are delivered.

    poses: the newest message of each robot on team/pose.
    """

    def __init__(self, kinds: dict[str, tuple[bool, bool]]) -> None:
        self.kinds = kinds
        self.centre = CentralNode(CentralConfig(broadcast_s=1.0, tick_s=1.0), sorted(kinds))
        self.robots = {name: RobotNode(config(name)) for name in kinds}
        self.coming = {
            name: deque(measured(name, started=started, apart=apart))
            for name, (started, apart) in kinds.items()
        }
        self.sent: dict[str, deque[m.Message]] = {name: deque() for name in kinds}
        self.poses: dict[str, m.PoseEstimate] = {}
        self.map: m.FusedMap | None = None
        self.log: list[Outgoing] = []
        for name in kinds:
            self.to_centre(build.liveliness(node=ch.robot_node(name)))

    def measure(self, name: str) -> None:
        if self.coming[name]:
            measurement = self.coming[name].popleft()
            if isinstance(measurement, m.InitialPose):
                self.sent[name].append(measurement)
            self.take(self.robots[name].handle(measurement))

    def deliver(self, name: str) -> None:
        if self.sent[name]:
            self.to_centre(self.sent[name].popleft())

    def to_centre(self, message: m.Message) -> None:
        self.take(self.centre.handle(message))
        self.take(self.centre.refresh())

    def take(self, out: list[Outgoing]) -> None:
        for each in out:
            self.log.append(each)
            if isinstance(each.message, m.FusedMap) and is_newer_map(each.message, self.map):
                self.map = each.message
            if each.channel is ch.TEAM_POSE:
                self.poses[each.name] = each.message
            if each.channel is ch.PRIOR:
                self.take(self.robots[each.name].handle(each.message))
            elif each.channel is ch.ROBOT_DONE:
                self.sent[each.name].append(each.message)
            elif each.channel is ch.SUBMAP:
                self.sent[each.name].append(each.message)
                count = each.message.sequence + 1
                credit = build.progress(node="central", robot=each.name, submaps=count)
                self.take(self.robots[each.name].handle(credit))

    def order_without(self, name: str) -> None:
        self.to_centre(build.withdrawal(robot=name))

    def check(self) -> None:
        for name, pose in self.poses.items():
            if not pose.in_team_frame:
                assert pose.frame == f"{name}/1", "its own"
                assert not any(pose.map_digest)
                continue
            assert pose.frame == self.map.frame, f"{name} at {pose.stamp_ns}"
            anchor = pose.frame.partition("/")[0]
            if self.kinds[anchor][0]:
                true = np.array([1e-9 * pose.stamp_ns, PATH_Y[name], 0.0])
                off = floats(pose.pose, "pose") - true
                assert np.abs(off).max() < 1.0, f"{name} is at {floats(pose.pose, 'pose')}"


ROBOTS = sorted(PATH_Y)


@st.composite
def teams(draw):
    names = ROBOTS[: draw(st.integers(2, 3))]
    kinds = {name: (draw(st.booleans()), draw(st.booleans())) for name in names}
    action = st.tuples(st.sampled_from(["measure", "measure", "deliver"]), st.sampled_from(names))
    bursts = draw(st.lists(st.tuples(action, st.integers(1, 8)), max_size=25))
    gone = draw(st.none() | st.tuples(st.integers(0, 25), st.sampled_from(names)))
    return kinds, bursts, gone, draw(st.permutations(names))


@settings(
    max_examples=40,
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)
@given(teams())
def test_no_pose_claims_the_teams_frame_and_is_in_another_whatever_the_order_of_arrival(drawn):
    kinds, bursts, gone, last = drawn
    team = Team(kinds)
    for number, ((what, name), times) in enumerate(bursts):
        if gone is not None and gone[0] == number:
            team.order_without(gone[1])
            team.check()
        for _ in range(times):
            (team.measure if what == "measure" else team.deliver)(name)
            team.check()
    for name in last:
        while team.coming[name] or team.sent[name]:
            (team.deliver if team.sent[name] else team.measure)(name)
            team.check()
    team.to_centre(end_of(team))
    assert team.map.final
    team.check()


def end_of(team: Team) -> m.End:
    ends = {}
    for name, node in team.robots.items():
        while team.coming[name]:
            team.measure(name)
        ends[name] = node.next_measurement
    message = build.end(**ends)
    for node in team.robots.values():
        team.take(node.handle(message))
    for name in team.robots:
        while team.sent[name]:
            team.deliver(name)
    return message


def run_to_the_end(team: Team, *names: str, checked: bool = True) -> None:
    for name in names:
        while team.coming[name] or team.sent[name]:
            (team.deliver if team.sent[name] else team.measure)(name)
            if checked:
                team.check()


def disjoint_pair() -> Team:
    return Team({"alpha": (True, True), "bravo": (False, True)})


def test_a_robot_whose_submap_comes_before_the_anchored_ones_withdraws_its_team_pose():
    team = disjoint_pair()
    for _ in range(8):
        team.measure("bravo")
    run_to_the_end(team, "bravo")
    assert team.poses["bravo"].in_team_frame, "there is no other frame yet"
    assert team.poses["bravo"].frame == "bravo/1"
    run_to_the_end(team, "alpha")
    assert team.map.frame == "alpha/1"
    assert not team.poses["bravo"].in_team_frame
    driver = SourceNode.__new__(SourceNode)
    for pose, there in ((team.poses["bravo"], False), (team.poses["alpha"], True)):
        driver.pose = pose
        assert (driver.team_pose is not None) == there


def test_poses_are_taken_back_where_only_the_final_map_has_another_frame():
    team = Team({"alpha": (False, False), "bravo": (False, False)})
    run_to_the_end(team, "alpha", "bravo")
    end = end_of(team)
    assert {pose.frame for pose in team.poses.values()} == {"alpha/1"}
    team.order_without("alpha")
    assert team.map.frame == "alpha/1", "no submap came since"
    team.to_centre(end)
    assert team.map.final
    assert team.map.frame == "bravo/1"
    team.check()
    assert not any(pose.in_team_frame for pose in team.poses.values())


def test_a_withdrawn_robot_and_those_in_its_frame_withdraw_their_poses():
    team = Team({"alpha": (False, False), "bravo": (False, False), "charlie": (False, False)})
    last = team.coming["charlie"].pop()
    run_to_the_end(team, "alpha", "bravo", "charlie")
    for name in ("alpha", "bravo"):
        assert team.poses[name].in_team_frame
        assert team.poses[name].frame == "alpha/1"
    team.order_without("alpha")
    team.coming["charlie"].append(last)
    team.to_centre(end_of(team))
    assert team.map.final
    assert team.map.frame == "bravo/1"
    assert not any(team.poses[name].in_team_frame for name in ("alpha", "bravo")), "it is gone"
    team.check()


def newest_prior(team: Team) -> m.Prior:
    found = (o.message for o in reversed(team.log) if o.channel is ch.PRIOR and o.name == "bravo")
    return next(found)


@pytest.mark.parametrize("restarted", ["centre", "robot"])
def test_a_restarted_process_withdraws_what_the_one_before_it_has_claimed(restarted):
    team = disjoint_pair()
    for _ in range(8):
        team.measure("bravo")
    while team.sent["bravo"]:
        team.deliver("bravo")
    for _ in range(4):
        team.measure("bravo")
    assert team.poses["bravo"].in_team_frame
    if restarted == "robot":
        prior = newest_prior(team)
        run_to_the_end(team, "alpha")
        withdrawn = newest_prior(team)
        assert not withdrawn.in_team_frame
        again = RobotNode(config("bravo"))
        out = [o for late in (withdrawn, prior) for o in again.handle(late)]
        assert not out
        for measurement in measured("bravo", started=False, apart=True)[:6]:
            out += again.handle(measurement)
        first, *more = [o.message for o in out if o.channel is ch.TEAM_POSE]
        assert not first.in_team_frame
        assert not more
        return
    team.centre = CentralNode(CentralConfig(broadcast_s=1.0, tick_s=1.0), sorted(team.kinds))
    run_to_the_end(team, "alpha", checked=False)  # the new centre's maps are behind the old one's
    team.to_centre(measured("bravo", started=False, apart=True)[0])
    for submap in [o.message for o in team.log if o.channel is ch.SUBMAP and o.name == "bravo"]:
        team.to_centre(submap)
    assert not team.poses["bravo"].in_team_frame
