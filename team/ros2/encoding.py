"""Build ROS 2 messages of planar poses and landmarks, and encode them as CDR.

Covariances are those of (x, y, θ) in the frame of the header; z, roll and pitch are exactly zero.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype

from teamslam.team.ros2.decoding import types
from teamslam.team.shapes import Float

SIGMAS = 2.0
"""Radius of the ellipses in standard deviations: 86 % of a landmark's probability in the plane."""
HEIGHT_M = 0.1
LEAST_AXIS_M = 0.02
"""Least length of an ellipse's axis [m], so that an accurate landmark is visible."""
_DELETE_ALL = 3
_CYLINDER, _TEXT = 3, 9
_BLUE, _GREY, _WHITE = (
    dict(zip("rgba", colour, strict=True))
    for colour in ((0.12, 0.47, 0.71, 0.35), (0.5, 0.5, 0.5, 0.35), (1.0, 1.0, 1.0, 0.9))
)
Pose = tuple[float, float, float]  # (x [m], y [m], θ [rad])


@dataclass(frozen=True)
class Names:
    """Topics and frames of one robot; its topics begin with the namespace, frames as in REP 105."""

    namespace: str
    tf: str = "/tf"
    map_frame: str = "map"
    odometry_frame: str = "odom"
    base_frame: str = "base_link"

    def topic(self, name: str) -> str:
        """Return a topic of the robot."""
        return f"{self.namespace.rstrip('/')}/{name}"


def names_of(robot: str, odometry: str, odometry_frame: str, base_frame: str) -> Names:
    """Choose the names of a robot whose odometry comes on this topic.

    Its topics are beside the odometry's, or, on the root, in the namespace of its name. Unprefixed
    frames in a namespace have their transforms on the namespace's own `tf`.
    """
    space = "/" + "/".join(odometry.strip("/").split("/")[:-1])
    is_prefixed = "/" in odometry_frame.strip("/")
    tf = "/tf" if space == "/" or is_prefixed else f"{space}/tf"
    namespace = f"/{robot}" if space == "/" else space
    return Names(namespace, tf, odometry_frame=odometry_frame, base_frame=base_frame)


def encode(message: Any) -> bytes:
    """Encode a message built by this module as CDR, little-endian."""
    return bytes(types().serialize_cdr(message, message.__msgtype__))


def compose(a: Pose, b: Pose) -> Pose:
    """Compose two poses, a ∘ b."""
    c, s = float(np.cos(a[2])), float(np.sin(a[2]))
    return a[0] + c * b[0] - s * b[1], a[1] + s * b[0] + c * b[1], _wrapped(a[2] + b[2])


def inverse(a: Pose) -> Pose:
    """Invert a pose, a⁻¹."""
    c, s = float(np.cos(a[2])), float(np.sin(a[2]))
    return -c * a[0] - s * a[1], s * a[0] - c * a[1], _wrapped(-a[2])


def _wrapped(angle: float) -> float:
    return float(np.pi - (np.pi - angle) % (2.0 * np.pi))


# Messages. Fields that are left out are zero or empty.


@cache
def _zeros(kind: str) -> dict[str, Any]:
    return {name: _zero(*node) for name, node in types().fielddefs[kind][1]}


def _zero(node: Nodetype, of: Any) -> Any:
    if node is Nodetype.NAME:
        return build(of)
    if node is Nodetype.BASE:
        return {"string": "", "bool": False}.get(of[0], 0)
    (inner, element), length = of
    return np.zeros(length, element[0]) if inner is Nodetype.BASE else []


def build(kind: str, **values: Any) -> Any:
    """Build a message; parts are messages, or tables of their fields."""
    nodes: dict[str, Any] = dict(types().fielddefs[kind][1])
    given = {name: _part(nodes[name], value) for name, value in values.items()}
    return types().types[kind](**{**_zeros(kind), **given})


def _part(declared: tuple[Nodetype, Any], value: Any) -> Any:
    node, of = declared
    if node is Nodetype.NAME and isinstance(value, dict):
        return build(of, **value)
    return [_part(of[0], each) for each in value] if isinstance(value, list) else value


def header(stamp_ns: int, frame: str) -> Any:
    """std_msgs/Header."""
    seconds, rest = divmod(stamp_ns, 10**9)
    stamp = {"sec": seconds, "nanosec": rest}
    return build("std_msgs/msg/Header", stamp=stamp, frame_id=frame)


def _rotation(theta: float) -> dict[str, float]:
    return {"z": float(np.sin(0.5 * theta)), "w": float(np.cos(0.5 * theta))}


def _planar(pose: Pose, z: float = 0.0) -> dict[str, Any]:
    """The fields of geometry_msgs/Pose."""
    x, y, theta = pose
    return {"position": {"x": x, "y": y, "z": z}, "orientation": _rotation(theta)}


def covariance_6x6(P: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "36"]:
    """Expand a covariance of (x, y) or (x, y, θ) to (x, y, z, roll, pitch, yaw), row-major."""
    rows = np.array([0, 1, 5][: len(P)])
    whole = np.zeros((6, 6))
    whole[np.ix_(rows, rows)] = P
    return whole.ravel()


def pose_with_covariance(stamp_ns: int, frame: str, pose: Pose, P: Float[np.ndarray, "3 3"]) -> Any:
    """geometry_msgs/PoseWithCovarianceStamped."""
    return build(
        "geometry_msgs/msg/PoseWithCovarianceStamped",
        header=header(stamp_ns, frame),
        pose={"pose": _planar(pose), "covariance": covariance_6x6(P)},
    )


def pose_stamped(stamp_ns: int, frame: str, pose: Pose) -> Any:
    """geometry_msgs/PoseStamped."""
    kind = "geometry_msgs/msg/PoseStamped"
    return build(kind, header=header(stamp_ns, frame), pose=_planar(pose))


def transform(stamp_ns: int, parent: str, child: str, pose: Pose) -> Any:
    """geometry_msgs/TransformStamped: the pose of `child` in `parent`."""
    x, y, theta = pose
    return build(
        "geometry_msgs/msg/TransformStamped",
        header=header(stamp_ns, parent),
        child_frame_id=child,
        transform={"translation": {"x": x, "y": y}, "rotation": _rotation(theta)},
    )


def odometry(stamp_ns: int, names: Names, pose: Pose, speeds: tuple[float, float]) -> Any:
    """nav_msgs/Odometry: the pose of the base in the odometry's frame; (forward, yaw rate)."""
    return build(
        "nav_msgs/msg/Odometry",
        header=header(stamp_ns, names.odometry_frame),
        child_frame_id=names.base_frame,
        pose={"pose": _planar(pose)},
        twist={"twist": {"linear": {"x": speeds[0]}, "angular": {"z": speeds[1]}}},
    )


def path(stamp_ns: int, frame: str, poses: Iterable[tuple[int, Pose]]) -> Any:
    """nav_msgs/Path."""
    stamped = [pose_stamped(t, frame, pose) for t, pose in poses]
    return build("nav_msgs/msg/Path", header=header(stamp_ns, frame), poses=stamped)


def ellipse(P: Float[np.ndarray, "2 2"]) -> tuple[float, float, float]:
    """Axes' lengths [m] of the SIGMAS ellipse, and the first one's direction [rad]."""
    values, vectors = np.linalg.eigh(P)
    minor, major = (2.0 * SIGMAS * np.sqrt(np.maximum(values, 0.0))).tolist()
    return major, minor, float(np.arctan2(vectors[1, 1], vectors[0, 1]))


def markers(
    stamp_ns: int,
    frame: str,
    labels: Sequence[str],
    means: Float[np.ndarray, "L 2"],
    blocks: Float[np.ndarray, "L 2 2"],
    named: Sequence[bool],
) -> Any:
    """visualization_msgs/MarkerArray: an ellipse and a label for each landmark.

    The first marker deletes those of the map before. A landmark without identity is grey.
    """
    head = header(stamp_ns, frame)
    found = [{"header": head, "ns": "landmarks", "type": _CYLINDER, "action": _DELETE_ALL,
              "pose": _planar((0.0, 0.0, 0.0)), "scale": {"x": 1.0, "y": 1.0, "z": 1.0},
              "color": _BLUE}]  # fmt: skip
    for k, (x, y) in enumerate(means.tolist()):
        major, minor, turn = ellipse(blocks[k])
        axes = {"x": max(major, LEAST_AXIS_M), "y": max(minor, LEAST_AXIS_M), "z": HEIGHT_M}
        shown = {"header": head, "id": k}
        found.append({**shown, "ns": "landmarks", "type": _CYLINDER, "pose": _planar((x, y, turn)),
                      "scale": axes, "color": _BLUE if named[k] else _GREY})  # fmt: skip
        found.append({**shown, "ns": "labels", "type": _TEXT, "pose": _planar((x, y, 0.0), 0.3),
                      "scale": {"z": 0.3}, "color": _WHITE, "text": labels[k]})  # fmt: skip
    return build("visualization_msgs/msg/MarkerArray", markers=found)


def detections(
    stamp_ns: int,
    frame: str,
    names: Sequence[str],
    means: Float[np.ndarray, "L 2"],
    blocks: Float[np.ndarray, "L 2 2"],
) -> Any:
    """vision_msgs/Detection3DArray: each landmark with its id and its covariance."""
    head = header(stamp_ns, frame)
    found = []
    for name, (x, y), P in zip(names, means.tolist(), blocks, strict=True):
        at = _planar((x, y, 0.0))
        result = {
            "hypothesis": {"class_id": name, "score": 1.0},
            "pose": {"pose": at, "covariance": covariance_6x6(P)},
        }
        found.append({"header": head, "results": [result], "bbox": {"center": at}, "id": name})
    return build("vision_msgs/msg/Detection3DArray", header=head, detections=found)


def diagnostics(
    stamp_ns: int, node: str, state: str, warnings: Sequence[str], figures: Mapping[str, float]
) -> Any:
    """diagnostic_msgs/DiagnosticArray: a node's state, warnings and figures."""
    values = [{"key": name, "value": f"{value:g}"} for name, value in figures.items()]
    values += [{"key": f"warning {k}", "value": text} for k, text in enumerate(warnings, 1)]
    one = {
        "level": 1 if warnings else 0,
        "name": f"teamslam: {node}",
        "message": warnings[-1] if warnings else state,
        "hardware_id": node,
        "values": values,
    }
    kind = "diagnostic_msgs/msg/DiagnosticArray"
    return build(kind, header=header(max(stamp_ns, 0), ""), status=[one])


def transforms(*found: Any) -> Any:
    """tf2_msgs/TFMessage."""
    return build("tf2_msgs/msg/TFMessage", transforms=list(found))
