"""Decode a ROS 2 message (type, CDR bytes) into a frozen record of finite numbers.

The types are those of a distribution, and detectors' own.
"""

from collections.abc import Callable, Iterable, Mapping
from functools import cache
from math import isfinite
from typing import Any, NamedTuple

import numpy as np
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

_HEADER = "std_msgs/Header header\n"
DETECTORS = {
    "vision_msgs/msg/ObjectHypothesis": "string class_id\nfloat64 score",
    "vision_msgs/msg/ObjectHypothesisWithPose": (
        "vision_msgs/ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose"
    ),
    "vision_msgs/msg/BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size",
    "vision_msgs/msg/Detection3D": (
        _HEADER + "vision_msgs/ObjectHypothesisWithPose[] results\n"
        "vision_msgs/BoundingBox3D bbox\nstring id"
    ),
    "vision_msgs/msg/Detection3DArray": _HEADER + "vision_msgs/Detection3D[] detections",
    "isaac_ros_apriltag_interfaces/msg/AprilTagDetection": (
        "string family\nint32 id\ngeometry_msgs/Point center\ngeometry_msgs/Point[4] corners\n"
        "geometry_msgs/PoseWithCovarianceStamped pose"
    ),
    "isaac_ros_apriltag_interfaces/msg/AprilTagDetectionArray": (
        _HEADER + "isaac_ros_apriltag_interfaces/AprilTagDetection[] detections"
    ),
    "aruco_opencv_msgs/msg/MarkerPose": "uint16 marker_id\ngeometry_msgs/Pose pose",
    "aruco_opencv_msgs/msg/BoardPose": "string board_name\ngeometry_msgs/Pose pose",
    "aruco_opencv_msgs/msg/ArucoDetection": (
        _HEADER + "aruco_opencv_msgs/MarkerPose[] markers\naruco_opencv_msgs/BoardPose[] boards"
    ),
    "ros2_aruco_interfaces/msg/ArucoMarkers": (
        _HEADER + "int64[] marker_ids\ngeometry_msgs/Pose[] poses"
    ),
    "aruco_msgs/msg/Marker": (
        _HEADER + "uint32 id\ngeometry_msgs/PoseWithCovariance pose\nfloat64 confidence"
    ),
    "aruco_msgs/msg/MarkerArray": _HEADER + "aruco_msgs/Marker[] markers",
}
"""Fields of detectors' messages, which no distribution contains."""


@cache
def types() -> Typestore:
    """Return all types; a bag's own definitions have precedence."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    found = {}
    for name, text in DETECTORS.items():
        found.update(get_types_from_msg(text, name))
    store.register(found)
    return store


Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]  # x, y, z, w


class DamagedError(ValueError):
    """Bytes that are no message of this type, or impossible numbers."""


class OdometryRecord(NamedTuple):
    """nav_msgs/Odometry: the pose of `child` in `frame`, and its speeds."""

    stamp_ns: int
    frame: str
    child: str
    position: Vector
    rotation: Quaternion
    forward: float
    left: float
    yaw_rate: float


class SpeedRecord(NamedTuple):
    """geometry_msgs/TwistStamped: speeds that hold until the next message."""

    stamp_ns: int
    frame: str
    forward: float
    yaw_rate: float


class PoseRecord(NamedTuple):
    """A pose in `frame`."""

    stamp_ns: int
    frame: str
    position: Vector
    rotation: Quaternion


class Transform(NamedTuple):
    """The pose of `child` in `parent`."""

    stamp_ns: int
    parent: str
    child: str
    position: Vector
    rotation: Quaternion


class Tag(NamedTuple):
    """One detected tag.

    covariance: of (x, y, z), row-major. kind: its class by the detector, if not its name.
    """

    name: str
    position: Vector
    covariance: tuple[float, ...] | None
    kind: str = ""


class TagsRecord(NamedTuple):
    """The tags of one detection message, in `frame`."""

    stamp_ns: int
    frame: str
    tags: tuple[Tag, ...]


class FixRecord(NamedTuple):
    """sensor_msgs/NavSatFix: latitude and longitude [deg] of the antenna, whose frame is `frame`.

    degrees: None without a fix. covariance: (xx, xy, yy) [m²], x east and y north, or None.
    """

    stamp_ns: int
    frame: str
    degrees: tuple[float, float] | None
    covariance: tuple[float, float, float] | None


class TransformsRecord(NamedTuple):
    """tf2_msgs/TFMessage."""

    transforms: tuple[Transform, ...]


Record = OdometryRecord | SpeedRecord | PoseRecord | TagsRecord | FixRecord | TransformsRecord

FAULTS = (SerdeError, ValueError, IndexError, KeyError, OverflowError, MemoryError, TypeError,
          AssertionError, AttributeError)  # fmt: skip
"""The library's exceptions for bytes that are no message."""


def decode(kind: str, data: bytes | memoryview, store: Typestore | None = None) -> Record:
    """Decode a message of a type in READERS (`nav_msgs/msg/Odometry`); raises DamagedError.

    store: the types' definitions, if they are not ours.
    """
    reader = READERS[kind]
    try:
        return reader((types() if store is None else store).deserialize_cdr(data, kind))
    except FAULTS as error:
        raise DamagedError(f"no sound {kind}: {error}") from None


def _stamp_ns(header: Any) -> int:
    return int(header.stamp.sec) * 10**9 + int(header.stamp.nanosec)


def _finite(numbers: Iterable[float]) -> tuple[float, ...]:
    taken = tuple(float(each) for each in numbers)
    if not all(map(isfinite, taken)):
        raise DamagedError("a number that is not finite")
    return taken


def _vector(point: Any) -> Vector:
    x, y, z = _finite((point.x, point.y, point.z))
    return x, y, z


def _rotation(quaternion: Any) -> Quaternion:
    x, y, z, w = _finite((quaternion.x, quaternion.y, quaternion.z, quaternion.w))
    if not 0.5 < x * x + y * y + z * z + w * w < 2.0:
        raise DamagedError("a rotation whose quaternion has not the length 1")
    return x, y, z, w


def _odometry(message: Any) -> OdometryRecord:
    twist = message.twist.twist
    speeds = _finite((twist.linear.x, twist.linear.y, twist.angular.z))
    stamp_ns, frame, position, rotation = _pose(message, message.pose.pose)
    return OdometryRecord(stamp_ns, frame, message.child_frame_id, position, rotation, *speeds)


def _speeds(message: Any) -> SpeedRecord:
    forward, yaw_rate = _finite((message.twist.linear.x, message.twist.angular.z))
    return SpeedRecord(_stamp_ns(message.header), message.header.frame_id, forward, yaw_rate)


def _pose(message: Any, pose: Any) -> PoseRecord:
    return PoseRecord(
        _stamp_ns(message.header),
        message.header.frame_id,
        _vector(pose.position),
        _rotation(pose.orientation),
    )


def _transform(message: Any) -> Transform:
    return Transform(
        _stamp_ns(message.header),
        message.header.frame_id.lstrip("/"),
        message.child_frame_id.lstrip("/"),
        _vector(message.transform.translation),
        _rotation(message.transform.rotation),
    )


def _tags(message: Any, tags: Iterable[Tag], frame: str = "") -> TagsRecord:
    found = tuple(tags)
    header = message.header
    return TagsRecord(_stamp_ns(header), (frame or header.frame_id).lstrip("/"), found)


def _tag(name: object, pose: Any, covariance: Any = None) -> Tag:
    """covariance: 36 numbers of (x, y, z, three angles); all 0: none is stated."""
    block = None
    if covariance is not None:
        block = _finite(np.asarray(covariance).reshape(6, 6)[:3, :3].ravel())
    return Tag(str(name), _vector(pose.position), block if block and any(block) else None)


def _vision(message: Any) -> TagsRecord:
    """Read vision_msgs: a detection's id, else the class of its best hypothesis."""
    tags = []
    for each in message.detections:
        best = max(each.results, key=lambda r: r.hypothesis.score, default=None)
        if best is None:
            tags.append(_tag(each.id, each.bbox.center))
        else:
            kind = str(best.hypothesis.class_id)
            tag = _tag(each.id or kind, best.pose.pose, best.pose.covariance)
            tags.append(tag._replace(kind=kind if kind != tag.name else ""))
    return _tags(message, tags)


def _isaac(message: Any) -> TagsRecord:
    tags = [_tag(d.id, d.pose.pose.pose, d.pose.pose.covariance) for d in message.detections]
    frames = {d.pose.header.frame_id for d in message.detections} - {""}
    if len(frames) > 1:
        raise DamagedError("tags in several frames")
    return _tags(message, tags, next(iter(frames), ""))


def _fix(message: Any) -> FixRecord:
    """position_covariance: of (east, north, up), row-major; type 0: unknown."""
    stamp_ns, frame = _stamp_ns(message.header), message.header.frame_id.lstrip("/")
    if message.status.status < 0:
        return FixRecord(stamp_ns, frame, None, None)
    latitude, longitude = _finite((message.latitude, message.longitude))
    if abs(latitude) > 90.0 or abs(longitude) > 180.0:
        raise DamagedError(f"latitude {latitude:g}°, longitude {longitude:g}°")
    covariance = None
    if message.position_covariance_type != 0:
        xx, xy, _, _, yy, *_ = _finite(np.asarray(message.position_covariance).ravel())
        covariance = (xx, xy, yy) if xx > 0.0 and xx * yy > xy * xy else None
    return FixRecord(stamp_ns, frame, (latitude, longitude), covariance)


READERS: Mapping[str, Callable[[Any], Record]] = {
    "nav_msgs/msg/Odometry": _odometry,
    "geometry_msgs/msg/TwistStamped": _speeds,
    "geometry_msgs/msg/PoseStamped": lambda m: _pose(m, m.pose),
    "geometry_msgs/msg/PoseWithCovarianceStamped": lambda m: _pose(m, m.pose.pose),
    "geometry_msgs/msg/TransformStamped": lambda m: TransformsRecord((_transform(m),)),
    "sensor_msgs/msg/NavSatFix": _fix,
    "tf2_msgs/msg/TFMessage": lambda m: TransformsRecord(tuple(map(_transform, m.transforms))),
    "vision_msgs/msg/Detection3DArray": _vision,
    "isaac_ros_apriltag_interfaces/msg/AprilTagDetectionArray": _isaac,
    "aruco_opencv_msgs/msg/ArucoDetection": lambda m: _tags(
        m, [_tag(each.marker_id, each.pose) for each in m.markers]
    ),
    "ros2_aruco_interfaces/msg/ArucoMarkers": lambda m: _tags(
        m, [_tag(int(i), p) for i, p in zip(m.marker_ids, m.poses, strict=True)]
    ),
    "aruco_msgs/msg/MarkerArray": lambda m: _tags(
        m, [_tag(each.id, each.pose.pose, each.pose.covariance) for each in m.markers]
    ),
}
