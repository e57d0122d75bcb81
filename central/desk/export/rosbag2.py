"""Export a run as a ROS 2 bag for RViz, Foxglove and evo.

Dead-reckoned odometry with odom → base, the messages of `teamslam.team.ros2_answers`, the smoothed
path, and the truth, if known, with world → map. Log times are team time.
"""

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import msgspec
import numpy as np

from teamslam.central.config import UNREADABLE
from teamslam.central.desk.evaluation.evaluation import evaluate
from teamslam.central.desk.paths import smoothed_paths
from teamslam.central.desk.verification.recorded import RerunError, index_log
from teamslam.team import translate
from teamslam.team.config import RobotConfig
from teamslam.team.estimation.models import model_of
from teamslam.team.recording.reader import Log, LogError
from teamslam.team.ros2 import encoding as ros
from teamslam.team.ros2.bags import new_bag
from teamslam.team.ros2_answers import Answer, Answers
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.bus import try_open

TEAM_SPACE = "/teamslam"  # namespace of the team's map and diagnostics
TRUTH_FRAME = "world"  # frame of the true poses, the parent of `map`
ODOMETRY_HZ = 50.0  # highest rate of the exported odometry [Hz]


class _Robot:
    def __init__(self, name: str) -> None:
        self.config: RobotConfig | None = None
        frames = {"odometry_frame": f"{name}/odom", "base_frame": f"{name}/base_link"}
        self.names = ros.Names(f"/{name}", **frames)
        self.answers = Answers(self.names)
        self.pose: ros.Pose = (0.0, 0.0, 0.0)
        self.incarnation = 0
        self._written_ns = -(2**62)

    def drive(self, message: m.AnyOdometry) -> Iterator[Answer]:
        if self.config is None:
            return
        if message.incarnation != self.incarnation:
            self.incarnation, self.pose = message.incarnation, (0.0, 0.0, 0.0)
        interval = translate.interval_of(message, self.config)
        mean, _ = interval.part(model_of(self.config.motion), interval.duration_ns, 0)
        step = mean.tolist()
        self.pose = ros.compose(self.pose, (step[0], step[1], step[2]))
        stamp_ns, names = interval.end_ns, self.names
        self.answers.add_odometry(stamp_ns, self.pose)
        if stamp_ns - self._written_ns < 1e9 / ODOMETRY_HZ:
            return
        self._written_ns = stamp_ns
        speeds = interval.forward, interval.yaw_rate
        one = ros.transform(stamp_ns, names.odometry_frame, names.base_frame, self.pose)
        yield Answer(names.tf, "tf2_msgs/msg/TFMessage", stamp_ns, ros.encode(ros.transforms(one)))
        data = ros.encode(ros.odometry(stamp_ns, names, self.pose, speeds))
        yield Answer(names.topic("odometry"), "nav_msgs/msg/Odometry", stamp_ns, data)


def _answers_of(log: Log) -> Iterator[Answer]:
    robots: dict[str, _Robot] = {}
    team = Answers(ros.Names(TEAM_SPACE))
    final = False
    for sample in log.samples():
        if (sound := try_open(sample)) is None:
            continue
        channel, name, message = sound
        if channel is ch.ROBOT_CONFIG and isinstance(message, m.Configuration):
            robot = robots.setdefault(name, _Robot(name))
            with suppress(*UNREADABLE):
                robot.config = msgspec.json.decode(message.configuration, type=RobotConfig)
        elif channel is ch.ODOMETRY and isinstance(message, m.AnyOdometry):
            yield from robots.setdefault(name, _Robot(name)).drive(message)
        elif channel in (ch.TEAM_POSE, ch.TRAJECTORY, ch.TEAM_TRAJECTORY):
            yield from robots.setdefault(name, _Robot(name)).answers.convert(message)
        elif channel in (ch.FUSED_MAP, ch.TEAM_MAP, ch.FINAL_MAP, ch.TEAM_FINAL, ch.STATUS):
            is_final = channel in (ch.FINAL_MAP, ch.TEAM_FINAL)
            if isinstance(message, m.FusedMap) and final and not is_final:
                continue
            final |= is_final
            yield from team.convert(message)
    with suppress(RerunError):  # a log without an input of the recomputation
        yield from _smoothed(log)
    yield from _true(log)


def _smoothed(log: Log) -> Iterator[Answer]:
    kind = "geometry_msgs/msg/PoseWithCovarianceStamped"
    for robot, path in smoothed_paths(index_log(log)).items():
        names = ros.Names(f"/{robot}")
        for stamp_ns, (x, y, theta), P in zip(
            path.stamps_ns.tolist(), path.poses.tolist(), path.covariances, strict=True
        ):
            pose = ros.pose_with_covariance(stamp_ns, names.map_frame, (x, y, theta), P)
            yield Answer(names.topic("smoothed_pose"), kind, stamp_ns, ros.encode(pose))


def _true(log: Log) -> Iterator[Answer]:
    evaluation = evaluate(log.samples())
    starts_ns = list[int]()
    for robot, result in evaluation.robots.items():
        topic = f"/{robot}/ground_truth"
        for stamp_ns, (x, y, theta) in zip(
            result.truth.stamps_ns.tolist(), result.truth.poses.tolist(), strict=True
        ):
            data = ros.encode(ros.pose_stamped(stamp_ns, TRUTH_FRAME, (x, y, theta)))
            yield Answer(topic, "geometry_msgs/msg/PoseStamped", stamp_ns, data)
        starts_ns += result.truth.stamps_ns[:1].tolist()
    motion = evaluation.truth_from_map if evaluation.arbitrary_frame else np.zeros(3)
    if starts_ns and motion is not None:
        x, y, theta = motion.tolist()
        stamp_ns = min(starts_ns)
        one = ros.transform(stamp_ns, TRUTH_FRAME, ros.Names(TEAM_SPACE).map_frame, (x, y, theta))
        kind = "tf2_msgs/msg/TFMessage"
        yield Answer("/tf_static", kind, stamp_ns, ros.encode(ros.transforms(one)), latched=True)


def export_rosbag2(log: Log, folder: Path) -> dict[str, int]:
    """Write a bag (MCAP); return message counts by topic. Raises LogError."""
    counts = dict[str, int]()
    with new_bag(folder) as bag:
        for answer in _answers_of(log):
            bag.write(answer.topic, answer.kind, answer.stamp_ns, answer.data, answer.latched)
            counts[answer.topic] = counts.get(answer.topic, 0) + 1
    if not counts:
        raise LogError(log.path, "no odometry, pose or map in it", "`log info` lists what there is")
    return counts
