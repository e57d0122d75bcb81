"""Build ROS 2 messages of planar poses and landmarks, and encode them as CDR.

Covariances are those of (x, y, θ) in the frame of the header; z, roll and pitch are exactly zero.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from teamslam.team.ros2.definitions import types
from teamslam.team.shapes import Float

SIGMAS = 2.0
"""Radius of the ellipses in standard deviations: 86 % of a landmark's probability in the plane."""
HEIGHT_M = 0.1
LEAST_AXIS_M = 0.02
"""Least length of an ellipse's axis [m], so that an accurate landmark is visible."""
_ADD, _DELETE_ALL = 0, 3
_CYLINDER, _TEXT = 3, 9
_BLUE, _GREY, _WHITE = (0.12, 0.47, 0.71, 0.35), (0.5, 0.5, 0.5, 0.35), (1.0, 1.0, 1.0, 0.9)
Pose = tuple[float, float, float]
"""(x [m], y [m], θ [rad])."""


@dataclass(frozen=True)
class Names:
    """Topics and frames of one robot.

    namespace: begins the robot's topics, as `/alpha`. tf: topic of the transforms. map_frame,
    odometry_frame, base_frame: as in REP 105.
    """

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

    Its topics are beside the odometry's; on the root they are in the namespace of its name.
    Unprefixed frames in a namespace would be those of every robot, so their transforms are on the
    namespace's own `tf`.
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
    """Compose two poses, a ∘ b: b, given in the frame of a, in the frame of a."""
    c, s = float(np.cos(a[2])), float(np.sin(a[2]))
    return a[0] + c * b[0] - s * b[1], a[1] + s * b[0] + c * b[1], _wrapped(a[2] + b[2])


def inverse(a: Pose) -> Pose:
    """Invert a pose, a⁻¹."""
    c, s = float(np.cos(a[2])), float(np.sin(a[2]))
    return -c * a[0] - s * a[1], s * a[0] - c * a[1], _wrapped(-a[2])


def _wrapped(angle: float) -> float:
    return float(np.pi - (np.pi - angle) % (2.0 * np.pi))


# Messages.


def _new(kind: str, **fields: Any) -> Any:
    return types().types[kind](**fields)


def header(stamp_ns: int, frame: str) -> Any:
    """std_msgs/Header."""
    return _new("std_msgs/msg/Header", stamp=_time(stamp_ns), frame_id=frame)


def _time(stamp_ns: int) -> Any:
    seconds, rest = divmod(stamp_ns, 10**9)
    return _new("builtin_interfaces/msg/Time", sec=seconds, nanosec=rest)


def _point(x: float, y: float, z: float = 0.0) -> Any:
    return _new("geometry_msgs/msg/Point", x=x, y=y, z=z)


def _vector(x: float, y: float, z: float = 0.0) -> Any:
    return _new("geometry_msgs/msg/Vector3", x=x, y=y, z=z)


def _rotation(theta: float) -> Any:
    half = 0.5 * theta
    return _new(
        "geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=float(np.sin(half)), w=float(np.cos(half))
    )


def planar_pose(pose: Pose, z: float = 0.0) -> Any:
    """geometry_msgs/Pose."""
    x, y, theta = pose
    return _new("geometry_msgs/msg/Pose", position=_point(x, y, z), orientation=_rotation(theta))


def covariance_6x6(P: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "36"]:
    """Expand a covariance of (x, y) or (x, y, θ) to (x, y, z, roll, pitch, yaw), row-major."""
    rows = np.array([0, 1, 5][: len(P)])
    whole = np.zeros((6, 6))
    whole[np.ix_(rows, rows)] = P
    return whole.ravel()


def pose_with_covariance(stamp_ns: int, frame: str, pose: Pose, P: Float[np.ndarray, "3 3"]) -> Any:
    """geometry_msgs/PoseWithCovarianceStamped."""
    inner = _new(
        "geometry_msgs/msg/PoseWithCovariance",
        pose=planar_pose(pose),
        covariance=covariance_6x6(P),
    )
    kind = "geometry_msgs/msg/PoseWithCovarianceStamped"
    return _new(kind, header=header(stamp_ns, frame), pose=inner)


def transform(stamp_ns: int, parent: str, child: str, pose: Pose) -> Any:
    """geometry_msgs/TransformStamped: the pose of `child` in `parent`."""
    x, y, theta = pose
    inner = _new(
        "geometry_msgs/msg/Transform", translation=_vector(x, y), rotation=_rotation(theta)
    )
    return _new(
        "geometry_msgs/msg/TransformStamped",
        header=header(stamp_ns, parent),
        child_frame_id=child,
        transform=inner,
    )


def odometry(stamp_ns: int, names: Names, pose: Pose, speeds: tuple[float, float]) -> Any:
    """nav_msgs/Odometry: the pose of the base in the odometry's frame; (forward, yaw rate)."""
    zero = np.zeros(36)
    twist = _new(
        "geometry_msgs/msg/Twist", linear=_vector(speeds[0], 0.0), angular=_vector(0, 0, speeds[1])
    )
    return _new(
        "nav_msgs/msg/Odometry",
        header=header(stamp_ns, names.odometry_frame),
        child_frame_id=names.base_frame,
        pose=_new("geometry_msgs/msg/PoseWithCovariance", pose=planar_pose(pose), covariance=zero),
        twist=_new("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=zero),
    )


def pose_stamped(stamp_ns: int, frame: str, pose: Pose) -> Any:
    """geometry_msgs/PoseStamped."""
    kind = "geometry_msgs/msg/PoseStamped"
    return _new(kind, header=header(stamp_ns, frame), pose=planar_pose(pose))


def path(stamp_ns: int, frame: str, poses: Iterable[tuple[int, Pose]]) -> Any:
    """nav_msgs/Path."""
    stamped = [pose_stamped(t, frame, pose) for t, pose in poses]
    return _new("nav_msgs/msg/Path", header=header(stamp_ns, frame), poses=stamped)


def ellipse(P: Float[np.ndarray, "2 2"]) -> tuple[float, float, float]:
    """Return the axes' lengths [m] of the SIGMAS ellipse, and the first one's direction [rad]."""
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
    marker = _marker(stamp_ns, frame)
    found = [marker("landmarks", 0, _CYLINDER, action=_DELETE_ALL)]
    for k, (x, y) in enumerate(means.tolist()):
        major, minor, turn = ellipse(blocks[k])
        axes = max(major, LEAST_AXIS_M), max(minor, LEAST_AXIS_M), HEIGHT_M
        colour = _BLUE if named[k] else _GREY
        found.append(marker("landmarks", k, _CYLINDER, (x, y, turn), axes, colour))
        size = (0.0, 0.0, 0.3)
        found.append(marker("labels", k, _TEXT, (x, y, 0.0), size, _WHITE, text=labels[k], z=0.3))
    return _new("visualization_msgs/msg/MarkerArray", markers=found)


def _marker(stamp_ns: int, frame: str) -> Callable[..., Any]:
    head = header(stamp_ns, frame)
    image = _new("sensor_msgs/msg/CompressedImage", header=header(0, ""), format="",
                 data=np.empty(0, np.uint8))  # fmt: skip
    mesh = _new("visualization_msgs/msg/MeshFile", filename="", data=np.empty(0, np.uint8))

    def build(
        space: str,
        number: int,
        kind: int,
        pose: Pose = (0.0, 0.0, 0.0),
        scale: tuple[float, float, float] = (1.0, 1.0, 1.0),
        colour: tuple[float, float, float, float] = _BLUE,
        *,
        text: str = "",
        action: int = _ADD,
        z: float = 0.0,
    ) -> Any:
        r, g, b, a = colour
        return _new(
            "visualization_msgs/msg/Marker",
            header=head, ns=space, id=number, type=kind, action=action, pose=planar_pose(pose, z),
            scale=_vector(*scale), color=_new("std_msgs/msg/ColorRGBA", r=r, g=g, b=b, a=a),
            lifetime=_new("builtin_interfaces/msg/Duration", sec=0, nanosec=0),
            frame_locked=False, points=[], colors=[], texture_resource="", texture=image,
            uv_coordinates=[], text=text, mesh_resource="", mesh_file=mesh,
            mesh_use_embedded_materials=False,
        )  # fmt: skip

    return build


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
        at = planar_pose((x, y, 0.0))
        pose = _new("geometry_msgs/msg/PoseWithCovariance", pose=at, covariance=covariance_6x6(P))
        hypothesis = _new("vision_msgs/msg/ObjectHypothesis", class_id=name, score=1.0)
        kind = "vision_msgs/msg/ObjectHypothesisWithPose"
        guess = _new(kind, hypothesis=hypothesis, pose=pose)
        box = _new("vision_msgs/msg/BoundingBox3D", center=at, size=_vector(0.0, 0.0))
        kind = "vision_msgs/msg/Detection3D"
        found.append(_new(kind, header=head, results=[guess], bbox=box, id=name))
    return _new("vision_msgs/msg/Detection3DArray", header=head, detections=found)


def diagnostics(
    stamp_ns: int, node: str, state: str, warnings: Sequence[str], figures: Mapping[str, float]
) -> Any:
    """diagnostic_msgs/DiagnosticArray: a node's state, its warnings and its figures."""
    values = [
        _new("diagnostic_msgs/msg/KeyValue", key=name, value=f"{value:g}")
        for name, value in figures.items()
    ]
    values += [
        _new("diagnostic_msgs/msg/KeyValue", key=f"warning {k + 1}", value=text)
        for k, text in enumerate(warnings)
    ]
    one = _new(
        "diagnostic_msgs/msg/DiagnosticStatus",
        level=1 if warnings else 0,
        name=f"teamslam: {node}",
        message=warnings[-1] if warnings else state,
        hardware_id=node,
        values=values,
    )
    kind = "diagnostic_msgs/msg/DiagnosticArray"
    return _new(kind, header=header(max(stamp_ns, 0), ""), status=[one])


def transforms(*found: Any) -> Any:
    """tf2_msgs/TFMessage."""
    return _new("tf2_msgs/msg/TFMessage", transforms=list(found))
