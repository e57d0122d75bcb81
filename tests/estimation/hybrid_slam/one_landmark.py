import numpy as np

from teamslam.team import core
from teamslam.team.estimation.models import Increment, Noise


def updated(mean, packed, pose, seen, sensor, own) -> tuple[np.ndarray, np.ndarray, float]:
    """Update a landmark; also the log-likelihood.

    seen: (ranges, bearings), the first is used. sensor: (σ_range², σ_range_per_m², σ_bearing²).
    """
    known = np.array([7], np.uint32), mean[None, None], packed[None, None]
    return _stepped(pose, known, seen, sensor, own)


def _stepped(pose, known, seen, sensor, own) -> tuple[np.ndarray, np.ndarray, float]:
    noise = Noise(sensor[0], sensor[1], 1.0, sensor[2], 1.0)
    at = np.array([pose], np.float64), np.zeros(1)
    window = core.Window.of_particles(*at, *known, noise, improved=False)
    ids, ranges, bearings = np.array([7], np.uint32), seen[0][:1], seen[1][:1]
    scan = core.Scan(ids, ranges, bearings, own[:1])
    log = window.step(Increment.identity().keyframe(scan), np.zeros((1, 3)))
    _, _, _, means, covariances = window.particles()
    return means[0, 0], covariances[0, 0], log
