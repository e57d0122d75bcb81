"""Every accepted message is folded or refused with a reason, and the map comes.

TEAMSLAM_STORM=N draws N sessions.
"""

import os

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings, strategies as st

from teamslam.central.config import CentralConfig
from teamslam.team.wire import messages as m
from teamslam.team.wire.arrays import floats, from_floats
from teamslam.team.wire.codec import decoded, encoded
from tests import build
from tests.hostile.drawing import CONFIG, ROBOTS, S, Team, centre_session, last_words, packed

SESSIONS = int(os.environ.get("TEAMSLAM_STORM", "4"))
FEW = settings(max_examples=SESSIONS, deadline=None, suppress_health_check=[HealthCheck.too_slow])


def submap(robot, sequence=0, ids=(1, 2, 3), mean=None, P=None, nodes=(), **fields):
    n = 3 + 3 * len(nodes) + 2 * len(ids)
    if mean is None:
        places = [(5 + 3 * (i % 7), 2 - (i % 5) * 3) for i in ids]
        mean = np.concatenate([[10.0, 0.0, 0.1], np.zeros(3 * len(nodes)), np.ravel(places)])
    begins = sequence * 10 * S
    return build.submap(
        stamp_ns=begins + 10 * S,
        robot=robot,
        sequence=sequence,
        first_measurement=sequence * 20 + (sequence > 0),
        last_measurement=sequence * 20 + 20,
        start_ns=begins,
        config=CONFIG,
        ids=np.array(ids, np.uint32),
        mean=mean,
        covariance=packed(np.eye(n) * 0.01 if P is None else P),
        nodes=np.array(nodes, np.int64),
        **fields,
    )


def start(robot, pose=(0.0, 0.0, 0.0), spread=None):
    return build.initial_pose(
        robot=robot,
        pose=b"" if pose is None else from_floats(pose),
        covariance=b"" if spread is None else from_floats(spread),
    )


def good(robot, count=4, **known):
    return [start(robot, **known), *(submap(robot, k) for k in range(count))]


def sighting(by, of, stamp_ns, spread, number=5):
    return build.sighting_factor(
        stamp_ns=stamp_ns,
        robot=by,
        sequence=stamp_ns // (10 * S),
        config=CONFIG,
        teammate=of,
        range=3.0,
        bearing=0.5,
        covariance=packed(spread),
        measurements=(number,),
    )


def concluded(messages, config=None):
    count = dict.fromkeys(ROBOTS, 0)
    for each in messages:
        if isinstance(each, m.Submap):
            count[each.robot] += 1
    taken = [decoded(encoded(each), type(each)) for each in [*messages, *last_words(count)]]
    centre, _ = centre_session(taken, config)
    assert centre.final is not None
    return centre.final


def at_one_place(robot):
    mean = np.array([10.0, 0.0, 0.1, 5.0, 5.0, 5.0, 5.0])
    return submap(robot, ids=(1, 2), mean=mean)


def scaled(*sigmas):
    return np.diag(np.square(np.resize(sigmas, 9)))


FAR = np.array([10.0, 0.0, 0.1, 1e9, 1e9, -1e9, 1e9, 1e9, -1e9])
STEEP = from_floats(np.full(9, 1e200))
NODES = (2 * S, 4 * S)
WIDE = np.eye(15) * 0.01
CASES = {
    "coincident landmarks": (
        [start("r1"), at_one_place("r1"), start("r2", None), at_one_place("r2")],
        "at one place, which gives no heading",
    ),
    "a landmark at 1e9 m": (
        [start("r1"), submap("r1", mean=FAR), *good("r2")],
        "submap 0 of r1 (incarnation 1) refused: a coordinate of 1e+09 m",
    ),
    "a pose at 1e9 m": (
        [*good("r1", pose=(1e9, 0.0, 0.0)), *good("r2")],
        "the initial pose of r1 (incarnation 1) refused, taken as unknown: a coordinate of 1e+09 m",
    ),
    "a covariance of 1e-300": (
        [*good("r1", spread=np.eye(3) * 1e-300), *good("r2")],
        "the initial pose of r1 (incarnation 1) refused, taken as unknown: a sigma of 1e-150 m",
    ),
    "a sigma of 1e12 beside one of 1e-12": (
        [start("r1"), submap("r1", P=scaled(1e12, 1e-12)), *good("r2")],
        "submap 0 of r1 (incarnation 1) refused: a sigma of 1e",
    ),
    "sensitivities of 1e200": (
        [start("r1"), submap("r1", biases=("bearing",), sensitivity=STEEP), *good("r2")],
        "submap 0 of r1 (incarnation 1) refused: a sensitivity beyond",
    ),
    "a sighting of 1e-300": (
        [
            start("r1"), sighting("r1", "r2", 2 * S, np.eye(2) * 1e-300),
            submap("r1", nodes=NODES, sightings=1, P=WIDE), start("r2"),
            submap("r2", nodes=NODES, P=WIDE),
        ],
        "an inter-robot measurement of r2 by r1 (incarnation 1) refused: a sigma of 1e-150 m",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_what_has_no_solution_is_refused_by_name_and_the_map_comes(name):
    messages, words = CASES[name]
    final = concluded(messages)
    assert any(words in reason for reason in final.reasons), final.reasons


def test_what_is_refused_leaves_the_map_of_the_others_as_it_is():
    alone = concluded(good("r2"))
    beside = concluded([start("r1"), submap("r1", mean=FAR), *good("r2")])
    assert (beside.ids, beside.means) == (alone.ids, alone.means)
    assert m.VersionEntry(robot="r1", incarnation=1, sequence=0) in beside.members, (
        "the set that the map names has it"
    )


def test_a_standing_robot_that_is_seen_by_another_one_stays_apart_and_it_is_said_why():
    """Repeated sightings of a place give no heading."""
    messages = []
    for robot, other in (("r1", "r2"), ("r2", "r1")):
        messages.append(start(robot, None))
        for k in range(3):
            nodes = tuple(k * 10 * S + t * S for t in (2, 4, 6, 8))
            still = np.zeros(15)
            sees = robot == "r1"
            if sees:
                messages += [
                    sighting(robot, other, t, np.diag([0.01, 1e-4]), t // S) for t in nodes
                ]
            messages.append(
                submap(robot, k, ids=(), mean=still, P=np.diag([1e-6, 1e-6, 1e-8] * 5),
                       nodes=nodes, sightings=4 * sees)
            )  # fmt: skip
    final = concluded(messages)
    assert any("r2 (incarnation 1) not joined" in reason for reason in final.reasons), final.reasons


def test_a_million_metres_from_the_origin_the_map_is_the_same():
    here = concluded([*good("r1"), *good("r2")])
    away = concluded([*good("r1", pose=(1e6, -1e6, 0.0)), *good("r2", pose=(1e6, -1e6, 0.0))])
    assert away.ids == here.ids
    assert not any("refused" in reason for reason in away.reasons)
    shift = floats(away.means, "means").reshape(-1, 2) - floats(here.means, "means").reshape(-1, 2)
    np.testing.assert_allclose(shift, [[1e6, -1e6]] * len(shift), atol=1e-6)
    np.testing.assert_allclose(
        floats(away.covariance, "covariance"), floats(here.covariance, "covariance"), rtol=1e-5,
        atol=1e-9,
    )  # fmt: skip


@FEW
@given(st.integers(0, 2**32))
def test_any_hostile_team_gets_a_map_and_in_any_order_the_same(seed):
    rng = np.random.default_rng(seed)
    team = Team(rng)
    for _ in range(8):
        team.grow()
    config = CentralConfig()
    told = [*team.messages, *([build.withdrawal(robot="r3")] if seed % 2 else [])]
    centre, _ = centre_session([*told, *team.ends()], config)
    assert centre.final is not None
    shuffled = [told[k] for k in rng.permutation(len(told))]
    again, _ = centre_session([*shuffled, *shuffled[:3], *team.ends()], config)
    assert again.final is not None
    assert encoded(again.final) == encoded(centre.final)
