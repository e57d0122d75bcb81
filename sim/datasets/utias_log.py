"""One robot of a UTIAS data set: three files by time, cut at unknown stretches."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from teamslam.sim.datasets.scans import Scans, count_note
from teamslam.sim.datasets.tables import DatasetError, File, optional_table
from teamslam.sim.datasets.utias_rows import intervals_of, measurements_of, truth_of
from teamslam.sim.world.streams import Intervals
from teamslam.team.shapes import Bool, Float, Int64

TRUTH = ("time [s]", "x [m]", "y [m]", "orientation [rad]")
ODOMETRY = ("time [s]", "forward velocity [m/s]", "angular velocity [rad/s]")
MEASUREMENT = ("time [s]", "barcode", "range [m]", "bearing [rad]")


@dataclass(frozen=True)
class Log:
    """Odometry, measurements by subject and truth; start_ns: start of the first measurement."""

    robot: str
    subject: int
    start_ns: int
    intervals: Intervals
    measurements: Scans
    truth_ns: Int64[np.ndarray, " T"]
    truth: Float[np.ndarray, "T 3"]
    notes: tuple[str, ...]

    def without(self, dropped: Bool[np.ndarray, " R"], reason: str) -> "Log":
        """Drop measurements, with a note that counts them."""
        note = count_note(int(np.count_nonzero(dropped)), "measurement", f"dropped: {reason}")
        notes = (*self.notes, note) if note else self.notes
        return replace(self, measurements=self.measurements.where(~dropped), notes=notes)

    def until(self, end_ns: int) -> "Log":
        """Log up to the last odometry interval that ends by end_ns."""
        intervals = self.intervals.where(self.intervals.end_ns <= end_ns)
        last_ns = int(intervals.end_ns[-1]) if len(intervals.end_ns) else end_ns
        samples = int(np.searchsorted(self.truth_ns, end_ns)) + 1
        return replace(
            self,
            intervals=intervals,
            measurements=self.measurements.where(self.measurements.stamps_ns <= last_ns),
            truth_ns=self.truth_ns[:samples],
            truth=self.truth[:samples],
        )


def present_robots(files: Mapping[str, File]) -> list[int]:
    """Numbers of the robots with an odometry or measurement file."""
    matches = (re.fullmatch(r"Robot([1-9]\d*)_(Odometry|Measurement)\.dat", name) for name in files)
    return sorted({int(match[1]) for match in matches if match})


def log_of(
    robot: str, files: Mapping[str, File], subject_of: Mapping[int, int], delay_ns: int
) -> Log:
    """Files of a robot r1, r2, …; subject_of: barcode → subject. Raises DatasetError."""
    present = present_robots(files)
    subject = int(robot[1:]) if re.fullmatch(r"r[1-9]\d*", robot) else 0
    if subject not in present:
        known = ", ".join(f"r{number}" for number in present)
        raise DatasetError(
            f"the data set has no measurements of a robot {robot}; it has {known}: give "
            "--robots, or a scenario of its own, such as `teamslam simulate` writes beside it"
        )
    odometry = optional_table(files, f"Robot{subject}_Odometry.dat", ODOMETRY)
    measured = optional_table(files, f"Robot{subject}_Measurement.dat", MEASUREMENT)
    true_rows = optional_table(files, f"Robot{subject}_Groundtruth.dat", TRUTH)
    intervals, odometry_notes = intervals_of(odometry, delay_ns)
    measurements, measurement_notes = measurements_of(measured, subject_of)
    truth_ns, truth, truth_notes = truth_of(true_rows)
    missing = (
        "no odometry: only its observations are used" if not len(intervals.end_ns) else "",
        "no measurements: only its odometry is given" if not len(measurements.stamps_ns) else "",
        "no ground truth: its trajectory's error can not be computed" if not len(truth) else "",
    )
    if missing[0] and missing[1]:
        raise DatasetError(f"robot {robot}: neither odometry nor measurements in its files")
    begins = (intervals.end_ns[:1] - intervals.duration_ns[:1], measurements.stamps_ns[:1])
    log = Log(
        robot=robot,
        subject=subject,
        start_ns=int(np.concatenate(begins).min()),
        intervals=intervals,
        measurements=measurements,
        truth_ns=truth_ns,
        truth=truth,
        notes=(*filter(None, missing), *odometry_notes, *measurement_notes, *truth_notes),
    )
    if missing[0]:
        return log
    late = measurements.stamps_ns > intervals.end_ns[-1]
    return log.without(late, "after its last odometry, where its motion is not known")
