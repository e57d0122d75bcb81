"""Pairs that stand side by side, told apart by one another; and the spacing that tells of them."""

import numpy as np
import pytest

from team.association import AssociationProfile
from team.config import UNNAMED
from team.estimation.association.density import LandmarkDensity
from team.estimation.association.gating import Joint, evaluate_pairs
from team.estimation.association.joint_compatibility import assign_jointly, grow_pairs
from team.estimation.submap import LocalMap, Unnamed

PROFILE = AssociationProfile(slack=0.0, density=1.0)
TWINS = [(0.0, 0.0), (0.2, 0.0), (3.0, 1.0), (3.0, 1.2)]


def _twins(seen: list[int], common: float) -> tuple[Joint, np.ndarray, np.ndarray]:
    """Known landmarks in twos, and some of them seen again with an error that they share."""
    n, m = len(TWINS), len(seen)
    points = np.array([*TWINS, *(TWINS[k] for k in seen)])
    covariance = 0.01**2 * np.eye(2 * (n + m))
    both = np.zeros((2 * (n + m), 2))
    both[2 * n :: 2, 0] = both[2 * n + 1 :: 2, 1] = common
    apart = np.zeros((n + m, n + m), np.bool_)
    apart[:n, :n] = apart[n:, n:] = True
    np.fill_diagonal(apart, False)
    one, two = np.meshgrid(np.arange(n, n + m), np.arange(n), indexing="ij")
    return Joint(points, covariance + both @ both.T, apart), one.ravel(), two.ravel()


def test_neighbours_are_told_apart_by_one_another_where_each_by_itself_is_not():
    joint, one, two = _twins([0, 1, 2, 3], common=0.15)
    alone = grow_pairs(joint, (one, two), PROFILE)
    assert alone is not None
    assert not alone.pairs
    found = assign_jointly(joint, one, two, PROFILE, 0.5)
    assert sorted((p.first, p.second) for p in found.pairs) == [(4, 0), (5, 1), (6, 2), (7, 3)]


def test_one_of_two_neighbours_alone_waits():
    joint, one, two = _twins([0], common=0.15)
    assert not assign_jointly(joint, one, two, PROFILE, 0.5).pairs


def test_a_few_loosely_known_landmarks_that_fit_others_by_chance_wait() -> None:
    known = np.array([(0.0, 0.0), (4.0, 1.0), (1.0, 5.0)])
    profile = AssociationProfile(slack=0.0, density=0.006, same=1.0)
    for count, sd, pairs in ((2, 0.3, 0), (2, 0.05, 2), (3, 0.3, 3)):
        points = np.concatenate([known, known[:count] + np.array([1.0, -0.5])])
        n = len(points)
        shift = np.zeros((2 * n, 2))  # an error of 1 m that all that is seen again has in common
        shift[6::2, 0] = shift[7::2, 1] = 1.0
        seen = np.arange(n) >= len(known)
        apart = (seen[:, None] == seen) & ~np.eye(n, dtype=np.bool_)
        joint = Joint(points, sd**2 * np.eye(2 * n) + shift @ shift.T, apart)
        one, two = (each.ravel() for each in np.meshgrid(np.arange(3, n), np.arange(3)))
        found = assign_jointly(joint, one, two, profile, 2.0)
        assert [(p.first, p.second) for p in found.pairs] == [(3 + k, k) for k in range(pairs)]


def test_what_only_a_doubtful_pair_makes_well_known_is_not_well_known() -> None:
    twins_and_another = [(0.0, 0.0), (0.25, 0.0), (3.0, 1.0)]
    points = np.array([*twins_and_another, (0.12, 0.0), (3.0, 1.0)])  # the first is either twin
    shift = np.zeros((10, 2))  # an error of 1 m that what is seen again has in common
    shift[6::2, 0] = shift[7::2, 1] = 1.0
    seen = np.arange(5) >= 3
    apart = (seen[:, None] == seen) & ~np.eye(5, dtype=np.bool_)
    joint = Joint(points, 0.05**2 * np.eye(10) + shift @ shift.T, apart)
    one, two = (each.ravel() for each in np.meshgrid([3, 4], [0, 1, 2], indexing="ij"))
    for density, pairs in ((0.05, []), (0.006, [(4, 2)])):
        profile = AssociationProfile(slack=0.0, density=density, same=0.1)
        found = assign_jointly(joint, one, two, profile, 2.0)
        assert [(p.first, p.second) for p in found.pairs] == pairs
        assert all(p.sd > 1.0 for p in found.pairs), "it is known to a metre, whatever the first is"


def _submap(points: np.ndarray, together: bool) -> LocalMap:
    n = len(points)
    seen = np.ones((n, 1), np.bool_) if together else np.eye(n, dtype=np.bool_)
    ids = (UNNAMED + np.arange(n)).astype(np.uint32)
    mean = np.concatenate([np.zeros(3), points.ravel()])
    return LocalMap(ids, mean, np.eye(len(mean)), unnamed=Unnamed(np.ones(n, np.uint32), seen))


def test_a_profiles_lengths_are_bounded_by_the_spacing_of_what_is_seen_together():
    rng = np.random.default_rng(2)
    groups = np.repeat(rng.uniform(0.0, 12.0, (8, 2)), 2, axis=0)
    groups[1::2] += [0.2, 0.0]
    crowd = LandmarkDensity([_submap(groups, together=True).spacings])
    bounded = crowd.limit_lengths(AssociationProfile(same=1.7, tight=0.5, slack=0.1))
    assert bounded.same == pytest.approx(0.3)
    assert (bounded.tight, bounded.slack) == pytest.approx((0.1, 0.036))
    assert bounded.near == PROFILE.near
    within = crowd.around_landmarks(np.array([0.3]))[0]
    assert within == pytest.approx(1.0 / (np.pi * 0.3**2), rel=0.1)
    few = LandmarkDensity([_submap(groups[:3], together=True).spacings]).limit_lengths(
        AssociationProfile(same=1.7)
    )
    assert few.same == pytest.approx(0.3)
    nobody = LandmarkDensity([_submap(groups, together=False).spacings])
    assert nobody.limit_lengths(PROFILE) == PROFILE
    assert nobody.around_landmarks(np.array([0.3]))[0] < 0.1 * within


def test_two_places_are_one_landmark_sooner_where_the_maps_landmarks_stand_far_apart() -> None:
    apart = np.zeros((2, 2), np.bool_)
    places = np.array([(0.0, 0.0), (0.25, 0.0)])  # 2.5 standard deviations of their difference
    strangers = Joint(places, 0.005 * np.eye(4), apart)
    pair = np.array([0]), np.array([1])
    llr = {"the profile's density": float(evaluate_pairs(strangers, *pair, PROFILE).llr[0])}
    for name, spacing in (("far apart", 2.0), ("close", 0.3)):
        at = spacing * np.array([(i, j) for i in range(10) for j in range(10)], float)
        crowd = LandmarkDensity([_submap(at, together=True).spacings], at)
        of_one_map = strangers._replace(density=crowd, unseen=np.ones(2))
        llr[name] = float(evaluate_pairs(of_one_map, *pair, PROFILE).llr[0])
        between = evaluate_pairs(strangers._replace(density=crowd), *pair, PROFILE).llr[0]
        assert between <= llr["the profile's density"]  # of two maps nothing is known
    assert llr["close"] < llr["the profile's density"] < PROFILE.llr_tight < llr["far apart"]
    assert llr["far apart"] - llr["the profile's density"] == pytest.approx(3.8, abs=0.1)
