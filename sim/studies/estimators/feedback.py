"""Feedback: a fused map replaces a robot's landmarks, and is counted twice."""

import numpy as np

from teamslam.team.core import WholeMap
from teamslam.team.estimation import dense
from teamslam.team.estimation.gaussian import Matrix, Vector, information
from teamslam.team.estimation.se2 import wrapped
from teamslam.team.shapes import Float, Int64, UInt32


def carry_along(
    mean: Vector,
    covariance: Matrix,
    shared: Int64[np.ndarray, " k"],
    new_mean: Float[np.ndarray, " m"],
    new_covariance: Float[np.ndarray, "m m"],
    in_new: Int64[np.ndarray, " k"],
) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, "p p"]]:
    """Joint Gaussian of (own others o, everything new) after the shared part s was replaced.

    The entries `shared` become `in_new` of N(m, C); the conditional of o given s stays (Jeffrey's
    rule): with K = P_os P_ss⁻¹ the others have x_o + K (m_s − x_s), P_oo − K P_so + K C_ss Kᵀ, and
    K C_s· with everything new.
    """
    others = np.setdiff1d(np.arange(len(mean)), shared)
    own = information(covariance[np.ix_(shared, shared)], "the part to be replaced")
    gain = dense.product(covariance[np.ix_(others, shared)], own)
    cross = dense.product(gain, new_covariance[in_new])
    spread = covariance[np.ix_(others, others)] - dense.product(
        gain, covariance[np.ix_(shared, others)]
    )
    joint = np.block(
        [[spread + dense.product(cross[:, in_new], gain.T), cross], [cross.T, new_covariance]]
    )
    moved = mean[others] + dense.product(gain, new_mean[in_new] - mean[shared])
    return np.concatenate([moved, new_mean]), 0.5 * (joint + joint.T)


def absorb_fused_map(
    whole: WholeMap,
    ids: UInt32[np.ndarray, " K"],
    means: Float[np.ndarray, "K 2"],
    covariance: Float[np.ndarray, "k k"],
) -> WholeMap:
    """Replace the landmarks' marginal by the fused map; `carry_along` the rest."""
    _, in_whole, in_new = np.intersect1d(whole.ids, ids, return_indices=True)
    mean, joint = carry_along(
        whole.mean,
        whole.covariance,
        3 + _points(in_whole),
        means.ravel(),
        covariance,
        _points(in_new),
    )
    mean[2] = wrapped(mean[2])
    own = whole.ids[np.setdiff1d(np.arange(len(whole.ids)), in_whole)]
    return _by_id(np.concatenate([own, ids]), mean, joint)


def _points(index: Int64[np.ndarray, " k"]) -> Int64[np.ndarray, " j"]:
    return (2 * index[:, None] + np.arange(2)).ravel()


def _by_id(
    ids: UInt32[np.ndarray, " L"],
    mean: Float[np.ndarray, " n"],
    covariance: Float[np.ndarray, "n n"],
) -> WholeMap:
    if (ids[1:] < ids[:-1]).any():
        order = np.argsort(ids)
        place = np.concatenate([np.arange(3), 3 + _points(order)])
        ids, mean, covariance = ids[order], mean[place], covariance[np.ix_(place, place)]
    return WholeMap(ids, mean, 0.5 * (covariance + covariance.T))
