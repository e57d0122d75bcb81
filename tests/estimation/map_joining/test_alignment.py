from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from teamslam.team.estimation.contribution import InitialPoseFactor, moment
from teamslam.team.estimation.map_joining.alignment import procrustes
from teamslam.team.estimation.map_joining.gauss_newton import JoinSettings
from teamslam.team.estimation.map_joining.joining import solve_fold
from teamslam.team.estimation.map_joining.marginals import landmark_map, trajectory
from tests.estimation.sighting_world import joined_with
from tests.estimation.submap_world import seen_from, team, wrap

OPTIONS = JoinSettings(step_tolerance=1e-10)


def joined(submaps, starts, tick=2):
    return joined_with(submaps, starts, (), OPTIONS, tick)


def seeing_only(submaps, robot, ids):
    def reduced(each):
        index = np.flatnonzero(np.isin(each.local.ids, ids))
        keep = np.concatenate([np.arange(3), *(3 + 2 * k + np.arange(2) for k in index)])
        local = replace(
            each.local,
            ids=each.local.ids[index],
            mean=each.local.mean[keep],
            covariance=each.local.covariance[np.ix_(keep, keep)],
        )
        return replace(each, local=local)

    return [reduced(each) if each.robot == robot else each for each in submaps]


def pairs(points):
    return np.column_stack([points.real, points.imag])


@settings(deadline=None, max_examples=50)
@given(st.integers(0, 2**32), st.integers(2, 8))
def test_procrustes_recovers_an_exact_motion(seed, count):
    rng = np.random.default_rng(seed)
    pose = np.array([*rng.normal(0.0, 50.0, 2), rng.uniform(-np.pi, np.pi)])
    points = rng.normal(0.0, 10.0, (count, 2))
    in_b = pairs(seen_from(pose, points[:, 0] + 1j * points[:, 1]))
    found = procrustes(points, in_b, rng.uniform(0.1, 10.0, count))
    np.testing.assert_allclose(found[:2], pose[:2], atol=1e-9)
    assert wrap(found[2] - pose[2]) == pytest.approx(0.0, abs=1e-9)


def test_a_mirrored_map_is_rotated_and_never_mirrored():
    rng = np.random.default_rng(1)
    in_b = rng.normal(0.0, 5.0, (5, 2))
    found = procrustes(in_b * np.array([1.0, -1.0]), in_b, np.ones(5))
    c, s = np.cos(found[2]), np.sin(found[2])
    assert np.linalg.det([[c, -s], [s, c]]) == pytest.approx(1.0)


@pytest.mark.parametrize("tick", [1, 3, 100])
def test_an_aligned_stream_ends_where_one_with_a_vague_start_ends(tick):
    world = team(3, robots=2, submaps=10)
    vague = InitialPoseFactor("r1", 0, world.starts[1].pose, np.diag([1e6, 1e6, 1e3]))
    free = solve_fold(joined(world.submaps, world.starts[:1], tick), OPTIONS)
    known = solve_fold(joined(world.submaps, [world.starts[0], vague], tick), OPTIONS)
    assert not free.reasons
    assert len(free.islands) == 1
    one, other = landmark_map(free), landmark_map(known)
    sigma = np.sqrt(np.diag(other.covariance)).reshape(-1, 2)
    assert (np.abs(one.means - other.means) < 0.05 * sigma).all()
    np.testing.assert_allclose(np.sqrt(np.diag(one.covariance)).reshape(-1, 2), sigma, rtol=0.05)
    assert np.abs(trajectory(free, "r1", 0).poses[-1] - world.paths["r1"][-1])[:2].max() < 1.0


@pytest.mark.parametrize("seed", range(6))
def test_maps_that_drifted_far_are_merged_and_find_the_same_optimum(seed):
    world = team(seed, submaps=25, landmarks=18, size=80.0, reach=20.0, sigmas=(0.3, 0.12, 1.2))
    vague = InitialPoseFactor("r1", 0, world.starts[1].pose, np.diag([1e6, 1e6, 1e3]))
    free = solve_fold(joined(world.submaps, world.starts[:1]), OPTIONS)
    known = solve_fold(joined(world.submaps, [world.starts[0], vague]), OPTIONS)
    assert not free.reasons
    assert free.main.cost < known.main.cost + 0.1


def test_one_shared_landmark_is_not_enough_and_the_fold_says_so():
    world = team(4, robots=2, submaps=6)
    fold = joined(seeing_only(world.submaps, "r1", [2]), world.starts[:1])
    assert fold.reasons == {("r1", 0): "r1 (incarnation 0) not joined: 1 shared landmark, 2 needed"}
    assert len(fold.islands) == 2


def test_maps_that_disagree_are_not_merged():
    world = team(4, robots=2, submaps=6)

    def stretched(each):
        mean = each.local.mean.copy()
        mean[3:] *= 3.0
        return replace(each, local=replace(each.local, mean=mean)) if each.robot == "r1" else each

    fold = joined([stretched(each) for each in world.submaps], world.starts[:1])
    reason = fold.reasons[("r1", 0)]
    assert "landmarks disagree: chi²" in reason
    assert "(99.9 %)" in reason


def test_without_any_start_the_smallest_stream_is_the_gauge_whoever_came_first():
    world = team(5, robots=2, submaps=8)
    late = [
        replace(each, end_ns=each.end_ns + (2500 if each.robot == "r0" else 0))
        for each in world.submaps
    ]
    fold = joined(sorted(late, key=lambda each: each.key), [])
    assert fold.frame == ("r0", 0)
    assert not fold.reasons
    island = fold.main
    gauge = island.graph.streams[("r0", 0)][0]
    assert island.graph.fixed[gauge]
    np.testing.assert_array_equal(island.state[island.graph.offset[gauge] :][:3], np.zeros(3))
    assert island.graph.fixed.sum() == 1


# --- islands among themselves ---


def test_two_free_islands_join_each_other_while_the_main_one_knows_neither():
    world = team(8, robots=3, submaps=6)
    apart = seeing_only(world.submaps, "r0", [])
    fold = solve_fold(joined(apart, world.starts[:1]), OPTIONS)
    assert fold.frame == ("r0", 0)
    assert len(fold.islands) == 2
    assert fold.home[("r1", 0)] == fold.home[("r2", 0)]
    assert set(fold.reasons) == {("r1", 0)}
    assert "0 shared landmarks, 2 needed" in fold.reasons[("r1", 0)]
    (words,) = fold.joined.values()
    assert words.startswith("r2 (incarnation 0) joined r1 (incarnation 0) at ")
    assert "per degree of freedom, transform sigma" in words
    other = fold.island("r2", 0)
    start = other.graph.streams[("r1", 0)][0]
    assert other.graph.fixed[start], "the smaller frame stays"


def test_with_no_start_known_the_whole_team_is_in_the_frame_of_the_smallest_stream():
    world = team(9, robots=3, submaps=8)
    fold = solve_fold(joined(world.submaps, []), OPTIONS)
    assert (fold.frame, len(fold.islands), len(fold.joined)) == (("r0", 0), 1, 2)
    found, known = (
        landmark_map(fold),
        landmark_map(solve_fold(joined(world.submaps, world.starts), OPTIONS)),
    )
    apart = (np.linalg.norm(m[:, None] - m[None], axis=2) for m in (found.means, known.means))
    np.testing.assert_allclose(*apart, atol=0.6)


@settings(deadline=None, max_examples=6)
@given(st.randoms(use_true_random=False))
def test_merges_and_their_words_are_the_same_for_every_order_of_arrival(random):
    world = team(10, robots=3, submaps=5)
    arrived = list(world.submaps)
    random.shuffle(arrived)
    one = joined(world.submaps, [])
    other = joined(sorted(arrived, key=lambda each: each.key), [])
    assert one.main.state.tobytes() == other.main.state.tobytes()
    assert (one.joined, one.reasons) == (other.joined, other.reasons)
    assert one.joined


def test_a_moment_is_seconds_or_the_time_of_day_where_team_time_is_unix_time():
    assert moment(123_456_789_000) == "123.5 s"
    assert moment(1_700_000_000 * 10**9) == "2023-11-14 22:13:20 UTC"
