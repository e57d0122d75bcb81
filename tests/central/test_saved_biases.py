import dataclasses
from functools import cache

import msgspec
import numpy as np
import pytest

from teamslam.central.config import CentralConfig
from teamslam.central.fold_inputs import FoldInputs
from teamslam.central.saved_maps import save_map, sensor_warnings
from teamslam.team import translate
from teamslam.team.estimation.contribution import RobotBias, is_map
from teamslam.team.estimation.map_joining.gauss_newton import solve_island
from teamslam.team.estimation.map_joining.joining import JoinSettings, solve_fold
from teamslam.team.estimation.map_joining.landmark_view import joint
from teamslam.team.estimation.map_joining.submap_graph import DRIFT, Prior
from teamslam.team.saved_map import map_figures, submap_of
from teamslam.team.wire import messages as m
from teamslam.team.wire.arrays import from_ids
from teamslam.team.wire.codec import WireError, decoded, encoded
from tests.estimation.map_joining.test_range_scale import carts
from tests.estimation.sighting_world import joined_with
from tests.support import example

OWN, COMMON, SUBMAPS = 0.03, 0.05, 12
SETTINGS = JoinSettings(bias_sigma={"range_scale": OWN}, common_bias_sigma={"range_scale": COMMON})
NODES = list(range(1, 6))
OF_OWN = ("own_means", "own_covariance", "own_cross", "own_sensitivity", "likeliest", "evidence")


def days(seed, count, own=OWN, common=COMMON):
    """Submaps of each day, an incarnation, of the same robots; starts, biases."""
    submaps, starts, errors = carts(seed, submaps=count * SUBMAPS, own=own, common=common)
    found = [[] for _ in range(count)]
    for each in submaps:
        day, sequence = divmod(each.sequence, SUBMAPS)
        found[day].append(dataclasses.replace(each, incarnation=day, sequence=sequence))
    return *found, starts, errors


def fold_of(submaps, starts=()):
    return solve_fold(joined_with(submaps, starts, (), SETTINGS, len(submaps)), SETTINGS)


def saved_map(fold, before=()):
    fused = example(m.FusedMap, ids=from_ids(NODES), changes=())
    return save_map(fold, fused, "site", {each.author: each for each in before}, [bytes(8)])


@cache
def first_day(seed=1):
    """The saved map of the first of two days, and the second day's submaps."""
    first, second, starts, _ = days(seed, 2)
    return saved_map(fold_of(first, starts)), second


def contribution(saved):
    filed = FoldInputs(CentralConfig())
    submap = submap_of(saved)
    filed.add_submap(submap, b"", (), translate.own_biases_of(saved))
    return filed.contribution((submap.stamp_ns, submap.robot, 0, 0))


def landmarks(island):
    return joint(island, [], NODES)


def raw(submaps, starts):
    """The island of all days' submaps, each robot's biases tied to the day before."""
    island = fold_of(submaps, starts).main
    graph, priors = island.graph, []
    of_node = {node: of for of, node in graph.biases.items()}
    for prior in graph.priors:
        (robot, day), bias = of_node.get(prior.nodes[0], (("", 0), "bearing"))
        if day:
            W = prior.information[0, 0] / DRIFT[bias] ** 2 * np.array([[1.0, -1.0], [-1.0, 1.0]])
            nodes = *prior.nodes, graph.biases[(robot, day - 1), bias]
            prior = Prior(nodes, np.zeros(2), W, 1, is_of_robot=True)
        priors.append(prior)
    tied = dataclasses.replace(island, graph=dataclasses.replace(graph, priors=tuple(priors)))
    return solve_island(tied)[0]


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_saved_map_and_a_day_are_the_map_of_both_days_raw_submaps_with_the_errors_tied(seed):
    first, second, starts, _ = days(seed, 2)
    saved = saved_map(fold_of(first, starts))
    island = fold_of([contribution(saved), *second]).main
    assert {stream[0] for stream in island.graph.streams} == {"map-site", "r0", "r1"}
    assert_same_landmarks(island, raw([*first, *second], starts), 0.15)


def assert_same_landmarks(island, expected, sigmas):
    (mean, covariance), (there, spread) = landmarks(island), landmarks(expected)
    sigma = np.sqrt(np.diag(spread))
    assert (np.abs(mean - there) < sigmas * sigma).all()
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), sigma, rtol=0.1)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_on_the_third_day_the_errors_of_both_earlier_days_count_once(seed):
    first, second, third, starts, _ = days(seed, 3)
    of_first = saved_map(fold_of(first, starts))
    of_second = saved_map(fold_of([contribution(of_first), *second]), [of_first])
    for field in (*OF_OWN, "covariance", "sensitivity"):
        assert len(getattr(of_second, field)) == len(getattr(of_first, field))
    island = fold_of([contribution(of_second), *third]).main
    expected = raw([*first, *second, *third], starts)
    assert_same_landmarks(island, expected, 0.2)
    for of, node in island.graph.biases.items():
        own, error = joint(island, [node], [])
        other, spread = joint(expected, [expected.graph.biases[of]], [])
        assert abs(own[0] - other[0]) < 0.2 * np.sqrt(spread[0, 0])
        assert np.sqrt(error[0, 0]) == pytest.approx(np.sqrt(spread[0, 0]), rel=0.1)


def test_an_old_file_without_errors_is_still_read_and_leaves_todays_less_sure():
    saved, second = first_day()
    old = msgspec.structs.replace(saved, own=(), **dict.fromkeys(OF_OWN, b""))
    payload = msgspec.msgpack.encode(msgspec.msgpack.decode(encoded(old))[:14])
    assert decoded(payload, m.SavedMap) == old
    spreads = []
    for each in (saved, old):
        island = fold_of([contribution(each), *second]).main
        own = island.graph.biases[("r0", 1), "range_scale"]
        spreads.append(joint(island, [own], [])[1][0, 0])
    assert spreads[0] < 0.9 * spreads[1]


def test_the_conditional_of_the_errors_is_the_saved_marginal():
    saved, _ = first_day(2)
    own, plain = translate.own_biases_of(saved), translate.local_map_of(submap_of(saved))
    local, by_own = own.given(plain)
    P = local.covariance + by_own.T @ own.covariance @ by_own
    np.testing.assert_allclose(P, plain.covariance, rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(local.mean + own.mean @ by_own, plain.mean, rtol=1e-9, atol=1e-12)


def test_a_sensor_that_was_replaced_loses_the_tie_and_is_named():
    first, _, starts, _ = days(1, 2, own=0.3, common=0.0)
    _, second, _, errors = days(2, 2, own=0.3, common=0.0)
    fold = fold_of([contribution(saved_map(fold_of(first, starts))), *second])
    graph, weights = fold.main.graph, fold.main.estimate.prior_weights
    ties = {each.nodes[0]: k for k, each in enumerate(graph.priors) if len(each.nodes) == 2}
    for robot, error in errors.items():
        node = graph.biases[(robot, 1), "range_scale"]
        mean, covariance = joint(fold.main, [node, graph.common["range_scale"]], [])
        assert abs(mean.sum() - error) < 4.0 * np.sqrt(covariance.sum())
        assert weights[ties[node]] < 0.01 if robot == "r0" else weights[ties[node]] > 1.0
    (words,) = sensor_warnings(fold)
    assert words.startswith("r0: its range_scale is")


def test_a_sensor_that_stayed_is_not_named():
    for seed in range(1, 4):
        saved, second = first_day(seed)
        assert not list(sensor_warnings(fold_of([contribution(saved), *second])))


def test_another_robot_has_errors_of_its_own():
    saved, second = first_day()
    others = [dataclasses.replace(each, robot=f"other_{each.robot}") for each in second]
    graph = fold_of([contribution(saved), *others]).main.graph
    assert {of[1] for of in graph.remembered} == {
        RobotBias("r0", "range_scale"),
        RobotBias("r1", "range_scale"),
    }
    assert all(len(each.nodes) == 1 for each in graph.priors if each.is_of_robot)
    assert {s[0] for s in graph.streams if not is_map(s)} == {"other_r0", "other_r1"}


def test_the_errors_of_a_file_are_listed():
    shown = map_figures(first_day()[0])["own"]
    assert [(each["robot"], each["bias"]) for each in shown] == [
        ("r0", "range_scale"),
        ("r1", "range_scale"),
    ]
    assert all(0.0 < each["sigma"] < OWN for each in shown)


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"own_means": b""}, "length"),
        ({"evidence": np.diag([1.0, -1.0, 1.0])[np.triu_indices(3)].tobytes()}, "positive"),
        ({"own_cross": np.full(20, 1e3).tobytes()}, "positive"),
        ({"own": (m.RobotBias(robot="r1", bias="bearing"),) * 2}, "ascending"),
    ],
)
def test_the_door_refuses_unsound_errors(fields, words):
    saved = msgspec.structs.replace(first_day()[0], **fields)
    with pytest.raises(WireError, match=words):
        decoded(encoded(saved), m.SavedMap)
