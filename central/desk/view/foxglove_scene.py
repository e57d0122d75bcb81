"""Encode drawable objects as Foxglove messages; the only module that imports their classes.

The map plane is z = 0. Rotations are about z, (0, 0, sin θ/2, cos θ/2).
"""

from collections.abc import Callable, Iterable, Sequence
from functools import lru_cache
from typing import Any, Literal

import numpy as np
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

from teamslam.central.desk.drawing import ellipses
from teamslam.central.desk.view.drawn import Landmarks
from teamslam.team.estimation.se2 import Pose
from teamslam.team.shapes import Float
from teamslam.team.wire.views import MAP_FRAME

Fields = dict[str, Any]  # fields of a Foxglove message by name; parts are fields, too
Shade = tuple[str, float]  # colour #rrggbb and opacity
TRUTH: Shade = ("#8a93a3", 0.9)
LANDMARK: Shade = ("#f5b83d", 1.0)
_FLAT_M = 0.002
_LEAST_M = 0.01
_LAST_NS = 2**32 * 1_000_000_000 - 1


def scene(entities: Iterable[Fields]) -> bytes:
    """Scene update; an entity replaces one of its name."""
    return _encode(SceneUpdate, entities=list(entities))


def landmarks_entity(stamp_ns: int, landmarks: Landmarks, size_m: float) -> Fields:
    """Team landmarks: dot, 95 % ellipse, number."""
    dots, names = [], []
    for (x, y), name, *axes in zip(
        landmarks.means.tolist(), landmarks.ids.tolist(), *ellipses(landmarks.blocks), strict=True
    ):
        dots.append(_ellipse(x, y, axes, (LANDMARK[0], 0.25)))
        dots.append(_dot(x, y, size_m, LANDMARK))
        names.append(_label(x, y + 0.5 * size_m, str(name), LANDMARK))
    return _entity(stamp_ns, "landmarks", cylinders=dots, texts=names)


def true_landmarks_entity(stamp_ns: int, truth: Float[np.ndarray, "T 2"], size_m: float) -> Fields:
    """True landmarks, as small squares."""
    edge = {"x": 0.25 * size_m, "y": 0.25 * size_m, "z": _FLAT_M}
    cubes = [
        {"pose": _pose(x, y, 0.0), "size": edge, "color": _colour(TRUTH)} for x, y in truth.tolist()
    ]
    return _entity(stamp_ns, "true landmarks", cubes=cubes)


def robot_entity(
    stamp_ns: int,
    name: str,
    pose: Pose,
    covariance: Float[np.ndarray, "3 3"],
    trail: Sequence[tuple[float, float]],
    colour: str,
    size_m: float,
    *,
    lost: bool,
) -> Fields:
    """Robot: arrow, 95 % position ellipse, name, recent path."""
    x, y, theta = pose.tolist()
    P = np.array([[covariance[0, 0], covariance[0, 1], covariance[1, 1]]])
    axes = [each[0] for each in ellipses(P)]
    shade = (colour, 0.35 if lost else 1.0)
    return _entity(
        stamp_ns,
        f"robot {name}",
        arrows=[_arrow(_pose(x, y, theta), size_m, shade)],
        cylinders=[_ellipse(x, y, axes, (colour, 0.2))],
        lines=[_line([*trail, (x, y)], (colour, 0.9), 3.0)],
        texts=[_label(x, y - 0.8 * size_m, f"{name} (lost)" if lost else name, shade)],
        metadata=[{"key": "robot", "value": name}],
    )


def true_robot_entity(stamp_ns: int, name: str, pose: Pose, size_m: float) -> Fields:
    """True pose of a robot."""
    arrow = _arrow(_pose(*pose.tolist()), 0.8 * size_m, (TRUTH[0], 0.6))
    return _entity(stamp_ns, f"true robot {name}", arrows=[arrow])


def path_entity(
    stamp_ns: int, name: str, points: Sequence[tuple[float, float]], shade: Shade, pixels: float
) -> Fields:
    """Path as a line; width in pixels."""
    return _entity(stamp_ns, name, lines=[_line(points, shade, pixels)])


def dots_entity(
    stamp_ns: int, name: str, points: Sequence[tuple[float, float]], shade: Shade, size_m: float
) -> Fields:
    """Places as dots."""
    return _entity(stamp_ns, name, cylinders=[_dot(x, y, size_m, shade) for x, y in points])


def transforms(stamp_ns: int, poses: Iterable[tuple[str, Pose]]) -> bytes:
    """map_from_robot of each robot."""
    found = []
    for name, pose in poses:
        placed = _pose(*pose.tolist())
        frames = {"parent_frame_id": MAP_FRAME, "child_frame_id": f"robot/{name}"}
        motion = {"translation": placed["position"], "rotation": placed["orientation"]}
        found.append({"timestamp": _stamp(stamp_ns), **frames, **motion})
    return _encode(FrameTransforms, transforms=found)


def pose_in_map(stamp_ns: int, pose: Pose) -> bytes:
    """Pose in the frame of the map."""
    return _encode(PoseInFrame, **_in_map(stamp_ns), pose=_pose(*pose.tolist()))


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
        {"name": each, "offset": 4 * i, "type": kind}
        for i, each in enumerate(("x", "y", "z", name))
    ]
    return _encode(
        PointCloud,
        **_in_map(stamp_ns),
        pose=_pose(0.0, 0.0, 0.0),
        point_stride=16,
        fields=fields,
        data=packed.tobytes(),
    )


def log_line(stamp_ns: int, name: str, text: str, *, warns: bool) -> bytes:
    """Line of a log."""
    level = Log.WARNING if warns else Log.INFO
    return _encode(Log, timestamp=_stamp(stamp_ns), level=level, message=text, name=name)


def _encode(kind: Callable[..., Any], **fields: Any) -> bytes:
    return bytes(kind(**fields).SerializeToString())


def _stamp(stamp_ns: int) -> Fields:
    seconds, nanos = divmod(min(max(stamp_ns, 0), _LAST_NS), 1_000_000_000)
    return {"seconds": seconds, "nanos": nanos}


def _in_map(stamp_ns: int) -> Fields:
    return {"timestamp": _stamp(stamp_ns), "frame_id": MAP_FRAME}


def _entity(stamp_ns: int, name: str, **primitives: list[Fields]) -> Fields:
    return {**_in_map(stamp_ns), "id": name, **primitives}


def _arrow(pose: Fields, size_m: float, shade: Shade) -> Fields:
    return {
        "pose": pose,
        "shaft_length": 0.6 * size_m,
        "shaft_diameter": 0.25 * size_m,
        "head_length": 0.5 * size_m,
        "head_diameter": 0.6 * size_m,
        "color": _colour(shade),
    }


def _ellipse(x: float, y: float, axes: Sequence[float], shade: Shade) -> Fields:
    major, minor, direction = axes
    across = 2.0 * max(major, _LEAST_M), 2.0 * max(minor, _LEAST_M)
    return _disc(_pose(x, y, direction), *across, shade)


def _dot(x: float, y: float, size_m: float, shade: Shade) -> Fields:
    return _disc(_pose(x, y, 0.0, _FLAT_M), 0.3 * size_m, 0.3 * size_m, shade)


def _disc(pose: Fields, width: float, depth: float, shade: Shade) -> Fields:
    size = {"x": width, "y": depth, "z": _FLAT_M}
    return {
        "pose": pose, "size": size, "bottom_scale": 1.0, "top_scale": 1.0, "color": _colour(shade),
    }  # fmt: skip


def _line(points: Iterable[tuple[float, float]], shade: Shade, pixels: float) -> Fields:
    return {
        "type": LinePrimitive.LINE_STRIP,
        "pose": _pose(0.0, 0.0, 0.0),
        "thickness": pixels,
        "scale_invariant": True,
        "points": [{"x": x, "y": y, "z": 0.0} for x, y in points],
        "color": _colour(shade),
    }


def _label(x: float, y: float, text: str, shade: Shade) -> Fields:
    return {
        "pose": _pose(x, y, 0.0), "billboard": True, "font_size": 12.0, "scale_invariant": True,
        "color": _colour(shade), "text": text,
    }  # fmt: skip


def _pose(x: float, y: float, theta: float, z: float = 0.0) -> Fields:
    turn = {"x": 0.0, "y": 0.0, "z": float(np.sin(0.5 * theta)), "w": float(np.cos(0.5 * theta))}
    return {"position": {"x": x, "y": y, "z": z}, "orientation": turn}


@lru_cache(maxsize=256)
def _colour(shade: Shade) -> Fields:
    r, g, b = (int(shade[0][i : i + 2], 16) / 255.0 for i in (1, 3, 5))
    return {"r": r, "g": g, "b": b, "a": shade[1]}
