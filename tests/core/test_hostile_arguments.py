"""Each entry of the core returns or raises an error of its caller, whatever its arguments.

Every entry of the stub has a valid example. One or two of its arguments, or of its object's
constructor, are replaced by non-finite, huge or negative numbers, by arrays of other shapes, types
and strides, or by None. In `make check-core` an access out of bounds, an overflow or a null
pointer ends the process.
"""

import ast
from collections.abc import Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from zlib import crc32

import numpy as np
import pytest

from teamslam.team import core

DRAWS = 60
NUMBERS = [0.0, -0.0, -1.0, 5e-324, 1e-200, 1e154, -1e308, np.inf, -np.inf, np.nan]
WHOLE = [-(2**63), -1, 0, 1, 2, 7, 40, 2**31, 2**62]
COUNTS = [-1, 0, 1, 2, 7, 40]
"""Of particles, rows and iterations: large ones are no defect but take memory and time."""

POSE, POINT, IDS = np.array([1.0, 2.0, 0.5]), np.array([3.0, -1.0]), np.array([3, 7], np.uint32)
NOISE, NO_CLAIMS = (0.01, 0.0, 1.0, 0.001, 1.0), np.zeros((2, 0))
MEAN = np.array([1.0, 0.2, 0.1, 3.0, 1.0, 2.0, -1.0])
STATE = np.array([0.0, 0.0, 0.0, 1.1, 0.2, 0.1, 3.1, 1.0, 2.0, -1.1, 0.01])
ROWS = np.array([[1.0, 0.2], [2.0, -0.3]])
MEANS, COVARIANCES = np.tile(ROWS, (4, 1, 1)), np.tile([0.1, 0.01, 0.2], (4, 2, 1))


def covariance(n: int) -> np.ndarray:
    return 0.1 * np.eye(n) + 0.01


EXAMPLES = {
    "data": lambda: np.array([0.1, 0.2, 0.3]).tobytes(),
    "check_pose_covariance.data": lambda: covariance(3).tobytes(),
    "check_packed_covariance.data": lambda: np.array([2.0, 0.1, 2.0]).tobytes(),
    "check_blocks.data": lambda: np.array([2.0, 0.1, 2.0]).tobytes(),
    "check_named.data": IDS.tobytes,
    "check_ascending.data": IDS.tobytes,
    "check_blocks.count": lambda: 1,
    "spread_of.headings": lambda: np.array([False, False, True, False]),
    "triangle": POSE.copy,
    "largest.values": ROWS.copy,
    **dict.fromkeys(("count", "iterations"), lambda: 3),
    **dict.fromkeys(("n", "rows", "columns"), lambda: 2),
    "what": lambda: "ranges",
    "key": lambda: bytes(range(16)),
    "random": lambda: core.Random(bytes(range(16))),
    "digest_size": lambda: 8,
    "person": lambda: b"a use",
    "noise": lambda: NOISE,
    **dict.fromkeys(("motion", "pose", "mount", "a_from_b", "a_from_c", "twist"), POSE.copy),
    **dict.fromkeys(("mean", "then", "shift", "xi", "observer", "teammate"), POSE.copy),
    "b_from_c": lambda: np.array([POSE, POSE]),
    "mean_direction.angles": POSE.copy,
    **dict.fromkeys(("covariance", "added"), lambda: covariance(3)),
    **dict.fromkeys(("landmark", "point", "point_in_b", "measurement"), POINT.copy),
    **dict.fromkeys(("A", "B", "P", "a", "b", "c", "upper"), lambda: covariance(4)),
    **dict.fromkeys(("L", "S"), lambda: np.linalg.cholesky(covariance(2))),
    **dict.fromkeys(("forward.B", "solve_factored.B", "error"), POINT.copy),
    **dict.fromkeys(("improved", "robust"), lambda: False),
    **dict.fromkeys(("turns_first", "is_measured", "joined_ranges", "with_nodes"), lambda: False),
    "spread": lambda: np.ones((4, 3)),
    **dict.fromkeys(("x", "y", "angle", "dof"), MEAN.copy),
    **dict.fromkeys(("below", "above", "uniform", "outlier_share", "share", "rest"), lambda: 0.5),
    **dict.fromkeys(("heading", "field_of_view", "gate", "factor"), lambda: 2.0),
    **dict.fromkeys(("submap_gate", "landmark_gate", "covariance_factor"), lambda: 2.0),
    **dict.fromkeys(("cost", "between", "range", "bearing", "tolerance"), lambda: 0.5),
    # maps
    "ids": IDS.copy,
    **dict.fromkeys(("ranges", "bearings"), POINT.__abs__),
    "own": NO_CLAIMS.copy,
    **dict.fromkeys(("landmarks", "measurements"), ROWS.copy),
    "poses": lambda: np.zeros((4, 3)),
    "reduce_scans.poses": lambda: np.zeros((1, 3)),
    "scans": lambda: [made("Scan")],
    **dict.fromkeys(("scan", "more"), lambda: made("Scan")),
    "taken": lambda: np.array([True, False]),
    **{
        f"Scan.{form}.{each}": lambda n=n: b"12345678" * n
        for form in ("polar", "points", "unnamed")
        for each, n in (("ranges", 2), ("bearings", 2), ("positions", 4), ("covariances", 6))
    },
    **{f"Scan.{form}.ids": IDS.tobytes for form in ("polar", "points")},
    **{f"{each}.mean": MEAN.copy for each in ("WholeMap", "WholeMap.joined")},
    **{f"{each}.mean": MEAN.copy for each in ("Chain.append", "corrected", "SubmapFactor")},
    **{
        f"{each}.covariance": lambda: covariance(7)
        for each in ("WholeMap", "WholeMap.joined", "Chain.append", "corrected")
    },
    "sensitivity": lambda: np.ones((1, 7)),
    "curvature": lambda: np.ones((1, 7)),
    "errors": lambda: [(0.1, 0.2, 0)],
    **dict.fromkeys(
        ("prior", "WholeMap.pose_after.submap", "map"),
        lambda: core.WholeMap(IDS, MEAN, covariance(7)),
    ),
    # the graph
    "SubmapFactor.landmarks": lambda: np.array([[0.1, 0.0, 0.2]] * 2),
    "information": lambda: covariance(7),
    "range_power": lambda: np.array([1]),
    **dict.fromkeys(("state", "Pattern.x"), STATE.copy),
    "at": lambda: np.array([0, 3, 6, 8, 10]),
    **dict.fromkeys(
        ("discounted.weights", "SubmapFactor.discounted.weights"), lambda: np.array([0.5, 1])
    ),
    "nodes": lambda: np.array([1, 2]),
    "Quadratic.at": lambda: STATE[3:8].copy(),
    "headings": lambda: np.array([False, False, True, False, False]),
    "Quadratic.information": lambda: covariance(5),
    "slope": lambda: np.ones(5),
    "offset": lambda: np.array([0, 3, 6, 8, 10, 11]),
    "fixed": lambda: np.array([True, False, False, False, False]),
    "submaps": lambda: [(made("SubmapFactor"), np.arange(5))],
    "sightings": lambda: [(0, 1, np.array([1.0, 0.1]), covariance(2), POINT)],
    "priors": lambda: [(np.array([4]), np.zeros(1), np.ones((1, 1)), True)],
    **dict.fromkeys(
        ("Quadratic.woken.places", "Quadratic.woken.nodes"), lambda: np.zeros(0, np.int64)
    ),
    "members": lambda: np.array([2, 3]),
    "leaving": lambda: np.array([True]),
    **dict.fromkeys(("resting", "given_up"), lambda: np.zeros(0, np.int64)),
    "runs": lambda: [np.array([0])],
    "condensed": lambda: made("Quadratic"),
    "graph": lambda: one_graph(),
    "scale": lambda: np.ones(1),
    "sighting_scale": lambda: np.ones(1),
    "damping": lambda: 0.0,
    "halvings": lambda: 4,
    "most_damping": lambda: 1e6,
    "packed": lambda: np.ones(3),
    "squares": lambda: np.array([4.0, 1.0]),
    **dict.fromkeys(("medians", "chi2_scale.dof"), lambda: np.array([4.35, 1.4])),
    "points": lambda: np.tile(ROWS, (2, 1)),
    "of": lambda: np.array([0, 1, 0, 2]),
    "least": lambda: 2,
    "most": lambda: 50.0,
    # sparse
    "sizes": lambda: np.array([3, 2]),
    "column_start": lambda: np.array([0, 2, 3]),
    "Pattern.rows": lambda: np.array([0, 1, 1]),
    "values": lambda: np.concatenate([np.eye(3).ravel(), np.zeros(6), np.eye(2).ravel()]),
    **dict.fromkeys(("Pattern.block.row", "Pattern.block.column"), lambda: 1),
    **dict.fromkeys(("Pattern.quadratic.x", "right"), lambda: np.ones(5)),
    "pattern": lambda: made("Pattern"),
    "unknowns": lambda: np.array([0, 4]),
    # the window
    "particles": lambda: 4,
    **dict.fromkeys(("Window.mount", "OpenWindow.mount"), lambda: (0.1, 0.0, 0.2)),
    **dict.fromkeys(("resample_below", "max_range"), lambda: 0.5),
    **dict.fromkeys(("stamp_ns", "node_ns"), lambda: 10**18),
    **dict.fromkeys(("log_weights", "weights"), lambda: np.full(4, -1.4)),
    **{
        f"{each}.weights": lambda: np.full(4, 0.25)
        for each in ("moments", "on_group", "sample_factor")
    },
    "mean_direction.weights": lambda: np.ones(3),
    "normals": lambda: np.ones((4, 3)),
    "means": MEANS.copy,
    "covariances": COVARIANCES.copy,
    "paths": lambda: np.zeros((1, 4, 3)),
    "keyframes": lambda: np.array([0, 0]),
    "seen": IDS.copy,
    "Window.sensitivity.mean": MEAN.copy,
    # odometry
    **dict.fromkeys(("duration_s", "interval_s", "yaw_rate"), lambda: 0.1),
    **{f"{each}.forward": lambda: 1.0 for each in ("MotionModel.increment", "Odometry.drive")},
    **dict.fromkeys(("forward", "turn", "final_turn", "lateral"), lambda: (0.01, 0.1, 0.1)),
    **dict.fromkeys(("forward_scale", "yaw_scale", "yaw_rate_limit", "slow_scale"), lambda: 1.0),
    **dict.fromkeys(("turn_drag", "veer", "slow_below"), lambda: 0.0),
    **dict.fromkeys(("alpha_interval_s", "shares_interval_s"), lambda: 0.2),
    "calibrated_speed": lambda: (0.1, 0.2),
    "alphas": lambda: None,
    **dict.fromkeys(("wheels", "shares"), lambda: (0.3, 0.01, 0.01)),
    "model": lambda: made("MotionModel"),
    **dict.fromkeys(("end_ns", "stop_ns"), lambda: 3 * 10**9),
    **dict.fromkeys(("duration_ns", "rest_ns", "at_ns"), lambda: 10**9),
    **{f"{each}.forward": lambda: 0.5 for each in ("OdometryInterval", "Segmenter.drive")},
    **{f"{each}.motion": lambda: (POSE, covariance(3)) for each in ("TimedScan", "Keyframe")},
    "Keyframe.shift": lambda: (1.0, 0.0, 0.0, 0.5),
    "Keyframe.rest": lambda: (POSE, covariance(3)),
    "looks": lambda: [made("TimedScan")],
    "is_node": lambda: True,
    **dict.fromkeys(
        ("keyframe", "Window.move.rest", "OpenWindow.move.rest"), lambda: made("Keyframe")
    ),
    "OpenWindow.restart.keyframes": lambda: [made("Keyframe")],
    "segmenter": lambda: driven_segmenter(),
    "interval": lambda: made("OdometryInterval"),
    **dict.fromkeys(("keyframe_ns", "window_ns", "jump_ns"), lambda: 10**9),
    "bounds": lambda: made("StreamBounds"),
    **dict.fromkeys(("interval_s", "speed_m_s", "yaw_rate_rad_s", "extent_m"), lambda: 1e3),
    **dict.fromkeys(("sigma_m", "sigma_rad"), lambda: (1e-8, 1e3)),
    "calibration": lambda: made("Calibration"),
    "most_landmarks": lambda: 3,
    # calibration
    **dict.fromkeys(("range_offset", "bearing_offset", "optical_axis"), lambda: 0.1),
    **dict.fromkeys(("range_scale", "half_field"), lambda: 1.0),
    "lens": lambda: (0.1, 0.0, 0.0),
    "Calibration.ranges": lambda: (0.1, 10.0),
}


def entries_of(stub: str) -> dict[str, list[str] | None]:
    found: dict[str, list[str] | None] = {}
    for node in ast.parse(stub).body:
        members = node.body if isinstance(node, ast.ClassDef) and not node.bases else [node]
        for each in members:
            if isinstance(each, ast.FunctionDef):
                name = each.name if each is node else f"{node.name}.{each.name}"
                names = [one.arg for one in (*each.args.args, *each.args.kwonlyargs)]
                is_property = "property" in [ast.unparse(one) for one in each.decorator_list]
                names = None if is_property else [one for one in names if one != "self"]
                found.setdefault(name.removesuffix(".__init__"), names)
    return found


ENTRIES = entries_of((Path(core.__file__).parent / "_core.pyi").read_text("utf-8"))


def examples_of(name: str) -> dict[str, object]:
    """Example of each argument of an entry: its own, or the one shared by name."""
    own = {each: f"{name}.{each}" for each in ENTRIES[name] or ()}
    return {each: EXAMPLES[at if at in EXAMPLES else each]() for each, at in own.items()}


def made(name: str) -> object:
    return getattr(core, name)(**examples_of(name))


@cache
def one_graph() -> core.SubmapGraph:
    return made("SubmapGraph")


def advanced_window() -> tuple[core.Window, core.Step]:
    window = made("Window")
    return window, window.advance(**examples_of("Window.advance"))


def opened_window() -> core.OpenWindow:
    opened = made("OpenWindow")
    opened.advance(made("Keyframe"))
    return opened


def driven_segmenter() -> core.Segmenter:
    segmenter = made("Segmenter")
    segmenter.observe(10**9, made("Scan"))
    segmenter.observe(3 * 10**9, core.Scan.unnamed(POINT.tobytes(), POINT.tobytes()))
    segmenter.drive(2 * 10**9, 10**9, 0.5, 0.1)
    return segmenter


def longer_chain() -> core.Chain:
    chain = made("Chain")
    chain.append(**examples_of("Chain.append"))
    return chain


OBJECTS = {
    "Window": lambda: advanced_window()[0],
    "Step": lambda: advanced_window()[1],
    "OpenWindow": opened_window,
    "Segmenter": driven_segmenter,
    "Chain": longer_chain,
    "ChainSolution": lambda: longer_chain().solve(3, 1e-6),
}
"""Objects that are not as their constructor makes them, or that have none."""


def call(name: str, arguments: dict[str, object], owner: object) -> object:
    of_class, _, member = name.rpartition(".")
    if not of_class:
        return getattr(core, name)(**arguments)
    entry = getattr(owner, member)
    return entry if ENTRIES[name] is None else entry(**arguments)


def one_of(choices: Sequence[object], rng: np.random.Generator) -> object:
    return choices[int(rng.integers(len(choices)))]


def mutated_array(value: np.ndarray, kind: int, rng: np.random.Generator) -> object:
    axis = int(rng.integers(value.ndim))
    if kind == 1 and value.shape[axis]:
        return np.delete(value, 0, axis)
    if kind == 2:
        return np.concatenate([value, value], axis)
    if kind == 3:
        views = [value[::-1], value.T, value[None], value.ravel(), value[..., None][::2]]
        return one_of(views, rng)
    if kind == 4:
        return value.astype(one_of([np.float32, np.int32, np.uint32, np.bool_], rng))
    if value.size:
        pool = {"f": NUMBERS, "b": [False, True], "u": [0, 3, 2**32 - 1], "i": WHOLE}
        number = np.array(one_of(pool[value.dtype.kind], rng)).astype(value.dtype)
        value = value.copy()
        value[tuple(int(rng.integers(n)) for n in value.shape)] = number
    return value


def mutated(value: object, rng: np.random.Generator) -> object:
    kind = int(rng.integers(8))
    if kind == 0:
        return one_of([None, 0.5, "x", (), MEAN, [[1.0]], core.Random(bytes(16))], rng)
    if isinstance(value, np.ndarray):
        return mutated_array(value, kind, rng)
    if isinstance(value, bool | str):
        return not value
    if isinstance(value, int | float):
        return one_of(COUNTS if isinstance(value, int) else NUMBERS, rng)
    if isinstance(value, bytes):
        return rng.bytes(int(rng.integers(40)))
    if isinstance(value, tuple | list) and value:
        k = int(rng.integers(len(value)))
        changed = [] if kind == 1 else [mutated(value[k], rng)]
        return type(value)([*value[:k], *changed, *value[k + 1 :]])
    return value


@pytest.mark.filterwarnings("ignore:.*encountered in")
@pytest.mark.parametrize("name", ENTRIES)
def test_an_entry_returns_or_refuses_its_arguments(name):
    rng = np.random.default_rng(crc32(name.encode()))
    of_class = name.rpartition(".")[0]

    def owner() -> object:
        return OBJECTS.get(of_class, lambda: made(of_class))() if of_class else None

    call(name, examples_of(name), owner())
    for _ in range(DRAWS):
        arguments = examples_of(name)
        of_owner = {} if of_class in ("", *OBJECTS) else examples_of(of_class)
        for _ in range(int(rng.integers(1, 3))):
            hostile = arguments if arguments and (rng.integers(3) or not of_owner) else of_owner
            if hostile:
                which = list(hostile)[int(rng.integers(len(hostile)))]
                hostile[which] = mutated(hostile[which], rng)
        with suppress(ValueError, TypeError):  # LinAlgError is one
            at = getattr(core, of_class)(**of_owner) if of_owner else owner()
            call(name, arguments, at)


def test_any_stream_of_intervals_and_scans_makes_keyframes_that_a_window_takes():
    rng = np.random.default_rng(1)

    def number(usual: float) -> float:
        return usual if rng.random() < 0.95 else float(one_of(NUMBERS, rng))

    for _ in range(DRAWS):
        segmenter, opened, now_ns = made("Segmenter"), made("OpenWindow"), 0
        for _ in range(40):
            count, duration_ns = int(rng.integers(4)), int(rng.integers(10**9))
            seen = np.array([[number(rng.uniform(0.5, 9.0)) for _ in range(count)] for _ in "rb"])
            ids = rng.integers(6, size=count).astype(np.uint32)
            parts = [row.tobytes() for row in seen]
            named, unnamed = core.Scan.polar(ids.tobytes(), *parts), core.Scan.unnamed(*parts)
            scan = named if rng.random() < 0.7 else unnamed
            segmenter.observe(now_ns + int(rng.integers(-(10**9), 10**9)), scan)
            segmenter.stop_at(now_ns + int(rng.integers(2 * 10**9)))
            now_ns += duration_ns if rng.random() < 0.9 else one_of([-duration_ns, 10**15], rng)
            segmenter.drive(now_ns, duration_ns, number(0.5), number(0.1))
            if segmenter.is_stopped:
                one_of([segmenter.reach_node, segmenter.mark_sighting], rng)()
                segmenter.stop_at(2**62)
                segmenter.go_on()
            opened.advance_by(segmenter)
        rest = segmenter.cut(now_ns)
        opened.advance_by(segmenter)
        opened.confirm()
        opened.move(rest)
        assert len(opened.accepted()) <= len(opened.keyframes_ns)
        assert segmenter.leave() >= segmenter.uncovered == 0
