"""Command `teamslam driver`, which converts a ROS 2 robot's topics to its stream."""

import logging
import time
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from teamslam.sim.cli import options as opt
from teamslam.sim.cli.commands import (
    Group,
    argument,
    failing,
    network,
    option,
    rare,
    refuse,
    refusing,
)

if TYPE_CHECKING:
    from teamslam.team.ros2_driver import Ros2Driver

app = Group()


_LOG = logging.getLogger("teamslam")
WAIT_S = 0.2
LAST_S = 0.2  # time [s] for messages in transit at the end
AT_ONCE = 500  # measurements processed between checks for new messages


@app.declare("teamslam driver r1 --team lab --ros2 topics.toml --start 0,0,1.57")
def driver(
    robot: Annotated[str, argument("The robot's name, as r1.")],
    ros2: Annotated[Path, option("TOML file that assigns topics.", "FILE")],
    team: Annotated[str, option("The team's name: its scenario's.", "NAME")],
    connect: opt.Connect = opt.LOOPBACK,
    ros2_connect: Annotated[
        str | None,
        network(
            "Where ROS 2 is on Zenoh (rmw_zenoh's router, or a bridge); default: --connect.",
            "ENDPOINT",
        ),
    ] = None,
    keys: opt.Keys = None,
    file: Annotated[
        Path | None, rare("Where all measurements are kept; default: ROBOT.stream here.", "FILE")
    ] = None,
    start: Annotated[
        str | None,
        option("Where it starts, and how well that is known (m, rad).", "x,y,theta[,sigma,sigma]"),
    ] = None,
    latency: Annotated[
        float, rare("Seconds by which landmarks may arrive later than odometry.", "S", least=0.0)
    ] = 0.2,
    answers: Annotated[
        Literal["all", "topics", "none"],
        option(
            "What is published back to ROS 2: everything, all but the transform map → odom "
            "(another node publishes it), or nothing."
        ),
    ] = "all",
) -> None:
    """Drive a robot of a live team by its ROS 2 topics, without ROS here; Ctrl-C ends its
    stream.

    Topics come by rmw_zenoh or by zenoh-bridge-ros2dds. Published back beside the
    odometry: team_pose, team_path, smoothed_path, team_landmarks, team_map, the
    transform map → odom, and /diagnostics.
    """
    import numpy as np

    from teamslam.team.driver.driver import Driver, DriverError
    from teamslam.team.driver.measurement_messages import DriverWarning, MeasurementError
    from teamslam.team.ros2.topics import TopicsError, load_topics
    from teamslam.team.ros2_answers import LiveAnswers, RosPublisher
    from teamslam.team.ros2_driver import Ros2Driver
    from teamslam.team.shell import process
    from teamslam.team.wire.zenoh.foreign_keys import ForeignKeys

    logging.captureWarnings(True)
    # A detector lists its tags in any order; measurements stay with their names.
    warnings.filterwarnings("ignore", message=".*ids are not ascending", category=DriverWarning)
    with refusing(TopicsError):
        topics = load_topics(ros2)
    if robot not in topics.robots:
        refuse(f"{ros2}: no [robots.{robot}]; it has {', '.join(topics.robots)}")
    live = None
    if answers != "none":
        live = LiveAnswers(robot, topics.robots[robot], has_tf=answers == "all")
    pose = () if start is None else opt.parse_start(start)[1]
    variances = [pose[3] ** 2, pose[3] ** 2, pose[4] ** 2] if len(pose) == 5 else None
    with (
        refusing(MeasurementError, at="--start"),
        failing(DriverError),
        process(f"driver-{robot}", endless=True, patient=True) as stop,
        Driver(
            robot,
            team=team,
            connect=connect if keys is None else opt.over_tls(connect),
            keys=keys,
            file=file,
            start=pose[:3] or None,
            start_covariance=None if variances is None else np.diag(variances),
            latency_s=latency,
            on_message=None if live is None else live.add_message,
        ) as source,
    ):
        translated = Ros2Driver(
            source, topics.robots[robot], topics.domain, name=robot, others=topics.robots,
            datum=topics.datum,
            on_odometry=None if live is None else live.add_odometry,
        )  # fmt: skip
        with ForeignKeys(
            ros2_connect or connect, translated.keys, translated.tokens, latched=translated.latched
        ) as foreign:
            _LOG.info("listening to %s", ", ".join((*translated.keys, *translated.latched)))
            publisher = RosPublisher(foreign, f"teamslam_{robot}", topics.domain)
            while not (stop.is_set() or source.team_has_ended):
                for sample in foreign.receive(0.0 if translated.waiting else WAIT_S):
                    translated.put(sample)
                translated.deliver(AT_ONCE)
                if live is not None:
                    live.publish(publisher)
                source.tell(translated.figures(), translated.warnings())
                translated.report()
                if translated.refusal:
                    refuse(f"{ros2}: {translated.refusal}")
            until = time.monotonic() + LAST_S
            while time.monotonic() < until:  # messages in transit; the topic may continue
                for sample in foreign.receive(LAST_S):
                    translated.put(sample)
            translated.deliver()
            _LOG.info(
                "the stream of %s ends here and is delivered; %s keeps it", robot, source.path
            )
            source.tell(translated.figures(), translated.warnings())
        _log_totals(translated)


def _log_totals(translated: "Ros2Driver") -> None:
    for topic, count in translated.taken.items():
        _LOG.info("%s: %d messages", topic, count)
    for reason, count in translated.dropped.items():
        _LOG.warning("%s: %d", reason, count)
    for text in translated.warnings():
        _LOG.warning("%s", text)
