"""Compare CPU times of parts of a robot's step, in one run of seconds.

    python -m benchmarks.ratios [--rounds 7] [--json FILE]

in_a_run: an odometry interval through the segmenter, against direct composition. improved: a step
of FastSLAM 2.0 against one of 1.0, 100 particles and four known landmarks. innovation: the NIS of
that step against the step. node: a step of a robot's node, its odometry, a scan of four landmarks
and a pose, against that step of FastSLAM 2.0. node_us: an odometry interval at 70 Hz, decoded and
processed by a robot's node [us], with its share of a scan every half second and of keyframes;
machine-dependent, without a baseline. Halves of a ratio alternate, each is the least of its rounds.
Exit status 1 if one is worse than benchmarks/ratios.json allows.
"""

import sys
import time
from collections.abc import Callable

import numpy as np

from benchmarks.baseline import conclude, parser_of
from teamslam.sim.studies.estimators.robot_step import RobotStep, innovation
from teamslam.team.config import FrontEnd, MotionModel, MotionNoise, RobotConfig, Sensor
from teamslam.team.estimation.hybrid_slam.fastslam import Particles, Proposal, filter_step
from teamslam.team.estimation.models import Increment, increment_of, segmenter_of
from teamslam.team.robot.node import RobotNode
from teamslam.team.wire.codec import decoded, encoded
from tests import build

MOTION = MotionModel(forward=MotionNoise(per_m=0.03), turn=MotionNoise(per_rad=0.1))
SENSOR = Sensor(range_sigma=0.2, bearing_sigma=0.03)
PARTICLES, KNOWN, SEEN = 100, 12, 4
INTERVALS = 300
INTERVAL_NS = 15_000_000
DRIVEN, SCANNED = 600, 33
STEPPED = 60


def least(parts: list[Callable[[], None]], rounds: int) -> list[float]:
    """Measure the CPU seconds of each part, the least of all rounds; the parts alternate."""
    took = [[_cpu_s(part) for part in parts] for _ in range(rounds + 1)]
    return np.min(took[1:], axis=0).tolist()  # the first round loads


def _cpu_s(part: Callable[[], None]) -> float:
    began = time.process_time()
    part()
    return time.process_time() - began


def compose_directly() -> None:
    motion = Increment.identity()
    for _ in range(INTERVALS):
        motion = motion.then(increment_of(MOTION, INTERVAL_NS * 1e-9, 0.3, 0.1))


def composed_in_a_run() -> None:
    segmenter = segmenter_of(MOTION, Sensor(), 0.0)
    segmenter.begin(0)
    for k in range(1, INTERVALS + 1):
        segmenter.drive(k * INTERVAL_NS, INTERVAL_NS, 0.3, 0.1)
    segmenter.cut(INTERVALS * INTERVAL_NS)


def steps() -> list[Callable[[], None]]:
    """Make a step of FastSLAM 1.0, one of 2.0, and the innovation before it, thirty times each."""
    rng = np.random.default_rng(1)
    landmarks = rng.uniform(-20.0, 20.0, (KNOWN, 2))
    spread = np.zeros((PARTICLES, KNOWN, 3))
    spread[..., 0] = spread[..., 2] = 0.05
    particles = Particles(
        rng.normal(0.0, 0.05, (PARTICLES, 3)),
        np.full(PARTICLES, -np.log(PARTICLES)),
        np.arange(KNOWN, dtype=np.uint32),
        landmarks + rng.normal(0.0, 0.1, (PARTICLES, KNOWN, 2)),
        spread,
    )
    motion = increment_of(MOTION, 1.0, 0.5, 0.1)
    x, y = landmarks[:SEEN].T
    seen = particles.ids[:SEEN], np.hypot(x, y), np.arctan2(y, x)

    def step(proposal: Proposal) -> Callable[[], None]:
        def taken() -> None:
            for _ in range(30):
                filter_step(particles, motion, SENSOR, *seen, proposal, np.random.default_rng(2))

        return taken

    def judged() -> None:
        for _ in range(30):
            innovation(particles, RobotStep("r1", motion, SENSOR, *seen))

    return [step("fastslam1"), step("fastslam2"), judged]


def driving(
    front_end: FrontEnd, intervals: int, interval_ns: int, every: int, ranges: list[float]
) -> Callable[[], None]:
    """Make a node's step over odometry intervals, with a scan before the first one of every few."""
    config = RobotConfig("r1", MOTION, SENSOR, front_end)
    start = build.initial_pose(incarnation=0)
    ids = np.arange(1, len(ranges) + 1, dtype=np.uint32)
    inputs: list[bytes] = []
    number = 0
    for k in range(intervals):
        if k % every == 0:
            number += 1
            at = {"stamp_ns": k * interval_ns, "incarnation": 0, "number": number}
            seen = {"ids": ids, "ranges": ranges, "bearings": 0.4 - 0.3 * ids}
            inputs.append(encoded(build.observations(**at, **seen)))
        number += 1
        at = {"stamp_ns": (k + 1) * interval_ns, "incarnation": 0, "number": number}
        told = {"duration_ns": interval_ns, "forward": 0.01, "yaw_rate": 0.02}
        inputs.append(encoded(build.odometry(**at, **told)))

    def taken() -> None:
        node = RobotNode(config)
        node.handle(start)
        for payload in inputs:
            node.handle(decoded(payload))

    return taken


def measure_ratios(rounds: int) -> dict[str, float]:
    at_70_hz = FrontEnd(particles=PARTICLES, keyframe_s=0.5, window_s=10.0)
    (node,) = least([driving(at_70_hz, DRIVEN, INTERVAL_NS, SCANNED, [3.0, 4.0])], rounds)
    at_once, in_a_run = least([compose_directly, composed_in_a_run], rounds)
    by_steps = driving(FrontEnd(particles=PARTICLES), STEPPED, 10**9, 1, [3.0, 4.0, 5.0, 6.0])
    plain, improved, judged, stepped = least([*steps(), by_steps], rounds)
    return {
        "in_a_run": in_a_run / at_once,
        "improved": improved / plain,
        "innovation": judged / improved,
        "node": (stepped / STEPPED) / (improved / 30),
        "node_us": 1e6 * node / DRIVEN,
    }


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--rounds", type=int, default=7)
    told = parser.parse_args()
    return conclude(measure_ratios(told.rounds), "ratios", told.json)


if __name__ == "__main__":
    sys.exit(main())
