"""Fusion of whole maps that the robots then absorb.

The Kalman rules treat maps as independent, which they are not after an exchange.
"""

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from teamslam.sim.studies.estimators.feedback import carry_along
from teamslam.sim.studies.estimators.svd_joining import columns_of
from teamslam.team import core
from teamslam.team.estimation import dense
from teamslam.team.estimation.gaussian import (
    NO_LANDMARKS,
    LandmarkGaussian,
    NotACovarianceError,
    cholesky_factor,
    information,
)
from teamslam.team.shapes import Float, Int64

GOLDEN = 0.5 * (5.0**0.5 - 1.0)
SEARCH_STEPS = 60  # golden sections of [0, 1]: the last interval is 3·10⁻¹³ wide


SMALLEST_VARIANCE = 1e-12  # least variance [m²]: absorbing halves the variance in every round


def kalman(maps: Sequence[LandmarkGaussian]) -> LandmarkGaussian:
    """Full-covariance Kalman fusion in the given order.

    K = A_·c (A_cc + B_cc)⁻¹ on the common landmarks c, Joseph's form; B's others by regression on
    c.
    """
    return _one_by_one(_kalman_pair, maps)


def kalman_per_axis(maps: Sequence[LandmarkGaussian]) -> LandmarkGaussian:
    """Fuse each coordinate by itself (Xu, eq. 5.1-5.4).

    TH = TH^A + S^A/(S^A + S^B) (TH^B − TH^A) (the printed sign of 5.1 and 5.3 is a slip) and S =
    S^A S^B/(S^A + S^B).
    """
    return _one_by_one(_per_axis_pair, maps)


def covariance_intersection(maps: Sequence[LandmarkGaussian]) -> LandmarkGaussian:
    """Fusion consistent for any correlation (Julier & Uhlmann 1997).

    On the common landmarks C⁻¹ = ω A⁻¹ + (1 − ω) B⁻¹ and m = C (ω A⁻¹a + (1 − ω) B⁻¹b), with the ω
    of the least determinant of C. The others follow by regression.
    """
    return _one_by_one(_intersect_pair, maps)


def _one_by_one(
    pair: Callable[[LandmarkGaussian, LandmarkGaussian], LandmarkGaussian],
    maps: Sequence[LandmarkGaussian],
) -> LandmarkGaussian:
    if not maps:
        return NO_LANDMARKS
    fused = maps[0]
    for each in maps[1:]:
        fused = pair(fused, each)
    return fused


def fuse_maps(
    rule: Callable[[Sequence[LandmarkGaussian]], LandmarkGaussian],
    maps: Mapping[str, LandmarkGaussian],
    coordinate_m: float,
) -> tuple[LandmarkGaussian, tuple[str, ...]]:
    """Fuse maps; return the result and rejected maps with reasons."""
    accepted: dict[str, LandmarkGaussian] = {}
    reasons = []
    for robot, each in maps.items():
        if np.abs(each.means).max(initial=0.0) > coordinate_m:
            reasons.append(f"{robot}: its map is refused, a coordinate beyond {coordinate_m:g} m")
        else:
            accepted[robot] = each
    fused = _apply_rule(rule, list(accepted.values()))
    if fused is not None:
        return fused, tuple(reasons)
    fused, taken = NO_LANDMARKS, list[LandmarkGaussian]()
    for robot, each in accepted.items():
        more = _apply_rule(rule, [*taken, each])
        if more is None:
            reasons.append(f"{robot}: its map is refused, with it the fusion has no result")
        else:
            fused = more
            taken.append(each)
    return fused, tuple(reasons)


def _apply_rule(
    rule: Callable[[Sequence[LandmarkGaussian]], LandmarkGaussian], maps: Sequence[LandmarkGaussian]
) -> LandmarkGaussian | None:
    try:
        with np.errstate(all="ignore"):
            fused = rule(maps)
    except (NotACovarianceError, np.linalg.LinAlgError):
        return None
    finite = np.isfinite(fused.means).all() and np.isfinite(fused.covariance).all()
    return fused if finite else None


def _find_shared(a: LandmarkGaussian, b: LandmarkGaussian) -> tuple[Int64[np.ndarray, " k"], ...]:
    _, in_a, in_b = np.intersect1d(a.ids, b.ids, return_indices=True)
    return columns_of(in_a), columns_of(in_b)


def _carry(a: LandmarkGaussian, fused: LandmarkGaussian) -> LandmarkGaussian:
    in_a, in_fused = _find_shared(a, fused)
    mean, covariance = carry_along(
        a.means.ravel(), a.covariance, in_a, fused.means.ravel(), fused.covariance, in_fused
    )
    ids = np.concatenate([np.setdiff1d(a.ids, fused.ids), fused.ids])
    order = np.argsort(ids)
    place = columns_of(order)
    return LandmarkGaussian(
        ids[order], mean.reshape(-1, 2)[order], covariance[np.ix_(place, place)]
    )


def _kalman_pair(a: LandmarkGaussian, b: LandmarkGaussian) -> LandmarkGaussian:
    in_a, in_b = _find_shared(a, b)
    R = b.covariance[np.ix_(in_b, in_b)]
    innovation = information(a.covariance[np.ix_(in_a, in_a)] + R, "two maps' difference")
    gain = dense.product(a.covariance[:, in_a], innovation)
    moved = a.means.ravel() + dense.product(gain, b.means.ravel()[in_b] - a.means.ravel()[in_a])
    rest = np.eye(2 * len(a.ids))
    rest[:, in_a] -= gain
    covariance = dense.product(dense.product(rest, a.covariance), rest.T) + dense.product(
        dense.product(gain, R), gain.T
    )
    updated = LandmarkGaussian(a.ids, moved.reshape(-1, 2), 0.5 * (covariance + covariance.T))
    return _carry(b, updated)


def _per_axis_pair(a: LandmarkGaussian, b: LandmarkGaussian) -> LandmarkGaussian:
    ids = np.union1d(a.ids, b.ids)
    means = np.zeros((len(ids), 2))
    variances = np.zeros((len(ids), 2))
    for each in (a, b):
        place = np.searchsorted(ids, each.ids)
        means[place] = each.means
        variances[place] = np.diag(each.covariance).reshape(-1, 2)
    _, in_a, in_b = np.intersect1d(a.ids, b.ids, return_indices=True)
    both = np.searchsorted(ids, a.ids[in_a])
    of_a = np.diag(a.covariance).reshape(-1, 2)[in_a]
    of_b = np.diag(b.covariance).reshape(-1, 2)[in_b]
    share = of_a / (of_a + of_b)
    means[both] = a.means[in_a] + share * (b.means[in_b] - a.means[in_a])
    variances[both] = np.maximum(share * of_b, SMALLEST_VARIANCE)
    return LandmarkGaussian(ids, means, np.diag(variances.ravel()))


def _intersect_pair(a: LandmarkGaussian, b: LandmarkGaussian) -> LandmarkGaussian:
    in_a, in_b = _find_shared(a, b)
    common = NO_LANDMARKS
    if len(in_a):
        info_a = information(a.covariance[np.ix_(in_a, in_a)], "a map's common landmarks")
        info_b = information(b.covariance[np.ix_(in_b, in_b)], "a map's common landmarks")
        omega = _least(lambda w: _size(w * info_a + (1.0 - w) * info_b))
        spread = information(omega * info_a + (1.0 - omega) * info_b, "the intersection")
        mean = dense.product(
            spread,
            omega * (dense.product(info_a, a.means.ravel()[in_a]))
            + (1.0 - omega) * (dense.product(info_b, b.means.ravel()[in_b])),
        )
        common = LandmarkGaussian(a.ids[in_a[::2] // 2], mean.reshape(-1, 2), spread)
    return _carry(b, _carry(a, common))


def _size(metric: Float[np.ndarray, "n n"]) -> float:
    """Ln det C of the covariance C = metric⁻¹."""
    factor = cholesky_factor(metric, "the intersection")
    return float(-2.0 * core.log(np.diag(factor)).sum())


def _least(size: Callable[[float], float]) -> float:
    """ω in [0, 1] of the least size by golden section; size is convex in ω."""
    low, high = 0.0, 1.0
    left, right = high - GOLDEN * (high - low), low + GOLDEN * (high - low)
    at_left, at_right = size(left), size(right)
    for _ in range(SEARCH_STEPS):
        if at_left <= at_right:
            high, right, at_right = right, left, at_left
            left = high - GOLDEN * (high - low)
            at_left = size(left)
        else:
            low, left, at_left = left, right, at_right
            right = low + GOLDEN * (high - low)
            at_right = size(right)
    return 0.5 * (low + high)
