import msgspec
import pytest

from teamslam.sim.in_memory.team import run_team
from teamslam.sim.publisher.main import expected_configurations
from teamslam.sim.publisher.node import Configurations, WorldNode, expected_nodes
from teamslam.sim.scenarios.scenario import load, with_options
from teamslam.sim.scenarios.source import streams_of
from teamslam.team.wire import channels as ch
from tests import build
from tests.scenarios import with_world
from tests.teams import stream, world_of

SCENARIO = with_options(load("thesis"), robots=2)
OTHER = with_options(SCENARIO, seed=7, fusion="kalman")
STREAMS = world_of(stream("r1", 12), stream("r2", 9))


def world() -> WorldNode:
    expected = expected_nodes(["r1", "r2"], recorder=False)
    configurations = Configurations(expected_configurations(SCENARIO))
    announced = build.configuration(node="world", incarnation=0)
    node = WorldNode(STREAMS, expected, announced, configurations=configurations)
    for name in expected:
        node.handle(build.liveliness(node=name))
    return node


def announced(node: WorldNode, *others: str) -> None:
    here, there = expected_configurations(SCENARIO), expected_configurations(OTHER)
    for name in here:
        node.handle((there if name in others else here)[name])


def test_with_one_configuration_for_all_the_world_begins():
    node = world()
    assert node.publish(0.0) == [], "who is alive may still announce another configuration"
    assert node.waiting_for == ["central", "robot/r1", "robot/r2"]
    announced(node)
    assert node.publish(0.0)
    assert node.status().warnings == ()


@pytest.mark.parametrize(
    ("other", "field"),
    [("robot/r2", 'fusion is "kalman" there and "join" here, seed is 7 there and 1 here'),
     ("central", 'fusion is "kalman" there and "join" here')],
)  # fmt: skip
def test_with_another_configuration_the_world_does_not_begin_and_says_why(other, field):
    node = world()
    announced(node, other)
    assert node.publish(0.0) == []
    assert node.status().state == "waiting"
    (warning,) = node.status().warnings
    assert warning == (
        f"{other} differs from the world's scenario: {field}: "
        "start it again with the same scenario and options"
    )
    announced(node)
    assert node.publish(0.0), "it was started again with the right one"


def test_a_robot_that_comes_later_with_another_configuration_is_a_warning():
    node = world()
    announced(node)
    assert node.publish(0.0)
    announced(node, "robot/r1")
    assert node.status().state != "waiting"
    assert "robot/r1 differs" in node.status().warnings[0]


def test_a_robot_that_is_not_in_the_scenario_is_named():
    configurations = Configurations(expected_configurations(SCENARIO))
    configurations.take(build.configuration(node="robot/r9"))
    assert not configurations.forbid, "whoever that is, the team does not wait for it"
    (warning,) = configurations.mismatches
    assert warning.startswith("robot/r9 is not in the world's scenario, which has central, robot/r")


def test_what_a_team_of_the_scenario_announces_is_what_is_expected():
    short = with_world(SCENARIO, steps=3)
    expected = expected_configurations(short)
    keys = {ch.CENTRAL_CONFIG.key(), *(ch.ROBOT_CONFIG.key(r.id) for r in short.robots)}
    said = [s.payload for s in run_team(short, streams_of(short)) if s.key in keys]
    assert sorted(said) == sorted(msgspec.msgpack.encode(x) for x in expected.values())
