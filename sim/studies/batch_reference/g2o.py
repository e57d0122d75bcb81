"""Write the batch problem of a log as a g2o file, for other optimisers.

VERTEX_SE2 are sensor poses at keyframes, VERTEX_XY landmarks, both from the joined map and the
odometry between; FIX holds exactly known initial poses. EDGE_SE2 is the odometry, EDGE_SE2_XY a
measurement as a point in the sensor's frame, with the first-order covariance of range and bearing
at the joined map's range. Up to that linearisation it is the problem of `factor_graph`.
https://github.com/RainerKuemmerle/g2o/wiki/File-Format-SLAM-2D
"""

from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from teamslam.central.desk.evaluation.evaluation import evaluate
from teamslam.sim.studies.batch_reference.graph import FLOOR_SIGMAS, landmark_starts
from teamslam.sim.studies.batch_reference.measurements import (
    BatchReferenceError,
    Chain,
    anchored,
    chains_of,
)
from teamslam.sim.studies.batch_reference.reference import placed
from teamslam.team.estimation.gaussian import Matrix
from teamslam.team.estimation.models import predicted
from teamslam.team.estimation.se2 import Point
from teamslam.team.shapes import Float
from teamslam.team.wire.bus import Sample

Poses = Float[np.ndarray, "K 3"]


def g2o_lines(samples: Iterable[Sample]) -> Iterator[str]:
    """Lines of the file.

    Raises BatchReferenceError without a scenario or a joined map.
    """
    recorded = list(samples)
    run = evaluate(recorded)
    if run.scenario is None or run.map is None:
        raise BatchReferenceError(
            "the log has no scenario or no final map: record a run to its end"
        )
    chains, anchors, _ = placed(chains_of(recorded, run.scenario), run)
    paths = [anchored(chain, anchor)[2] for chain, anchor in zip(chains, anchors, strict=True)]
    landmarks = landmark_starts(chains, paths, run.map)
    vertex = {landmark: k for k, landmark in enumerate(sorted(landmarks))}
    for landmark, k in vertex.items():
        yield f"# landmark {landmark}"
        yield f"VERTEX_XY {k} {_numbers(landmarks[landmark])}"
    first = len(vertex)
    for chain, path in zip(chains, paths, strict=True):
        yield f"# robot {chain.config.id}, incarnation {chain.incarnation}"
        for k, pose in enumerate(path):
            yield f"VERTEX_SE2 {first + k} {_numbers(pose)}"
        if chain.start is not None and chain.start_covariance is None:
            yield f"FIX {first}"
        yield from _odometry(chain, first)
        yield from _measurements(chain, path, first, landmarks, vertex)
        first += len(path)


def _odometry(chain: Chain, first: int) -> Iterator[str]:
    floor = np.diag(FLOOR_SIGMAS) ** 2
    for k, increment in enumerate(chain.increments):
        information = np.linalg.inv(increment.covariance + floor)
        yield (
            f"EDGE_SE2 {first + k} {first + k + 1} {_numbers(increment.mean)} {_upper(information)}"
        )


def _measurements(
    chain: Chain,
    path: Poses,
    first: int,
    landmarks: dict[int, Point],
    vertex: dict[int, int],
) -> Iterator[str]:
    for k, scan in enumerate(chain.scans, 1):
        seen = zip(scan.ids.tolist(), scan.ranges, scan.bearings, strict=True)
        for i, (landmark, r, b) in enumerate(seen):
            distance, _ = predicted(path[k], landmarks[landmark])
            c, s = np.cos(b), np.sin(b)
            J = np.array([[c, -r * s], [s, r * c]])
            R = scan.noise(i, chain.config.sensor, distance)
            information = np.linalg.inv(J @ R @ J.T)
            point = _numbers((r * c, r * s))
            yield f"EDGE_SE2_XY {first + k} {vertex[landmark]} {point} {_upper(information)}"


def _upper(information: Matrix) -> str:
    return _numbers(information[np.triu_indices(len(information))])


def _numbers(values: Sequence[float] | np.ndarray) -> str:
    return " ".join(f"{value:.17g}" for value in values)
