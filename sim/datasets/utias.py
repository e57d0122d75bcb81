"""UTIAS multi-robot cooperative localisation and mapping data sets (MRCLAM).

Leung, Halpern, Barfoot, Liu, IJRR 30(8):969-974, 2011. A set has 17 text files: `Barcodes.dat`,
`Landmark_Groundtruth.dat`, and odometry, measurements and ground truth of each robot N.
Measurements name a *barcode*; `Barcodes.dat` gives its subject: a robot (its number) or a landmark.
Dropped rows are counted in notes.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from teamslam.sim.datasets.errata import erratum_of
from teamslam.sim.datasets.tables import (
    EXPECTED,
    DatasetError,
    File,
    open_data_set,
    optional_table,
    table,
)
from teamslam.sim.datasets.utias_log import Log, log_of, present_robots
from teamslam.sim.datasets.utias_rows import start_pose
from teamslam.sim.world.config import UtiasWorld, starts_unknown
from teamslam.sim.world.streams import RobotStream, StartPose, WorldStreams
from teamslam.team.config import RobotConfig
from teamslam.team.shapes import Float, UInt32

ROBOTS = 5
"""Subjects 1 … 5 are robots, even without files; landmarks follow."""

BARCODES = ("subject", "barcode")
SURVEY = ("subject", "x [m]", "y [m]", "x std-dev [m]", "y std-dev [m]")


def utias(world: UtiasWorld, robots: Sequence[RobotConfig]) -> WorldStreams:
    """Read the measurements of robots r1, r2, … (data set numbers); raises DatasetError.

    Odometry row k acts from its time to the next row's, delayed by odometry_delay_s and the robot's
    clock_offset_s, which the robot corrects. Stamps are nanoseconds since 1970. A robot's initial
    pose is its ground truth at its first measurement, with the world's start sigmas.
    """
    if not world.path:
        raise DatasetError(f"no data set given: name it with --dataset or world.path; {EXPECTED}")
    with open_data_set(world.path, "Barcodes.dat") as files:
        clocks = {robot.id: round(robot.clock_offset_s * 1e9) for robot in robots}
        return _streams(world, clocks, files)


def _streams(
    world: UtiasWorld, clocks: Mapping[str, int], files: Mapping[str, File]
) -> WorldStreams:
    present = present_robots(files)
    if not present:
        raise DatasetError(f"{world.path}: no RobotN_Odometry.dat in it; {EXPECTED}")
    last_robot = max(ROBOTS, *present)
    barcodes = table(files["Barcodes.dat"], BARCODES)
    survey = optional_table(files, "Landmark_Groundtruth.dat", SURVEY)
    subject_of = _subjects(barcodes)
    notes = []
    erratum = erratum_of(barcodes, survey) if world.errata else None
    if erratum:
        notes.append(erratum.note)
        swap = erratum.subjects
        subject_of = {code: swap.get(subject, subject) for code, subject in subject_of.items()}
    ids, positions = _landmarks(survey, last_robot)
    if not len(ids):
        notes.append("no landmark ground truth: the map's error can not be computed")
    delay_ns = round(world.odometry_delay_s * 1e9)
    logs = [
        log_of(robot, files, subject_of, delay_ns + offset_ns)
        for robot, offset_ns in clocks.items()
    ]
    if world.duration_s is not None:
        end_ns = min(log.start_ns for log in logs) + round(world.duration_s * 1e9)
        logs = [log.until(end_ns) for log in logs]
    return WorldStreams(
        streams=tuple(_stream(log, world, clocks, last_robot) for log in logs),
        landmark_ids=ids,
        landmarks=positions if len(ids) else None,
        source=f"UTIAS data set {Path(world.path).name}",
        notes=tuple(notes),
    )


def _subjects(barcodes: Float[np.ndarray, "B 2"]) -> dict[int, int]:
    if not len(barcodes) or np.any(barcodes != np.rint(barcodes)) or np.any(barcodes < 0):
        raise DatasetError("Barcodes.dat: expected rows of two whole numbers, subject and barcode")
    subject_of = {int(code): int(subject) for subject, code in barcodes}
    if len(subject_of) < len(barcodes):
        raise DatasetError("Barcodes.dat: one barcode has two subjects")
    return subject_of


def _landmarks(
    survey: Float[np.ndarray, "L 5"], last_robot: int
) -> tuple[UInt32[np.ndarray, " M"], Float[np.ndarray, "M 2"]]:
    survey = survey[survey[:, 0] > last_robot]
    survey = survey[np.argsort(survey[:, 0], kind="stable")]
    if np.any(np.diff(survey[:, 0]) == 0.0):
        raise DatasetError("Landmark_Groundtruth.dat: one landmark has two positions")
    return survey[:, 0].astype(np.uint32), survey[:, 1:3].copy()


def _stream(log: Log, world: UtiasWorld, clocks: Mapping[str, int], last_robot: int) -> RobotStream:
    robots = list(clocks)
    numbers = np.array([int(robot[1:]) for robot in robots], dtype=np.uint32)
    log = log.without(log.measurements.ids == log.subject, "of itself")
    subjects = log.measurements.ids
    stranger = (subjects <= last_robot) & ~np.isin(subjects, numbers)
    log = log.without(stranger, "of a robot that is not in the team")
    seen = log.measurements.where(log.measurements.ids > last_robot)
    teammates = log.measurements.where(log.measurements.ids <= last_robot)
    index = (teammates.ids[:, np.newaxis] == numbers).argmax(axis=1).astype(np.uint32)
    return RobotStream(
        robot=log.robot,
        start_ns=log.start_ns,
        start=_start(world, log),
        intervals=log.intervals,
        landmark_detections=seen.grouped(),
        teammate_detections=replace(teammates, ids=index).grouped(),
        teammates=tuple(robots),
        truth_ns=log.truth_ns if len(log.truth) else None,
        truth=log.truth if len(log.truth) else None,
        notes=(*log.notes, *_truth_notes(log)),
        clock_offset_ns=clocks[log.robot],
    )


def _start(world: UtiasWorld, log: Log) -> StartPose | None:
    pose = start_pose(log.truth_ns, log.truth, log.start_ns)
    if pose is None or starts_unknown(world, log.robot):
        return None
    if world.start_sigma_m == 0.0:
        return StartPose(pose, None)
    sigmas = np.array([world.start_sigma_m, world.start_sigma_m, world.start_sigma_rad])
    return StartPose(pose, np.diag(sigmas**2))


def _truth_notes(log: Log) -> list[str]:
    """Notes on figures without timely ground truth."""
    notes = []
    if start_pose(log.truth_ns, log.truth, log.start_ns) is None:
        notes.append("no ground truth at its first measurement: its start pose is not known")
    ends = log.intervals.end_ns[-1:]
    if len(log.truth) and len(ends) and ends[0] - log.truth_ns[-1] > 10**9:
        seconds = (ends[0] - log.truth_ns[-1]) * 1e-9
        notes.append(f"ground truth ends {seconds:.0f} s before the odometry")
    return notes
