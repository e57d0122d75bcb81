"""Encode drawable objects as Foxglove messages; the only module that imports their classes.

The map plane is z = 0. Rotations are about z, (0, 0, sin θ/2, cos θ/2).
"""

from collections.abc import Iterable, Sequence
from functools import lru_cache
from typing import Any, Literal

import numpy as np
from foxglove_schemas_protobuf.ArrowPrimitive_pb2 import ArrowPrimitive
from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.CubePrimitive_pb2 import CubePrimitive
from foxglove_schemas_protobuf.CylinderPrimitive_pb2 import CylinderPrimitive
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.KeyValuePair_pb2 import KeyValuePair
from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.Point3_pb2 import Point3
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from foxglove_schemas_protobuf.TextPrimitive_pb2 import TextPrimitive
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from google.protobuf.timestamp_pb2 import Timestamp

from teamslam.central.desk.drawing import ellipses
from teamslam.central.desk.view.drawn import Landmarks
from teamslam.team.shapes import Float
from teamslam.team.wire.views import MAP_FRAME

Shade = tuple[str, float]
"""Colour #rrggbb and opacity."""
TRUTH: Shade = ("#8a93a3", 0.9)
LANDMARK: Shade = ("#f5b83d", 1.0)
_FLAT_M = 0.002
_LEAST_M = 0.01


_LAST_NS = 2**32 * 1_000_000_000 - 1


def stamp(stamp_ns: int) -> Timestamp:
    """Team time as a Foxglove time, clamped to 32 bits of seconds."""
    at = min(max(stamp_ns, 0), _LAST_NS)
    return Timestamp(seconds=at // 1_000_000_000, nanos=at % 1_000_000_000)


def scene(entities: Iterable[SceneEntity]) -> bytes:
    """Scene update; an entity replaces an earlier one of its name."""
    return _encode(SceneUpdate(entities=list(entities)))


def landmarks_entity(stamp_ns: int, landmarks: Landmarks, size_m: float) -> SceneEntity:
    """Team landmarks: dot, 95 % ellipse, number."""
    major, minor, direction = ellipses(landmarks.blocks)
    dots, names = [], []
    for i, ((x, y), name) in enumerate(
        zip(landmarks.means.tolist(), landmarks.ids.tolist(), strict=True)
    ):
        at = _pose(x, y, float(direction[i]))
        width, depth = 2.0 * max(major[i], _LEAST_M), 2.0 * max(minor[i], _LEAST_M)
        dots.append(_disc(at, width, depth, (LANDMARK[0], 0.25)))
        dots.append(_disc(_pose(x, y, 0.0, _FLAT_M), 0.3 * size_m, 0.3 * size_m, LANDMARK))
        names.append(_label(x, y + 0.5 * size_m, str(name), LANDMARK))
    return _entity(stamp_ns, "landmarks", cylinders=dots, texts=names)


def true_landmarks_entity(
    stamp_ns: int, truth: Float[np.ndarray, "T 2"], size_m: float
) -> SceneEntity:
    """True landmarks, as small squares."""
    edge = Vector3(x=0.25 * size_m, y=0.25 * size_m, z=_FLAT_M)
    cubes = [
        CubePrimitive(pose=_pose(x, y, 0.0), size=edge, color=_colour(TRUTH))
        for x, y in truth.tolist()
    ]
    return _entity(stamp_ns, "true landmarks", cubes=cubes)


def robot_entity(
    stamp_ns: int,
    name: str,
    pose: Float[np.ndarray, "3"],
    covariance: Float[np.ndarray, "3 3"],
    trail: Sequence[tuple[float, float]],
    colour: str,
    size_m: float,
    *,
    lost: bool,
) -> SceneEntity:
    """Robot: arrow, 95 % position ellipse, name, recent path."""
    x, y, theta = (float(v) for v in pose)
    P = np.array([[covariance[0, 0], covariance[0, 1], covariance[1, 1]]])
    (major,), (minor,), (direction,) = ellipses(P)
    shade = (colour, 0.35 if lost else 1.0)
    disc = _disc(
        _pose(x, y, float(direction)),
        2.0 * max(major, _LEAST_M),
        2.0 * max(minor, _LEAST_M),
        (colour, 0.2),
    )
    return _entity(
        stamp_ns,
        f"robot {name}",
        arrows=[_arrow(_pose(x, y, theta), size_m, shade)],
        cylinders=[disc],
        lines=[_line([*trail, (x, y)], (colour, 0.9), 3.0)],
        texts=[_label(x, y - 0.8 * size_m, f"{name} (lost)" if lost else name, shade)],
        metadata=[KeyValuePair(key="robot", value=name)],
    )


def true_robot_entity(
    stamp_ns: int, name: str, pose: Float[np.ndarray, "3"], size_m: float
) -> SceneEntity:
    """True pose of a robot."""
    x, y, theta = (float(v) for v in pose)
    arrow = _arrow(_pose(x, y, theta), 0.8 * size_m, (TRUTH[0], 0.6))
    return _entity(stamp_ns, f"true robot {name}", arrows=[arrow])


def path_entity(
    stamp_ns: int, name: str, points: Sequence[tuple[float, float]], shade: Shade, pixels: float
) -> SceneEntity:
    """Path as a line; width in pixels."""
    return _entity(stamp_ns, name, lines=[_line(points, shade, pixels)])


def dots_entity(
    stamp_ns: int, name: str, points: Sequence[tuple[float, float]], shade: Shade, size_m: float
) -> SceneEntity:
    """Places as dots."""
    across = 0.3 * size_m
    dots = [_disc(_pose(x, y, 0.0, _FLAT_M), across, across, shade) for x, y in points]
    return _entity(stamp_ns, name, cylinders=dots)


def transforms(stamp_ns: int, poses: Iterable[tuple[str, Float[np.ndarray, "3"]]]) -> bytes:
    """map_from_robot of each robot."""
    found = []
    for name, pose in poses:
        x, y, theta = (float(v) for v in pose)
        found.append(
            FrameTransform(
                timestamp=stamp(stamp_ns),
                parent_frame_id=MAP_FRAME,
                child_frame_id=f"robot/{name}",
                translation=Vector3(x=x, y=y, z=0.0),
                rotation=_turn(theta),
            )
        )
    return _encode(FrameTransforms(transforms=found))


def pose_in_map(stamp_ns: int, pose: Float[np.ndarray, "3"]) -> bytes:
    """Pose in the frame of the map."""
    x, y, theta = (float(v) for v in pose)
    found = PoseInFrame(timestamp=stamp(stamp_ns), frame_id=MAP_FRAME, pose=_pose(x, y, theta))
    return _encode(found)


def cloud(
    stamp_ns: int,
    points: Float[np.ndarray, "n 2"],
    values: Float[np.ndarray, " n"],
    name: Literal["id", "weight"],
) -> bytes:
    """Planar points with one value each, as float32."""
    packed = np.zeros((len(points), 4), "<f4")
    with np.errstate(over="ignore"):  # infinite beyond 3e38
        packed[:, :2] = points
        packed[:, 3] = values
    kind = PackedElementField.FLOAT32
    fields = [
        PackedElementField(name=each, offset=4 * i, type=kind)
        for i, each in enumerate(("x", "y", "z", name))
    ]
    found = PointCloud(
        timestamp=stamp(stamp_ns),
        frame_id=MAP_FRAME,
        pose=_pose(0.0, 0.0, 0.0),
        point_stride=16,
        fields=fields,
        data=packed.tobytes(),
    )
    return _encode(found)


def log_line(stamp_ns: int, name: str, text: str, *, warns: bool) -> bytes:
    """Line of a log."""
    level = Log.WARNING if warns else Log.INFO
    found = Log(timestamp=stamp(stamp_ns), level=level, message=text, name=name)
    return _encode(found)


def _encode(message: Any) -> bytes:
    return bytes(message.SerializeToString())


def _entity(stamp_ns: int, name: str, **primitives: Any) -> SceneEntity:
    at = stamp(stamp_ns)
    return SceneEntity(timestamp=at, frame_id=MAP_FRAME, id=name, **primitives)


def _arrow(pose: Pose, size_m: float, shade: Shade) -> ArrowPrimitive:
    return ArrowPrimitive(
        pose=pose,
        shaft_length=0.6 * size_m,
        shaft_diameter=0.25 * size_m,
        head_length=0.5 * size_m,
        head_diameter=0.6 * size_m,
        color=_colour(shade),
    )


def _disc(pose: Pose, width: float, depth: float, shade: Shade) -> CylinderPrimitive:
    return CylinderPrimitive(
        pose=pose,
        size=Vector3(x=width, y=depth, z=_FLAT_M),
        bottom_scale=1.0,
        top_scale=1.0,
        color=_colour(shade),
    )


def _line(points: Iterable[tuple[float, float]], shade: Shade, pixels: float) -> LinePrimitive:
    return LinePrimitive(
        type=LinePrimitive.LINE_STRIP,
        pose=_pose(0.0, 0.0, 0.0),
        thickness=pixels,
        scale_invariant=True,
        points=[Point3(x=x, y=y, z=0.0) for x, y in points],
        color=_colour(shade),
    )


def _label(x: float, y: float, text: str, shade: Shade) -> TextPrimitive:
    return TextPrimitive(
        pose=_pose(x, y, 0.0),
        billboard=True,
        font_size=12.0,
        scale_invariant=True,
        color=_colour(shade),
        text=text,
    )


def _pose(x: float, y: float, theta: float, z: float = 0.0) -> Pose:
    return Pose(position=Vector3(x=x, y=y, z=z), orientation=_turn(theta))


def _turn(theta: float) -> Quaternion:
    return Quaternion(x=0.0, y=0.0, z=float(np.sin(0.5 * theta)), w=float(np.cos(0.5 * theta)))


@lru_cache(maxsize=256)
def _colour(shade: Shade) -> Color:
    r, g, b = (int(shade[0][i : i + 2], 16) / 255.0 for i in (1, 3, 5))
    return Color(r=r, g=g, b=b, a=shade[1])
