from collections.abc import Sequence
from math import cos, sin
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer

from teamslam.team.ros2.decoding import types

STORE = types()
T: Any = STORE.types
ZERO = np.zeros(36)
Message = tuple[int, str, str, Any]  # time of arrival, topic, type, message


def header(stamp_ns: int, frame: str) -> Any:
    time = T["builtin_interfaces/msg/Time"](sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    return T["std_msgs/msg/Header"](stamp=time, frame_id=frame)


def vector(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Any:
    return T["geometry_msgs/msg/Vector3"](x=x, y=y, z=z)


def quaternion(q: Sequence[float] = (0.0, 0.0, 0.0, 1.0)) -> Any:
    return T["geometry_msgs/msg/Quaternion"](x=q[0], y=q[1], z=q[2], w=q[3])


def pose(x: float = 0.0, y: float = 0.0, z: float = 0.0, yaw: float = 0.0) -> Any:
    turned = quaternion((0.0, 0.0, sin(yaw / 2), cos(yaw / 2)))
    point = T["geometry_msgs/msg/Point"](x=x, y=y, z=z)
    return T["geometry_msgs/msg/Pose"](position=point, orientation=turned)


def with_covariance(posed: Any, covariance: np.ndarray = ZERO) -> Any:
    return T["geometry_msgs/msg/PoseWithCovariance"](pose=posed, covariance=covariance)


def odometry(stamp_ns: int, posed: Any, v: float = 0.0, w: float = 0.0) -> Any:
    twist = T["geometry_msgs/msg/Twist"](linear=vector(v), angular=vector(z=w))
    return T["nav_msgs/msg/Odometry"](
        header=header(stamp_ns, "odom"),
        child_frame_id="base_link",
        pose=with_covariance(posed),
        twist=T["geometry_msgs/msg/TwistWithCovariance"](twist=twist, covariance=ZERO),
    )


def detections(stamp_ns: int, frame: str, tags: Sequence[tuple[str, Any]]) -> Any:
    found = []
    for name, posed in tags:
        hypothesis = T["vision_msgs/msg/ObjectHypothesis"](class_id=name, score=1.0)
        result = T["vision_msgs/msg/ObjectHypothesisWithPose"](
            hypothesis=hypothesis, pose=with_covariance(posed)
        )
        box = T["vision_msgs/msg/BoundingBox3D"](center=pose(), size=vector())
        found.append(
            T["vision_msgs/msg/Detection3D"](
                header=header(stamp_ns, frame), results=[result], bbox=box, id=name
            )
        )
    return T["vision_msgs/msg/Detection3DArray"](header=header(stamp_ns, frame), detections=found)


def fix(
    stamp_ns: int,
    frame: str,
    degrees: tuple[float, float],
    covariance: tuple[float, float, float] | None = None,
    status: int = 0,
) -> Any:
    """NavSatFix; covariance: (xx, xy, yy) of (east, north); None: unknown."""
    block = np.zeros((3, 3))
    if covariance is not None:
        xx, xy, yy = covariance
        block[:2, :2], block[2, 2] = [[xx, xy], [xy, yy]], 4.0
    return T["sensor_msgs/msg/NavSatFix"](
        header=header(stamp_ns, frame),
        status=T["sensor_msgs/msg/NavSatStatus"](status=status, service=1),
        latitude=degrees[0],
        longitude=degrees[1],
        altitude=float("nan"),
        position_covariance=block.ravel(),
        position_covariance_type=0 if covariance is None else 2,
    )


def transforms(*each: tuple[int, str, str, Any, Sequence[float]]) -> Any:
    """(stamp, parent, child, translation, rotation) of each."""
    return T["tf2_msgs/msg/TFMessage"](
        transforms=[
            T["geometry_msgs/msg/TransformStamped"](
                header=header(stamp_ns, parent),
                child_frame_id=child,
                transform=T["geometry_msgs/msg/Transform"](
                    translation=translation, rotation=quaternion(rotation)
                ),
            )
            for stamp_ns, parent, child, translation, rotation in each
        ]
    )


def cdr(kind: str, message: Any) -> bytes:
    return bytes(STORE.serialize_cdr(message, kind))


def write_bag(path: Path, messages: Sequence[Message], *, db3: bool = False) -> Path:
    plugin = StoragePlugin.SQLITE3 if db3 else StoragePlugin.MCAP
    with Writer(path, version=9, storage_plugin=plugin) as writer:
        connections: dict[str, Any] = {}
        for arrival_ns, topic, kind, message in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=STORE)
            data = message if isinstance(message, bytes) else cdr(kind, message)
            writer.write(connections[topic], arrival_ns, data)
    return path
