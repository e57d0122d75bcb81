"""One measurement of one landmark by the blocks of the step of FastSLAM."""

import numpy as np

from team.estimation.hybrid_slam import blocks


def at(pose, ranges, bearings, sensor, own) -> tuple[np.ndarray, np.ndarray]:
    """A block whose particles all stand there, and the row of the first measurement."""
    block = np.zeros(blocks.OWN)
    blocks.load_poses(block, np.array([pose]), 0)
    blocks.drive(block, np.zeros(3))
    return block, blocks.measured(ranges, bearings, sensor, own)[0]


def stored(block: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The landmark of the first particle: its mean, and (xx, xy, yy)."""
    means, covariances = np.empty((1, 1, 2)), np.empty((1, 1, 3))
    blocks.store_landmark(block, means, covariances, 0, 0)
    return means[0, 0], covariances[0, 0]


def updated(mean, packed, block, row) -> tuple[np.ndarray, np.ndarray, float]:
    """A landmark after the measurement, and the log-likelihood of that."""
    blocks.load_landmark(block, mean[None, None], packed[None, None], 0, 0)
    blocks.predict(block, row)
    blocks.condition_landmark(block)
    return *stored(block), float(block[blocks.LOG_WEIGHT])
