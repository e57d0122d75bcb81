"""The local density of landmarks, and the lengths that follow from their spacing."""

import numpy as np
import pytest

from teamslam.team.association import AssociationProfile
from teamslam.team.config import UNNAMED
from teamslam.team.estimation.association.density import LandmarkDensity
from teamslam.team.estimation.association.gating import Joint, evaluate_pairs
from teamslam.team.estimation.submap import LocalMap, Unnamed

PROFILE = AssociationProfile(slack=0.0, density=1.0)


def _submap(points: np.ndarray, together: bool) -> LocalMap:
    n = len(points)
    seen = np.ones((n, 1), np.bool_) if together else np.eye(n, dtype=np.bool_)
    ids = (UNNAMED + np.arange(n)).astype(np.uint32)
    mean = np.concatenate([np.zeros(3), points.ravel()])
    return LocalMap(ids, mean, np.eye(len(mean)), unnamed=Unnamed(np.ones(n, np.uint32), seen))


def test_a_profiles_lengths_are_bounded_by_the_spacing_of_landmarks_seen_together():
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


def test_a_pair_needs_less_evidence_where_the_maps_landmarks_stand_far_apart() -> None:
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
