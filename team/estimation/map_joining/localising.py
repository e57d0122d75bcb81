"""Place a robot without a start in the team's map, by shared landmarks.

The robot's own map, a Gaussian over its pose and landmarks, is one submap. The alignment of the
shared landmarks gives its start; least squares over the team's landmarks and this submap give the
pose with its covariance.
"""

from typing import NamedTuple

import numpy as np

from teamslam.team.core import WholeMap
from teamslam.team.estimation.consistency import chi2_limit
from teamslam.team.estimation.gaussian import LandmarkGaussian, PoseGaussian
from teamslam.team.estimation.map_joining.alignment import (
    LEAST_AGREEING,
    NEEDED,
    Alignment,
    Maps,
    SharedPoints,
    agreeing,
    align,
    disagreement,
    refusal,
)
from teamslam.team.estimation.map_joining.conditioning import (
    Posed,
    join_pending,
    join_submap,
)
from teamslam.team.estimation.map_joining.gauss_newton import JoinSettings
from teamslam.team.estimation.submap import LocalMap
from teamslam.team.shapes import Float, Int64, UInt32

SETTINGS = JoinSettings()
FLAT = 1e4
"""Factor on the alignment's covariance for the prior of the start, so that the landmarks do not
count twice.
"""
HEADING_SIGMA = 0.5
"""Largest `Alignment.heading_sigma` [rad]; above that of a merge, since the pose is not fused."""


def locate_robot(
    team: LandmarkGaussian,
    own: WholeMap,
    window: LocalMap | None,
    covariance_factor: float = 1.0,
) -> Posed | str:
    """Estimate a robot's pose in the frame of the team's landmarks, or return why it is
    undetermined.

    own: the robot's map; window: the open one; covariance_factor: on both. If the landmarks
    disagree, the largest set of one rigid motion is used where it is most of them. Raises
    NotACovarianceError, NotDeterminedError.
    """
    whole = own if window is None else join_submap(own, window.named)
    whole = WholeMap(whole.ids, whole.mean, covariance_factor * whole.covariance)
    _, in_team, in_own = np.intersect1d(team.ids, whole.ids, return_indices=True)
    shared = _Shared.of(team, whole, in_team, in_own)
    fit, why = shared.fit()
    count, refused = len(in_team), 0
    if fit is not None and why is not None and count > LEAST_AGREEING:
        limit = chi2_limit(2, 1.0 - SETTINGS.alignment_confidence)
        agree = agreeing(shared.maps, limit)
        refused = count - int(agree.sum())
        if count - refused >= LEAST_AGREEING and 2 * refused < count:
            shared = _Shared.of(team, whole, in_team[agree], in_own[agree])
            fit, why = shared.fit()
    if fit is None or why is not None:
        return why or ""
    covariance = np.zeros_like(shared.P)
    covariance[:3, :3], covariance[3:, 3:] = FLAT * fit.covariance, shared.A
    start = WholeMap(shared.ids, np.concatenate([fit.a_from_b, shared.a.ravel()]), covariance)
    found = join_pending(start, [LocalMap(shared.ids, shared.mean, shared.P)])
    if found.disputed:
        return f"{SharedPoints(len(shared.ids))} contradict each other"
    return Posed(PoseGaussian(*found.whole.pose()), count, refused + sum(found.refused))


class _Shared(NamedTuple):
    """Shared landmarks: the team's N(a, A), and a robot's (pose, landmarks) N(mean, P)."""

    ids: UInt32[np.ndarray, " n"]
    a: Float[np.ndarray, "n 2"]
    A: Float[np.ndarray, "m m"]
    mean: Float[np.ndarray, " k"]
    P: Float[np.ndarray, "k k"]

    @classmethod
    def of(
        cls,
        team: LandmarkGaussian,
        whole: WholeMap,
        in_team: Int64[np.ndarray, " n"],
        in_own: Int64[np.ndarray, " n"],
    ) -> "_Shared":
        at, of = _points(in_team), np.concatenate([np.arange(3), 3 + _points(in_own)])
        return cls(
            team.ids[in_team],
            team.means[in_team],
            team.covariance[np.ix_(at, at)],
            whole.mean[of],
            whole.covariance[np.ix_(of, of)],
        )

    @property
    def maps(self) -> Maps:
        return Maps(self.a, self.A, self.mean[3:].reshape(-1, 2), self.P[3:, 3:])

    def fit(self) -> tuple[Alignment | None, str | None]:
        shared = SharedPoints(len(self.ids))
        fit = align(self.maps) if len(self.ids) >= NEEDED else None
        why = refusal(shared, fit, HEADING_SIGMA)
        if why is None and fit is not None:
            why = disagreement(shared, fit.chi2, SETTINGS.alignment_confidence)
        return fit, why


def _points(index: Int64[np.ndarray, " k"]) -> Int64[np.ndarray, " j"]:
    return (2 * index[:, None] + np.arange(2)).ravel()
