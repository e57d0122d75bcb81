"""Decides which measurements of a window agree; measurements that no others confirm are outliers.

A measurement is good with probability 1 − ε and has the sensor's noise, or it is an outlier,
uniform over the sensor's range and field of view with density u. It is accepted if (1 − ε) p(z |
the other accepted ones, odometry) > ε u. A landmark is accepted if its measurements together reach
odds of EVIDENCE against being outliers and against being another landmark of the window under a
wrong identity. Only measurements of the window itself are used: a gate by a map or an earlier
window would keep rejecting correct measurements once that map is wrong, and would use measurements
twice.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int64, UInt32

from team import core
from team.config import Sensor
from team.estimation import dense
from team.estimation.hybrid_slam import consensus_kernel as kernel
from team.estimation.models import Increment, located, variances
from team.estimation.scans import Own
from team.estimation.se2 import compose

EVIDENCE = 4.605170185988092
"""Log odds that a landmark's accepted measurements must reach; by chance they do so in one case
of a hundred."""
MOTION_JITTER = (1e-6, 1e-6, 1e-8)
"""Added to each motion's variances [m², m², rad²]: noise of rank 2 has no information."""
ROUNDS = 5
"""Rounds of classifying and smoothing; it comes to rest in two or three."""

Taken = Bool[np.ndarray, " N"]


class _Measurements:
    """The measurements of the keyframes that have some, by landmark slot, and the motions
    between them.
    """

    def __init__(
        self,
        motions: Sequence[Increment],
        keyframes: Int64[np.ndarray, " N"],
        ids: UInt32[np.ndarray, " N"],
        measurements: Float[np.ndarray, "N 2"],
        own: Own,
        sensor: Sensor,
        outlier_share: float,
    ) -> None:
        seen, self.keyframes = np.unique(keyframes, return_inverse=True)
        _, self.slots = np.unique(ids, return_inverse=True)
        self.landmarks = int(self.slots.max()) + 1
        self.measurements, self.own = measurements, own
        self.sensor = variances(sensor)
        self.means, self.covariances = _between(motions, seen.tolist())
        reach = min(sensor.max_range, float(measurements[:, 0].max()))
        uniform = 1.0 / (reach * sensor.field_of_view)
        self.prior = core.log((1.0 - outlier_share) / outlier_share)
        self.odds = self.prior - core.log(uniform)
        """Added to log p(z): gives the log odds that the measurement is good."""


def agreeing(
    motions: Sequence[Increment],
    keyframes: Int64[np.ndarray, " N"],
    ids: UInt32[np.ndarray, " N"],
    measurements: Float[np.ndarray, "N 2"],
    own: Own,
    sensor: Sensor,
    outlier_share: float,
) -> Taken:
    """The measurements that agree with others of their landmark under the odometry alone.

    The measurement of a landmark that the others support best places it; it is accepted together
    with those that support it. motions[k] leads to keyframe k; measurements are calibrated; own:
    the noises that they claim; 0 < outlier_share < 1 is ε.
    """
    if not len(ids):
        return np.zeros(0, dtype=np.bool_)
    window = _Measurements(motions, keyframes, ids, measurements, own, sensor, outlier_share)
    return _agreeing(window)[0]


def confirmed(
    motions: Sequence[Increment],
    keyframes: Int64[np.ndarray, " N"],
    ids: UInt32[np.ndarray, " N"],
    measurements: Float[np.ndarray, "N 2"],
    own: Own,
    sensor: Sensor,
    outlier_share: float,
) -> Taken:
    """As `agreeing`, then by a smoother over the whole window until the classification is stable.

    The smoother estimates poses and landmarks by least squares over the odometry and the accepted
    measurements; then every measurement is compared with its prediction from the others. Where the
    normal equations have no solution in floating point, nothing is rejected.
    """
    if not len(ids):
        return np.zeros(0, dtype=np.bool_)
    window = _Measurements(motions, keyframes, ids, measurements, own, sensor, outlier_share)
    agreed, placed_by = _agreeing(window)
    taken = agreed
    path = np.zeros((len(window.means), 3))
    for k in range(1, len(path)):
        path[k] = compose(path[k - 1], window.means[k])
    landmarks = np.array(
        [located(path[window.keyframes[i]], *measurements[i].tolist()) for i in placed_by]
    ).reshape(-1, 2)
    metrics = dense.inverse(window.covariances + np.diag(MOTION_JITTER))
    for _ in range(ROUNDS):
        smoothed = _smoothed(window, path, landmarks, metrics, taken)
        if smoothed is None:
            return agreed
        path, landmarks, covariance = smoothed
        logs = kernel.left_out(
            path,
            landmarks,
            covariance,
            window.keyframes,
            window.slots,
            measurements,
            own,
            taken,
            window.sensor,
        )
        before, taken = taken, _judged(window, logs + window.odds, taken)
        if np.array_equal(before, taken):
            break
    of_others = _misread(window, path, landmarks, covariance, logs, taken)
    return np.asarray(taken & ~of_others)


def _between(
    motions: Sequence[Increment], seen: Sequence[int]
) -> tuple[Float[np.ndarray, "K 3"], Float[np.ndarray, "K 3 3"]]:
    """The motions between the keyframes of `seen`; the first one gets the zero motion."""
    means, covariances = np.zeros((len(seen), 3)), np.zeros((len(seen), 3, 3))
    for k in range(1, len(seen)):
        motion = motions[seen[k - 1] + 1]
        for further in motions[seen[k - 1] + 2 : seen[k] + 1]:
            motion = motion.then(further)
        means[k], covariances[k] = motion.mean, motion.covariance
    return means, covariances


def _agreeing(window: _Measurements) -> tuple[Taken, Int64[np.ndarray, " L"]]:
    """The measurements that agree, and for each landmark the measurement that places it best."""
    return kernel.agreement(
        *kernel.relative_motions(window.means, window.covariances),
        window.keyframes,
        window.slots,
        window.measurements,
        window.own,
        window.sensor,
        window.landmarks,
        (window.odds, EVIDENCE - window.prior),
    )


def _smoothed(
    window: _Measurements,
    path: Float[np.ndarray, "K 3"],
    landmarks: Float[np.ndarray, "L 2"],
    metrics: Float[np.ndarray, "K 3 3"],
    taken: Taken,
) -> tuple[Float[np.ndarray, "K 3"], Float[np.ndarray, "L 2"], Float[np.ndarray, "n n"]] | None:
    """Two Gauss-Newton steps and the covariance; a landmark without an accepted measurement stays
    unknown.

    Such a landmark gets the squared reach of the sensor as its variance. None where the normal
    equations are not positive definite.
    """
    unknown = np.bincount(window.slots[taken], minlength=window.landmarks) == 0
    free = 3 * (len(path) - 1) + np.flatnonzero(np.repeat(unknown, 2))
    far = core.squared(float(window.measurements[:, 0].max()))
    for _ in range(2):
        H, g = kernel.normal_equations(
            path, landmarks, window.means, metrics, window.keyframes, window.slots,
            window.measurements, window.own, taken, window.sensor,
        )  # fmt: skip
        H[free, free] = 1.0 / far
        try:
            covariance = dense.inverse_of_factored(dense.cholesky(H))
        except np.linalg.LinAlgError:
            return None
        if not np.isfinite(covariance).all():
            return None
        path, landmarks = kernel.filter_step(path, landmarks, dense.product(covariance, g))
    return path, landmarks, covariance


def _judged(window: _Measurements, odds: Float[np.ndarray, " N"], before: Taken) -> Taken:
    """The measurements with odds above even, of landmarks whose measurements have enough evidence.

    Each of k measurements is predicted by the k − 1 others, so their odds are weighted by (k −
    1)/k. A landmark that has lost all its measurements stays out.
    """
    earlier = np.bincount(window.slots[before], minlength=window.landmarks)
    taken = (odds > 0.0) & (earlier[window.slots] > 0)
    count = np.bincount(window.slots[taken], minlength=window.landmarks)
    total = np.bincount(window.slots[taken], odds[taken], minlength=window.landmarks)
    evidence = window.prior + total * (count - 1) / np.maximum(count, 1)
    return taken & ((count >= 2) & (evidence > EVIDENCE))[window.slots]


def _misread(
    window: _Measurements,
    path: Float[np.ndarray, "K 3"],
    landmarks: Float[np.ndarray, "L 2"],
    covariance: Float[np.ndarray, "n n"],
    logs: Float[np.ndarray, " N"],
    taken: Taken,
) -> Taken:
    """Measurements of landmarks that may be another landmark of the window under a wrong identity.

    If k measurements that agree are all of landmark m, read k times as l, each has the probability
    ε/(L − 1) p(z | m) for the L identities in the window, against (1 − ε) p(z | l) of its own, the
    first of which is uniform. They are accepted where the odds for l reach EVIDENCE.
    """
    count = np.bincount(window.slots[taken], minlength=window.landmarks)
    total = np.bincount(window.slots[taken], logs[taken], minlength=window.landmarks)
    names = np.arange(window.landmarks)
    doubtful = np.zeros(window.landmarks, dtype=np.bool_)
    own_name = window.prior + core.log(max(window.landmarks - 1, 1))
    for other in np.flatnonzero(count >= 2):
        as_other = kernel.left_out(
            path, landmarks, covariance, window.keyframes, np.full_like(window.slots, other),
            window.measurements, window.own, np.zeros_like(taken), window.sensor,
        )  # fmt: skip
        predicted = np.bincount(window.slots[taken], as_other[taken], minlength=window.landmarks)
        own = total * (count - 1) / np.maximum(count, 1) - (window.odds - window.prior)
        odds = count * own_name + own - predicted
        doubtful |= (count > 0) & (count <= count[other]) & (odds < EVIDENCE) & (names != other)
    return doubtful[window.slots]
