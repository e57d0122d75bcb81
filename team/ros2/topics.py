"""The topics of each robot's odometry, detections, fixes and truth, from a TOML file."""

import tomllib
from pathlib import Path
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from teamslam.team.datum import Datum

RobotName = Annotated[str, Meta(pattern="^[a-z][a-z0-9_]{0,31}$")]


class TopicsError(ValueError):
    """Unusable file of topics; the text has file, place and remedy."""


class RobotTopics(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The topics of one robot.

    odometry: nav_msgs/Odometry, of which `use` chooses the pose or the speeds (twist, until the
    next message); geometry_msgs/TwistStamped; or tf2_msgs/TFMessage with the transform
    odometry_frame → base_frame. detections: messages of a detector, or tf2_msgs/TFMessage whose
    child frames are tags. fixes: sensor_msgs/NavSatFix, the antenna's position. truth:
    nav_msgs/Odometry or a pose.

    teammates: robots by the number of the tag that they carry. landmarks: numbers of tags with
    other names. frames: those of its detections, where transforms do not assign them. names:
    whether id (if empty, class) or class names a detection of vision_msgs. By default from
    tf_static: antenna: its place (ahead, left) on the base; mount: the sensor's pose (x, y, yaw) on
    the base; optical: its frame is a camera's (z ahead, x right). types: of topics over a bridge
    that does not announce them.
    """

    odometry: str = ""
    use: Literal["pose", "twist"] = "pose"
    detections: tuple[str, ...] = ()
    fixes: str = ""
    truth: str = ""
    base_frame: str = "base_link"
    odometry_frame: str = "odom"
    frames: tuple[str, ...] = ()
    teammates: dict[str, RobotName] = {}
    landmarks: dict[str, Annotated[int, Meta(ge=0, lt=2**31)]] = {}
    types: dict[str, str] = {}
    names: Literal["id", "class"] = "id"
    mount: tuple[float, float, float] | None = None
    antenna: tuple[float, float] | None = None
    optical: bool | None = None


class Topics(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The topics of each robot.

    domain: of ROS, for live robots. datum: origin of the plane of all robots' fixes; None: the
    first fix of a bag; live robots need it.
    """

    robots: dict[RobotName, RobotTopics]
    datum: Datum | None = None
    domain: Annotated[int, Meta(ge=0, le=232)] = 0


def load_topics(path: Path) -> Topics:
    """Read a file; raises TopicsError."""
    try:
        found = msgspec.convert(tomllib.loads(path.read_text("utf-8")), Topics)
    except OSError as error:
        raise TopicsError(f"{path}: can not be read: {error.strerror}") from None
    except UnicodeDecodeError as error:
        raise TopicsError(f"{path}: can not be read as UTF-8 text: {error}") from None
    except tomllib.TOMLDecodeError as error:
        raise TopicsError(f"{path}: not valid TOML: {error}") from None
    except msgspec.ValidationError as error:
        raise TopicsError(f"{path}: {error}; docs/your_ros2_robot.md has an example") from None
    if not found.robots:
        raise TopicsError(f"{path}: no robot; give [robots.r1] with odometry and detections")
    robots: dict[tuple[str, str, str], str] = {}
    for name, each in found.robots.items():
        motion = each.odometry, each.odometry_frame, each.base_frame
        if (other := robots.setdefault(motion, name)) != name and each.odometry:
            raise TopicsError(
                f"{path}: {other} and {name} have the same odometry, {each.odometry}: give each "
                "its own topic, or, of transforms, its own odometry_frame and base_frame"
            )
    return found
