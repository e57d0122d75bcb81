"""Measurement factors of the batch MAP with persistent errors as states.

A measurement (range r, bearing b) of a landmark at distance d from robot k at time t is
    b = β(x, l) + bias_b + σ_b √(1 − w_b) e_b(t) + σ_b √w_b ε,
    r = (1 + bias_r) d(x, l) + offset + σ_r √(1 − w_r) e_r(t) + σ_r √w_r ε,  ε ~ N(0, 1),
with white shares w and a Gauss-Markov process e of each robot and landmark: e(t') = a e(t) + √(1 −
a²) ε, a = exp(−(t' − t)/τ). Biases have the centre's priors. A measurement's own covariance
replaces all of its noise, as white.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from teamslam.sim.recorded.chains import Chain
from teamslam.sim.studies.batch_reference.graph import Poses, path_graph, pose_key, under_loss
from teamslam.team.config import BiasSigmas, Sensor
from teamslam.team.core import NEAREST_M, predicted
from teamslam.team.estimation.se2 import Point, wrapped
from teamslam.team.shapes import Float

BIASES = ("bearing", "range_offset", "range_scale")  # sensor biases, in state order
FORGOTTEN = 1e-3  # correlation below which the error process begins anew
_ERRORS = 2**56
_BIASES = 2**57
_BASES = 2**58
PINNED_SIGMA = 1e-6
"""Standard deviation [m, rad] between base and mounted sensor: the least for GTSAM."""


class _Look(NamedTuple):
    key: int
    chain: int
    pose: int
    landmark: int
    distance: float
    bearing: float
    before: int | None
    gap_s: float
    number: int


def bias_key(chain: int) -> int:
    """Key of (bearing [rad], range offset [m], range scale) biases."""
    return _BIASES + chain


def _detections_of(chains: Sequence[Chain]) -> list[_Look]:
    looks: list[_Look] = []
    for c, chain in enumerate(chains):
        last: dict[int, tuple[int, int]] = {}
        for i, scan in enumerate(chain.scans, 1):
            stamp_ns = int(chain.stamps_ns[i])
            seen = zip(scan.ids.tolist(), scan.ranges, scan.bearings, strict=True)
            for number, (landmark, r, b) in enumerate(seen):
                key = _ERRORS + len(looks)
                before, then_ns = last.get(landmark, (None, stamp_ns))
                gap_s = 1e-9 * (stamp_ns - then_ns)
                looks.append(
                    _Look(
                        key=key,
                        chain=c,
                        pose=i,
                        landmark=landmark,
                        distance=float(r),
                        bearing=float(b),
                        before=before,
                        gap_s=gap_s,
                        number=number,
                    )
                )
                last[landmark] = key, stamp_ns
    return looks


def profile_graph(
    gtsam: Any,
    chains: Sequence[Chain],
    poses: Sequence[Poses],
    landmarks: dict[int, Point],
    robust_c: float | None,
    sigmas: BiasSigmas,
) -> Any:
    """Make all factors. The Cauchy loss of scale c is on √(χ²/2) of each measurement."""
    graph = path_graph(gtsam, chains, poses)
    loss = None if robust_c is None else math.sqrt(2.0) * robust_c
    for c, chain in enumerate(chains):
        biases = chain.config.front_end.biases
        if has_biases(chain):
            deviations = [getattr(sigmas, b) if b in biases else 1e-6 for b in BIASES]
            model = gtsam.noiseModel.Diagonal.Sigmas(np.array(deviations))
            graph.push_back(gtsam.PriorFactorPoint3(bias_key(c), np.zeros(3), model))
    for look in _detections_of(chains):
        sensor = chains[look.chain].config.sensor
        graph.push_back(_process_factor(gtsam, look, sensor))
        distance, _ = predicted(poses[look.chain][look.pose], landmarks[look.landmark])
        scan = chains[look.chain].scans[look.pose - 1]
        R = scan.noise(look.number, sensor, distance)[::-1, ::-1]
        white = np.array([sensor.bearing_white, sensor.range_white])
        if scan.own.size:  # a detector's covariance is of one measurement
            white = np.ones(2)
        variances = np.diag(R)
        model = (
            gtsam.noiseModel.Gaussian.Covariance(R)
            if scan.own.size
            else gtsam.noiseModel.Diagonal.Variances(variances * white)
        )
        keys = [pose_key(look.chain, look.pose), look.landmark, look.key]
        if has_biases(chains[look.chain]):
            keys.append(bias_key(look.chain))
        measurement = _measurement(look, keys, np.sqrt(variances * (1.0 - white)))
        graph.push_back(gtsam.CustomFactor(under_loss(gtsam, model, loss), keys, measurement))
    for factor in _sighting_factors(gtsam, chains, loss):
        graph.push_back(factor)
    return graph


def has_biases(chain: Chain) -> bool:
    """Whether this robot's sensor has biases."""
    return bool(set(BIASES) & set(chain.config.front_end.biases))


def add_errors(gtsam: Any, values: Any, chains: Sequence[Chain]) -> Any:
    """Add zero error states and biases, and the bases."""
    for c, i in _bases(chains):
        pose = values.atPose2(pose_key(c, i)).compose(gtsam.Pose2(*chains[c].mount).inverse())
        values.insert(_base_key(chains[c], c, i), pose)
    for look in _detections_of(chains):
        values.insert(look.key, np.zeros(2))
    for c, chain in enumerate(chains):
        if has_biases(chain):
            values.insert(bias_key(c), np.zeros(3))
    return values


def _measurement(
    look: _Look, keys: Sequence[int], scales: Float[np.ndarray, "2"]
) -> Callable[[Any, Any, Any], np.ndarray]:
    """Residual (bearing [rad], range [m]), and derivatives by `keys`."""
    across, along = scales.tolist()

    def residual(_: Any, values: Any, derivatives: Any) -> np.ndarray:
        pose = values.atPose2(keys[0])
        point, e = values.atPoint2(keys[1]), values.atPoint2(keys[2])
        turned, offset, scaled = values.atPoint3(keys[3]) if len(keys) > 3 else (0.0, 0.0, 0.0)
        dx, dy = point[0] - pose.x(), point[1] - pose.y()
        distance = max(math.hypot(dx, dy), NEAREST_M)
        direction = math.atan2(dy, dx)
        bearing = direction - pose.theta()
        k = 1.0 + scaled
        if derivatives is not None:
            c, s = math.cos(bearing), math.sin(bearing)
            derivatives[0] = np.array([[s / distance, -c / distance, -1.0], [-k * c, -k * s, 0.0]])
            c, s = math.cos(direction), math.sin(direction)
            derivatives[1] = np.array([[-s / distance, c / distance], [k * c, k * s]])
            derivatives[2] = np.array([[across, 0.0], [0.0, along]])
            if len(keys) > 3:
                derivatives[3] = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, distance]])
        return np.array(
            [
                wrapped(bearing + turned + across * e[0] - look.bearing),
                k * distance + offset + along * e[1] - look.distance,
            ]
        )

    return residual


def _process_factor(gtsam: Any, look: _Look, sensor: Sensor) -> Any:
    """e(t') − a e(t) ~ N(0, 1 − a²) of (bearing, range); the first has no e(t)."""
    times = (sensor.bearing_correlation_s, sensor.range_correlation_s)
    a = np.array([math.exp(-look.gap_s / tau) if tau > 0.0 else 0.0 for tau in times])
    if look.before is None or a.max() < FORGOTTEN:
        unit = gtsam.noiseModel.Isotropic.Sigma(2, 1.0)
        return gtsam.PriorFactorPoint2(look.key, np.zeros(2), unit)
    innovation = np.sqrt(np.maximum(1.0 - a * a, 1e-6))
    A, B = np.diag(-a / innovation), np.diag(1.0 / innovation)
    unit = gtsam.noiseModel.Unit.Create(2)
    linear = gtsam.JacobianFactor(look.before, A, look.key, B, np.zeros(2), unit)
    at = gtsam.Values()
    for key in (look.before, look.key):
        at.insert(key, np.zeros(2))
    return gtsam.LinearContainerFactor(linear, at)


def _base_key(chain: Chain, number: int, pose: int) -> int:
    own = pose_key(number, pose)
    return _BASES + own if chain.config.sensor.is_mounted else own


def _bases(chains: Sequence[Chain]) -> list[tuple[int, int]]:
    times = {sighting.stamp_ns for chain in chains for sighting in chain.sightings}
    return [
        (c, i)
        for c, chain in enumerate(chains)
        if chain.config.sensor.is_mounted
        for i, stamp_ns in enumerate(chain.stamps_ns.tolist())
        if stamp_ns in times
    ]


def _sighting_factors(gtsam: Any, chains: Sequence[Chain], loss: float | None) -> list[Any]:
    keys = {
        (chain.config.id, int(stamp)): _base_key(chain, c, i)
        for c, chain in enumerate(chains)
        for i, stamp in enumerate(chain.stamps_ns)
    }
    factors = []
    for c, i in _bases(chains):
        model = gtsam.noiseModel.Isotropic.Sigma(3, PINNED_SIGMA)
        mount = gtsam.Pose2(*chains[c].mount)
        base, sensor = _base_key(chains[c], c, i), pose_key(c, i)
        factors.append(gtsam.BetweenFactorPose2(base, sensor, mount, model))
    for chain in chains:
        for sighting in chain.sightings:
            here = keys.get((chain.config.id, sighting.stamp_ns))
            there = keys.get((sighting.teammate, sighting.stamp_ns))
            if here is not None and there is not None:
                model = gtsam.noiseModel.Gaussian.Covariance(sighting.covariance[::-1, ::-1])
                distance, bearing = sighting.measurement
                factors.append(
                    gtsam.BearingRangeFactorPose2(
                        here,
                        there,
                        gtsam.Rot2(float(bearing)),
                        float(distance),
                        under_loss(gtsam, model, loss),
                    )
                )
    return factors
