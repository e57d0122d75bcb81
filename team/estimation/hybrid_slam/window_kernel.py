"""A keyframe of a window in one compiled call: its innovation, resampling, the particles' step.

A call of a kernel from Python costs as much as some hundred particles' arithmetic: each array that
goes in or comes out, and each array in between that Python makes.
"""

import numpy as np
from jaxtyping import Float, Int64, UInt32

from team.estimation.compiled import compiled
from team.estimation.hybrid_slam.fastslam import (
    Arrays,
    Seen,
    copies_of,
    effective_sample_size,
    particles_after,
    systematic_parents,
)
from team.estimation.hybrid_slam.innovation_kernel import predictive_of_known
from team.estimation.placing import put, put_block
from team.estimation.scans import SENSOR, Own

Record = tuple[Int64[np.ndarray, " N"], UInt32[np.ndarray, " N"], Float[np.ndarray, "N 2"], Own]
"""Of each measurement of a window its keyframe, landmark, (range, bearing) and claimed noise."""
NO_RESAMPLING = -1.0


@compiled
def advanced_by(
    particles: Arrays,
    paths: Float[np.ndarray, "K M 3"],
    record: Record,
    motion: tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]],
    seen: Seen,
    drawn: tuple[float, Float[np.ndarray, "M 3"]],
    how: tuple[tuple[float, float, float], bool],
) -> tuple[Arrays, Float[np.ndarray, "K+1 M 3"], Record, float, float, int]:
    """The particles, paths and record after a keyframe; the number of effective particles, and the
    normalised square of the innovation with its degrees of freedom.

    drawn: the uniform number that resamples, or NO_RESAMPLING, and the normal ones. how: the
    sensor's variances, and whether the proposal is that of FastSLAM 2.0. The square is NaN as in
    `predictive_of_known`; there are no poses as in `particles_after`.
    """
    uniform, normals = drawn
    sensor, improved = how
    poses, log_weights, known, means, covariances = particles
    ids, ranges, bearings, own = seen
    squared, error, _ = predictive_of_known(
        poses, log_weights, means, covariances, known, motion[0], motion[1], ids, ranges,
        bearings, sensor, own,
    )  # fmt: skip
    lines = paths
    if uniform >= 0.0:
        parents = systematic_parents(log_weights, uniform)
        particles, lines = copies_of(particles, parents), _descent(paths, parents)
    after, _ = particles_after(particles, motion, normals, seen, sensor, improved)
    effective = effective_sample_size(after[1])
    record = _with(record, len(paths), seen)
    return after, _longer(lines, after[0]), record, effective, squared, len(error)


@compiled
def _descent(
    paths: Float[np.ndarray, "K M 3"], parents: Int64[np.ndarray, " M"]
) -> Float[np.ndarray, "K M 3"]:
    """The path of each particle's parent."""
    lines = np.empty_like(paths)
    for k in range(len(paths)):
        for i in range(len(parents)):
            for j in range(3):
                lines[k, i, j] = paths[k, parents[i], j]
    return lines


@compiled
def _longer(
    paths: Float[np.ndarray, "K M 3"], poses: Float[np.ndarray, "M 3"]
) -> Float[np.ndarray, "K+1 M 3"]:
    """The paths with one more pose each."""
    longer = np.empty((len(paths) + 1, paths.shape[1], 3))
    flat = longer.reshape(longer.size)
    put(flat, 0, paths.reshape(paths.size))
    put(flat, paths.size, poses.reshape(poses.size))
    return longer


@compiled
def _with(record: Record, keyframe: int, seen: Seen) -> Record:
    """The record with the measurements of one more keyframe.

    Where only some bring covariances, the others have form SENSOR (`scans.together`).
    """
    keyframes, landmarks, measurements, owns = record
    ids, ranges, bearings, own = seen
    before, count = len(keyframes), len(keyframes) + len(ids)
    of_all, all_ids = np.empty(count, np.int64), np.empty(count, np.uint32)
    read = np.empty((count, 2))
    put(of_all, 0, keyframes)
    put(all_ids, 0, landmarks)
    put(all_ids, before, ids)
    put_block(read, 0, 0, measurements)
    for k in range(len(ids)):
        of_all[before + k] = keyframe
        read[before + k, 0], read[before + k, 1] = ranges[k], bearings[k]
    noises = np.zeros((count, 4 if owns.size or own.size else 0))
    for k in range(len(noises) if noises.size else 0):
        noises[k, 3] = SENSOR
    if noises.size:
        put_block(noises, 0, 0, owns)
        put_block(noises, before, 0, own)
    return of_all, all_ids, read, noises
