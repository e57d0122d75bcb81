"""Paths in the TUM format of evo and other trajectory tools.

One pose per line, `timestamp tx ty tz qx qy qz qw`: seconds, metres, a unit quaternion.
https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats
"""

from pathlib import Path as FilePath

import numpy as np

from teamslam.central.desk.evaluation.errors import Path, associate_truth
from teamslam.central.desk.evaluation.evaluation import evaluate
from teamslam.central.desk.evaluation.results import Evaluation
from teamslam.team.recording.reader import Log, LogError

KINDS = ("smoothed", "online")


def write_tum(path: Path, file: FilePath) -> None:
    """Write a planar path (z = 0) with all digits."""
    half = 0.5 * path.poses[:, 2]
    with file.open("w", encoding="ascii", newline="\n") as lines:
        lines.write("# timestamp tx ty tz qx qy qz qw\n")
        for stamp, (x, y, _), qz, qw in zip(
            path.stamps_ns.tolist(), path.poses, np.sin(half), np.cos(half), strict=True
        ):
            lines.write(f"{seconds(stamp)} {x:.17g} {y:.17g} 0 0 0 {qz:.17g} {qw:.17g}\n")


def seconds(stamp_ns: int) -> str:
    """Stamp in seconds with nanosecond digits."""
    whole, rest = divmod(abs(stamp_ns), 10**9)
    return f"{'-' * (stamp_ns < 0)}{whole}.{rest:09d}"


def write_trajectories(evaluation: Evaluation, folder: FilePath) -> list[FilePath]:
    """Write r1.smoothed.tum, r1.online.tum and r1.truth.tum of every robot; return the files.

    r1.smoothed.truth.tum and r1.online.truth.tum hold the true poses at the path's stamps.
    """
    written = []
    folder.mkdir(parents=True, exist_ok=True)
    for name, robot in evaluation.robots.items():
        paths = {"truth": robot.truth}
        for kind, path in zip(KINDS, (robot.smoothed_path, robot.online_path), strict=True):
            paths[kind] = path
            paths[f"{kind}.truth"] = associate_truth(path, robot.truth)[1]
        for kind, path in paths.items():
            if len(path.stamps_ns):
                written.append(folder / f"{name}.{kind}.tum")
                write_tum(path, written[-1])
    return written


def export_tum(log: Log, folder: FilePath) -> list[FilePath]:
    """Write every robot's paths; return the files. Raises LogError without a path."""
    written = write_trajectories(evaluate(log.samples()), folder)
    if not written:
        remedy = "`teamslam rerun` computes them, `--format csv` writes what there is"
        raise LogError(log.path, "no robot's path in it", remedy)
    return written
