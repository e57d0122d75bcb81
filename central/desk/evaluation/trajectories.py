"""Absolute and relative path errors, as defined by evo.

Sturm et al., A benchmark for the evaluation of RGB-D SLAM systems, IROS 2012. `evo_ape` and
`evo_rpe` give the same figures for files of `teamslam.central.desk.export.tum`.
"""

from dataclasses import dataclass

import numpy as np

from teamslam.central.desk.evaluation.errors import (
    Path,
    distance_rmse,
    interpolate_truth,
    on_circle,
    rigid_alignment,
    rms,
    transform_points,
)
from teamslam.team.shapes import Float


@dataclass(frozen=True)
class TrajectoryErrors:
    """RMS over poses with truth [m], [rad]; rigid alignment without scale.

    ape_m, ape_rad: absolute, unaligned (evo: -r trans_part, angle_rad). ape_aligned_m,
    ape_aligned_rad: after the best position alignment (evo: -a). rpe_m, rpe_rad: motion between
    consecutive poses (evo: --delta 1 --delta_unit f).
    """

    poses: int
    ape_m: float
    ape_rad: float
    ape_aligned_m: float | None
    ape_aligned_rad: float | None
    rpe_m: float | None
    rpe_rad: float | None


def associate_truth(path: Path, truth: Path) -> tuple[Path, Path]:
    """Poses of the path with truth, and the true poses at these stamps."""
    poses, known = interpolate_truth(truth, path.stamps_ns)
    stamps = path.stamps_ns[known]
    return Path(stamps, path.poses[known]), Path(stamps, poses[known])


def trajectory_errors(path: Path, truth: Path) -> TrajectoryErrors | None:
    """Compute the errors of a path; None without truth."""
    estimate, true = (each.poses for each in associate_truth(path, truth))
    if not len(estimate):
        return None
    turned = on_circle(estimate[:, 2] - true[:, 2])
    motion = rigid_alignment(true[:, :2], estimate[:, :2])
    relative = _relative(_relative(true[:-1], true[1:]), _relative(estimate[:-1], estimate[1:]))
    return TrajectoryErrors(
        len(estimate),
        distance_rmse(estimate[:, :2], true[:, :2]),
        rms(turned),
        None
        if motion is None
        else distance_rmse(transform_points(motion, estimate[:, :2]), true[:, :2]),
        None if motion is None else rms(on_circle(turned + motion[2])),
        rms(np.hypot(relative[:, 0], relative[:, 1])) if len(relative) else None,
        rms(relative[:, 2]) if len(relative) else None,
    )


def _relative(a: Float[np.ndarray, "n 3"], b: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    dx, dy = (b[:, :2] - a[:, :2]).T
    c, s = np.cos(a[:, 2]), np.sin(a[:, 2])
    return np.column_stack((c * dx + s * dy, c * dy - s * dx, on_circle(b[:, 2] - a[:, 2])))
