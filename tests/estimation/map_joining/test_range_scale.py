"""The range scale: noise at the joined map's ranges, and an error that all robots share."""

from dataclasses import replace

import numpy as np
import pytest

from teamslam.team.core import packed, unpacked
from teamslam.team.estimation.contribution import Contribution, InitialPoseFactor
from teamslam.team.estimation.map_joining import marginals
from teamslam.team.estimation.map_joining.joining import JoinSettings, solve_fold
from teamslam.team.estimation.se2 import compose, inverse, transformed
from teamslam.team.estimation.submap import LocalMap
from tests.estimation.sighting_world import joined_with
from tests.estimation.submap_world import local_truth

OWN, COMMON, MARKER = 0.03, 0.1, 0.04
SIGMA = {"range_scale": OWN}
SHARE = 0.1  # standard deviation of a range's error in one submap, as a share of the range
LANDMARKS = np.array([[4.0, 3.0], [6.0, -3.0], [9.0, 2.0], [3.0, -4.0], [11.0, -2.0]])


def carts(seed, robots=2, submaps=12, own=OWN, common=0.0, way=0.01, marker=0.0):
    """Robots on known paths with scale errors: contributions, starts, the true errors.

    own, common, marker: sigmas of the scale of each robot, of all, and of each landmark's marker;
    way: of each submap's end pose [m].
    """
    random = np.random.default_rng(seed)
    shared = common * random.standard_normal()
    of_marker = marker * np.random.default_rng([seed, 1]).standard_normal(len(LANDMARKS))
    made, starts, errors = [], [], {}
    for r in range(robots):
        robot, pose = f"r{r}", np.array([0.0, 2.0 * r - 1.0, 0.0])
        starts.append(InitialPoseFactor(robot, 0, pose))
        errors[robot] = shared + own * random.standard_normal()
        for k in range(submaps):
            end = compose(pose, np.array([0.6, 0.0, 0.1 * (-1) ** k]))
            truth = local_truth(pose, end, LANDMARKS)
            spread = [way, way, 0.005]
            mean = truth + np.concatenate([spread * random.standard_normal(3), np.zeros(10)])
            middle = truth[:2] / 2.0
            covariance = np.diag(np.append(np.square(spread), np.zeros(10)))
            for at in range(3, 13, 2):
                off = truth[at : at + 2] - middle
                angle = np.arctan2(off[1], off[0]) + 0.01 * random.standard_normal()
                # The scale multiplies the true range; the noise adds.
                share = 1.0 + errors[robot] + SHARE * random.standard_normal()
                share += of_marker[at // 2 - 1]
                ahead = np.array([np.cos(angle), np.sin(angle)])
                distance = np.hypot(*off) * share
                mean[at : at + 2] = middle + distance * ahead
                turn = np.column_stack([ahead, [-ahead[1], ahead[0]]])
                seen = turn @ np.diag([(SHARE * distance) ** 2, (0.01 * distance) ** 2]) @ turn.T
                covariance[at : at + 2, at : at + 2] = seen
            column = np.zeros((1, 13))
            column[0, 3:] = (np.tile(middle, 5) - mean[3:]).ravel()
            local = LocalMap(
                np.arange(1, 6, dtype=np.uint32),
                mean,
                unpacked(packed(covariance), 13),
                biases=("range_scale",),
                sensitivity=column,
            )
            made.append(Contribution(robot, 0, k, 1000 * (k + 1), local))
            pose = end
    return sorted(made, key=lambda each: each.key), starts, errors


def fold_of(submaps, starts, options):
    return solve_fold(joined_with(submaps, starts, (), options, len(submaps)), options)


# --- noise at the joined map's ranges ---


def test_at_joined_ranges_errors_are_times_the_ratio_of_distances_and_columns_those_of_the_map():
    submaps, starts, _ = carts(1, robots=1, submaps=2)
    submaps = [_with_offset(each) for each in submaps]
    sigma = SIGMA | {"range_offset": 0.1}
    island = fold_of(submaps, starts, JoinSettings(bias_sigma=sigma)).main
    graph = island.graph
    for each in graph.submaps:
        local, at = each.contribution.local, graph.offset[each.nodes]
        scaled = each.factor.at_joined_ranges(island.state, at)
        start = island.state[at[0] : at[0] + 3]
        middle = local.end_pose[:2] / 2.0
        seen_from = compose(start, np.append(middle, 0.0))[:2]
        T, there = np.eye(13), np.zeros((5, 2))
        for k, landmark in enumerate(local.landmarks):
            joined = island.state[at[2 + k] : at[2 + k] + 2]
            q = np.hypot(*(joined - seen_from)) / np.hypot(*(landmark - middle))
            there[k] = transformed(inverse(start), joined) - middle
            turn = np.subtract(*(np.arctan2(y, x) for x, y in (there[k], landmark - middle)))
            at_k = slice(3 + 2 * k, 5 + 2 * k)
            ahead, across = np.cos(turn), np.sin(turn)
            T[at_k, at_k] = q * np.array([[ahead, -across], [across, ahead]])
            block = (T @ local.covariance @ T.T)[at_k, at_k]
            own = scaled.landmarks[k]
            np.testing.assert_allclose(own, block[[0, 0, 1], [0, 1, 1]], rtol=1e-9, atol=1e-12)
        metric = np.linalg.inv(T @ local.covariance @ T.T)
        np.testing.assert_allclose(scaled.information, metric, rtol=1e-9, atol=1e-7)
        offset, scale = scaled.sensitivity
        np.testing.assert_allclose(scale, np.append(np.zeros(3), -there), atol=1e-12)
        unit = there / np.linalg.norm(there, axis=1, keepdims=True)
        np.testing.assert_allclose(offset, np.append(np.zeros(3), -unit), atol=1e-12)


def _with_offset(submap):
    local = submap.local
    points = local.end_pose[:2] / 2.0 - local.landmarks
    ahead = points / np.linalg.norm(points, axis=1, keepdims=True)
    both = ("range_offset", "range_scale")
    columns = np.stack([np.append(np.zeros(3), rows) for rows in (ahead, points)])
    return replace(submap, local=replace(local, biases=both, sensitivity=columns))


# --- errors that all robots share ---


def test_a_marker_is_the_teams_and_its_prior_is_no_sensors_bias():
    submaps, starts, _ = carts(6, submaps=2, marker=MARKER)
    options = JoinSettings(bias_sigma=SIGMA, common_bias_sigma={"marker": MARKER})
    graph = fold_of(submaps, starts, options).main.graph
    assert sorted(graph.common) == [1, 2, 3, 4, 5]
    assert graph.name(graph.common[3]) == "the marker 3 of the team"
    _only_own_biases_are_discounted(graph)
    rows = graph.submaps[0].sensitivity
    local = graph.submaps[0].contribution.local
    np.testing.assert_array_equal(rows[1:].sum(axis=0), np.where(np.arange(13) < 3, 0.0, rows[0]))
    np.testing.assert_array_equal(rows[0], local.sensitivity[0])
    assert (np.count_nonzero(rows[1:], axis=1) == 2).all()


def _only_own_biases_are_discounted(graph):
    common = set(graph.common.values())
    assert [each.nodes[0] not in common for each in graph.priors] == [
        each.is_of_robot for each in graph.priors
    ]


def test_what_a_robot_is_told_of_its_scale_is_its_own_error_and_the_teams():
    submaps, starts, _ = carts(3, common=COMMON)
    common = {"range_scale": COMMON}
    fold = fold_of(submaps, starts, JoinSettings(bias_sigma=SIGMA, common_bias_sigma=common))
    island = fold.main
    node = island.graph.common["range_scale"]
    assert island.graph.name(node) == "the bias range_scale of the team"
    _only_own_biases_are_discounted(island.graph)
    of_team = island.state[island.graph.offset[node]]
    for each in marginals.bias_estimates(fold):
        own = island.state[island.graph.offset[island.graph.biases[each.stream, "range_scale"]]]
        assert each.value == pytest.approx(own + of_team, rel=1e-12)
        assert each.sigma < np.hypot(OWN, COMMON)


def test_islands_that_merge_have_one_common_error_and_its_prior_counts_once():
    submaps, starts, _ = carts(4, common=COMMON)
    common = {"range_scale": COMMON}
    options = JoinSettings(robust=False, bias_sigma=SIGMA, common_bias_sigma=common)
    fold = fold_of(submaps, starts[:1], options)
    graph, agreement = fold.main.graph, marginals.joint_cost(fold)
    assert len(fold.islands) == len(graph.common) == 1
    assert len(graph.priors) == 3
    priors = sum(len(prior.mean) for prior in graph.priors)
    assert agreement.dof == pytest.approx(graph.dimensions.sum() + priors - graph.unknowns)
