"""Factor graph of the batch MAP in GTSAM (optional). Poses are perturbed on the right."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from teamslam.central.desk.evaluation.results import MapResult
from teamslam.sim.recorded.chains import Chain, Scan
from teamslam.team.config import Sensor
from teamslam.team.core import located, predicted
from teamslam.team.estimation.gaussian import Matrix
from teamslam.team.estimation.models import Increment
from teamslam.team.estimation.se2 import Point, Pose, tangent
from teamslam.team.extras import install_command
from teamslam.team.registry import NotInstalledError
from teamslam.team.shapes import Float

Poses = Float[np.ndarray, "K 3"]
_CHAIN = 2**32
FLOOR_SIGMAS = (1e-4, 2e-3, 1e-4)
"""Added to each motion (forward [m], left [m], turn [rad]), since its covariance may be singular.
"""
EXACT_SIGMA = 1e-5  # standard deviation of an exactly known initial pose [m, rad]


def load_gtsam() -> Any:
    """Import GTSAM; raises NotInstalledError."""
    try:
        import gtsam
    except ImportError:
        raise NotInstalledError(
            f"the batch optimum needs GTSAM: {install_command('batch-reference')}"
        ) from None
    return gtsam


def optimizer_of(gtsam: Any, graph: Any, initial: Any, iterations: int) -> Any:
    """Make a Levenberg-Marquardt optimiser."""
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(iterations)
    parameters.setRelativeErrorTol(1e-13)
    parameters.setAbsoluteErrorTol(1e-11)
    return gtsam.LevenbergMarquardtOptimizer(graph, initial, parameters)


def newton_step(gtsam: Any, linear: Any) -> tuple[Any, float]:
    """Newton step of a linear graph, with its length in sigmas."""
    step = linear.optimize()
    gain = linear.error(gtsam.VectorValues.Zero(step)) - linear.error(step)
    return step, float(np.sqrt(max(2.0 * gain, 0.0)))


def pose_key(chain: int, pose: int) -> int:
    """Key of a pose; a landmark's is its id < 2³²."""
    return (chain + 1) * _CHAIN + pose


def landmark_starts(
    chains: Sequence[Chain], poses: Sequence[Poses], joined: MapResult
) -> dict[int, Point]:
    """Positions of the joined map, else from the first measurement."""
    known = dict(zip(joined.ids.tolist(), joined.means, strict=True))
    found: dict[int, Point] = {}
    for chain, path in zip(chains, poses, strict=True):
        for pose, scan in zip(path[1:], chain.scans, strict=True):
            for i, r, b in zip(scan.ids.tolist(), scan.ranges, scan.bearings, strict=True):
                if i not in found:
                    found[i] = known[i] if i in known else located(pose, float(r), float(b))
    return found


def factor_graph(
    gtsam: Any,
    chains: Sequence[Chain],
    poses: Sequence[Poses],
    landmarks: Mapping[int, Point],
    robust_c: float | None,
) -> Any:
    """Make all factors, with the range noise at the joined solution's range.

    Without a known initial pose the first chain starts as joined.
    """
    graph = path_graph(gtsam, chains, poses)
    for c, (chain, path) in enumerate(zip(chains, poses, strict=True)):
        first = pose_key(c, 0)
        for i, scan in enumerate(chain.scans, 1):
            seen = scan, chain.config.sensor, path[i]
            add_scan(gtsam, graph, first + i, *seen, landmarks, robust_c)
    return graph


def add_scan(
    gtsam: Any,
    graph: Any,
    key: int,
    scan: Scan,
    sensor: Sensor,
    pose: Pose,
    landmarks: Mapping[int, Point],
    robust_c: float | None,
) -> None:
    """Add the factors of measurements from a pose, with noise at the predicted ranges."""
    seen = zip(scan.ids.tolist(), scan.ranges, scan.bearings, strict=True)
    for k, (landmark, r, b) in enumerate(seen):
        distance, _ = predicted(pose, landmarks[landmark])
        R = scan.noise(k, sensor, distance)[::-1, ::-1]
        model = under_loss(gtsam, gtsam.noiseModel.Gaussian.Covariance(R), robust_c)
        graph.push_back(gtsam.BearingRangeFactor2D(key, landmark, gtsam.Rot2(b), r, model))


def add_motion(gtsam: Any, graph: Any, before: int, after: int, increment: Increment) -> None:
    """Add the factor of the motion between two poses."""
    floor = np.diag(FLOOR_SIGMAS) ** 2
    model = gtsam.noiseModel.Gaussian.Covariance(increment.covariance + floor)
    graph.push_back(gtsam.BetweenFactorPose2(before, after, gtsam.Pose2(*increment.mean), model))


def joint_covariance(marginals: Any, landmarks: Sequence[int]) -> Matrix:
    """Joint covariance of at least one landmark."""
    if len(landmarks) == 1:
        covariance = np.asarray(marginals.marginalCovariance(landmarks[0]))
    else:
        joint = marginals.jointMarginalCovariance(landmarks)
        covariance = np.block([[joint.at(i, k) for k in landmarks] for i in landmarks])
    return np.asarray(0.5 * (covariance + covariance.T))


def path_graph(gtsam: Any, chains: Sequence[Chain], poses: Sequence[Poses]) -> Any:
    """Make the factors of initial poses and odometry."""
    graph = gtsam.NonlinearFactorGraph()
    anyone = any(chain.start is not None for chain in chains)
    for c, (chain, path) in enumerate(zip(chains, poses, strict=True)):
        first = pose_key(c, 0)
        start = chain.start if anyone or c > 0 else path[0]
        if start is not None:
            graph.push_back(start_factor(gtsam, first, start, chain.start_covariance))
        for i, increment in enumerate(chain.increments):
            add_motion(gtsam, graph, first + i, first + i + 1, increment)
    return graph


def under_loss(gtsam: Any, model: Any, c: float | None) -> Any:
    """Add a Cauchy loss of scale c, if any."""
    if c is None:
        return model
    return gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Cauchy.Create(c), model)


def start_factor(gtsam: Any, key: int, start: Pose, covariance: Matrix | None) -> Any:
    """Prior of the initial pose, rotated into the tangent space."""
    if covariance is None:
        model = gtsam.noiseModel.Isotropic.Sigma(3, EXACT_SIGMA)
    else:
        turn = tangent(start[2])
        model = gtsam.noiseModel.Gaussian.Covariance(turn.T @ covariance @ turn)
    return gtsam.PriorFactorPose2(key, gtsam.Pose2(*start), model)


def values_of(gtsam: Any, poses: Sequence[Poses], landmarks: Mapping[int, Point]) -> Any:
    """Poses and landmarks as GTSAM values."""
    values = gtsam.Values()
    for c, path in enumerate(poses):
        for i, pose in enumerate(path):
            values.insert(pose_key(c, i), gtsam.Pose2(*pose))
    for landmark, position in landmarks.items():
        values.insert(landmark, np.asarray(position))
    return values
