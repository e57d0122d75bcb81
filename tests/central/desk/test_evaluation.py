import json

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from msgspec.structs import replace

from teamslam.central.desk.compare import compare_rows
from teamslam.central.desk.evaluation.errors import (
    Path,
    interpolate_truth,
    map_errors,
    pose_errors,
    transform_points,
)
from teamslam.central.desk.evaluation.evaluation import evaluate
from teamslam.central.desk.evaluation.figures import to_json
from teamslam.central.desk.report.tables import team_rows
from teamslam.team.config import UNNAMED
from teamslam.team.translate import joint_bytes
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.arrays import floats, from_floats, from_ids, from_stamps
from teamslam.team.wire.bus import Outgoing, Sample
from tests import build
from tests.sim.logs import (
    final_map,
    joined_log,
    online,
    samples,
    scenario,
    streams,
    trajectory,
    without_starts,
    world_log,
)
from tests.sim.reruns import changed

SECOND = 10**9
numbers = st.floats(-50.0, 50.0)


def path(stamps_s: list[float], poses: list[list[float]]) -> Path:
    return Path(np.rint(np.array(stamps_s) * SECOND).astype(np.int64), np.array(poses))


def stamps(*seconds: float) -> np.ndarray:
    return np.rint(np.array(seconds) * SECOND).astype(np.int64)


def done(measurements: int, in_submaps: int) -> Outgoing:
    ledger = (m.Disposition(disposition="in a submap", measurements=in_submaps),)
    last = build.done(stamp_ns=9, measurements=measurements, steps=20, submaps=2, ledger=ledger)
    return Outgoing(ch.ROBOT_DONE, "r1", last)


def submap(sequence: int, first: int, last: int) -> Outgoing:
    used = {"first_measurement": first, "last_measurement": last}
    empty = {"ids": [], "mean": np.zeros(3), "covariance": joint_bytes(np.eye(3))}
    message = build.submap(stamp_ns=sequence + 1, sequence=sequence, start_ns=0, **used, **empty)
    return Outgoing(ch.SUBMAP, "r1", message)


def test_truth_is_interpolated_along_the_shorter_arc():
    truth = path([0.0, 1.0], [[0.0, 2.0, 3.0], [4.0, 0.0, -3.0]])
    poses, known = interpolate_truth(truth, stamps(0.25))
    turn = 2.0 * np.pi - 6.0
    assert known.all()
    np.testing.assert_allclose(poses, [[1.0, 1.5, 3.0 + 0.25 * turn]], atol=1e-12)


def test_truth_is_not_interpolated_across_a_gap_but_known_at_its_ends():
    truth = path([0.0, 1.5, 2.5], [[0.0, 0.0, 0.0], [3.0, 0.0, 0.0], [4.0, 0.0, 0.0]])
    poses, known = interpolate_truth(truth, stamps(0.0, 0.7, 1.5, 2.0))
    assert known.tolist() == [True, False, True, True]
    np.testing.assert_allclose(poses[known, 0], [0.0, 3.0, 3.5])


@settings(deadline=None, max_examples=50)
@given(x=numbers, y=numbers, theta=st.floats(-3.1, 3.1), seed=st.integers(0, 2**31))
def test_a_map_that_is_only_moved_has_no_error_after_alignment(x, y, theta, seed):
    truth = np.random.default_rng(seed).uniform(-20.0, 20.0, (5, 2))
    motion = np.array([x, y, theta])
    errors = map_errors(transform_points(motion, truth), np.eye(10), truth)
    assert errors.aligned_rmse_m is not None
    assert errors.aligned_rmse_m < 1e-9
    shift = transform_points(motion, truth) - truth
    assert errors.rmse_m == pytest.approx(np.sqrt(np.mean(np.sum(shift**2, axis=1))), abs=1e-9)


@pytest.mark.parametrize("count", [2, 3])
def test_the_shape_of_few_landmarks_is_what_their_distances_say(count):
    truth = np.array([[0.0, 0.0], [4.0, 0.0], [0.0, 3.0]])[:count]
    means = truth + np.array([[0.0, 0.0], [0.3, 0.0], [0.0, 0.0]])[:count]
    shape = map_errors(means, 0.01 * np.eye(2 * count), truth).shape
    if count == 2:  # one number: a length of variance 0.02 that is 0.3 too large
        assert shape.nees_per_landmark == pytest.approx(2.0 * 0.09 / 0.02)
        assert shape.coverage == 0.0
    else:
        assert 0.0 < shape.nees_per_landmark < 2.0 * 0.09 / 0.01


def test_coverage_is_the_share_of_poses_within_their_own_95_percent():
    truth = path([0.0, 3.0], [[0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    offsets = [[2.79, 0.0, 0.0], [2.80, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 2.81]]
    errors = pose_errors(path([0.0, 1.0, 2.0, 3.0], offsets), np.tile(np.eye(3), (4, 1, 1)), truth)
    assert errors.coverage == 0.5  # the 95 % quantile of three numbers is 2.795²


def test_a_log_whose_map_is_off_by_a_known_shift_says_so():
    run = evaluate(joined_log(scenario(robots=2), 0.3))
    assert run.map.errors.rmse_m == pytest.approx(0.3 * np.sqrt(2.0))
    assert run.map.errors.aligned_rmse_m == pytest.approx(0.0, abs=1e-9)
    assert run.map.errors.nees_per_dof == pytest.approx(0.09 / 0.01)
    assert not run.map.errors.in_band
    assert run.map.cost_per_dof == 1.5
    for robot in run.robots.values():
        assert robot.smoothed.position_rmse_m == pytest.approx(0.15 * np.sqrt(2.0))
        assert robot.smoothed.heading_rmse_rad == pytest.approx(0.03)
        assert robot.final_pose_nees_per_dof == pytest.approx(0.09 * 0.51 / 0.01 / 3.0)
        assert robot.alignment == "map"
        # The map's own alignment takes its shift of (0.3, −0.3) off; (0.15, −0.15) is left.
        assert robot.aligned_rmse_m == pytest.approx(0.15 * np.sqrt(2.0))
        assert robot.online_aligned_rmse_m is None


TOO_LARGE = (m.Diagnosis(cause="noise_overestimated", robot="r2", value=(0.4,)),)


@pytest.mark.parametrize(("shift", "is_shown"), [(0.3, False), (0.05, True)])
def test_covariances_are_not_called_too_large_where_the_errors_are_larger(shift, is_shown):
    """All submaps share the error, as of a late clock: their differences do not show it."""
    log = joined_log(scenario(robots=2), shift)
    run = evaluate(changed(log, ch.FINAL_MAP, lambda final: replace(final, diagnosis=TOO_LARGE)))
    assert run.map.diagnosis == (TOO_LARGE if is_shown else ())


@pytest.mark.parametrize(("stretch", "is_shown"), [(1.0, True), (1.5, False)])
def test_in_an_arbitrary_frame_the_shape_alone_refutes_too_large_covariances(stretch, is_shown):
    """The truth lies elsewhere: its distance from the map is no error of it."""

    def stretched(final: m.FusedMap) -> m.FusedMap:
        means = from_floats(floats(final.means, "means") * stretch)
        return replace(final, diagnosis=TOO_LARGE, means=means)

    log = joined_log(without_starts(scenario(robots=2)), 3.0)
    run = evaluate(changed(log, ch.FINAL_MAP, stretched))
    assert run.arbitrary_frame
    assert run.map.errors.nees_per_dof > 100.0
    assert run.map.diagnosis == (TOO_LARGE if is_shown else ())


def test_the_json_has_no_unaligned_figure_of_an_arbitrary_frame():
    of = scenario(robots=2)
    known = to_json(evaluate(joined_log(of, 0.3)))
    figures = to_json(evaluate(joined_log(without_starts(of), 0.3)))
    assert figures["landmark_rmse_aligned_m"] == known["landmark_rmse_aligned_m"]
    assert figures["shape_nees_per_landmark"] == known["shape_nees_per_landmark"]
    for name in ("landmark_rmse_m", "map_nees_per_dof", "map_nees_in_band", "landmark_coverage_95"):
        assert known[name] is not None
        assert figures[name] is None
    for name in ("position_rmse_m", "heading_rmse_rad", "pose_nees_per_dof", "pose_coverage_95"):
        assert known["robots"]["r1"][name] is not None
        assert figures["robots"]["r1"][name] is None
    assert figures["robots"]["r1"]["position_rmse_aligned_m"] is not None


@pytest.mark.parametrize(
    ("first", "counted", "once"),
    [(21, 41, True), (20, 41, False), (21, 42, False)],
    ids=["disjoint", "a measurement in two submaps", "a ledger that counts one twice"],
)
def test_a_measurement_that_is_used_twice_is_found(first, counted, once):
    said = [submap(0, 0, 20), submap(1, first, 40), done(41, counted)]
    robot = evaluate(world_log(scenario()) + samples(said)).robots["r1"]
    assert robot.consumption.consumed == 41
    assert robot.consumption.each_once == once


def test_a_log_without_truth_has_no_errors_but_the_rest():
    hidden = (ch.TRUTH.key("r1"), ch.TRUTH_LANDMARKS.key())
    log = [s for s in joined_log(scenario(), 0.1) if s.key not in hidden]
    figures = to_json(evaluate(log))
    assert figures["landmarks"] == 8
    for name in ("landmark_rmse_m", "landmark_rmse_aligned_m", "map_nees_per_dof"):
        assert figures[name] is None
    robot = figures["robots"]["r1"]
    assert robot["steps"] == 20
    for name in ("position_rmse_m", "heading_rmse_rad", "pose_nees_per_dof"):
        assert robot[name] is None


def test_the_trajectory_aligns_itself_where_the_map_can_not():
    of = scenario()
    stream = streams(of).streams[0]
    assert stream.truth is not None
    places = transform_points(np.array([1.0, 2.0, 0.3]), stream.truth[:, :2])
    turned = np.column_stack([places, stream.truth[:, 2]])
    said = [trajectory("r1", stream.truth_ns.tolist(), turned, 1.0)]
    robot = evaluate(world_log(of) + samples(said)).robots["r1"]
    assert robot.alignment == "trajectory"
    assert robot.aligned_rmse_m == pytest.approx(0.0, abs=1e-9)


def test_the_own_pose_counts_only_where_there_is_no_team_pose():
    of = scenario()
    stream = streams(of).streams[0]
    assert stream.truth_ns is not None
    own = online(ch.OWN_POSE, stream.truth[1:] + np.array([3.0, 4.0, 0.0]), of)
    team = online(ch.TEAM_POSE, stream.truth[1:] + np.array([0.0, 1.0, 0.0]), of)
    alone = evaluate(world_log(of) + samples(own)).robots["r1"]
    both = evaluate(world_log(of) + samples([*own, *team])).robots["r1"]
    assert (alone.online_channel, both.online_channel) == ("own/pose", "team/pose")
    assert alone.online.position_rmse_m == pytest.approx(5.0)
    assert both.online.position_rmse_m == pytest.approx(1.0)
    assert both.online.nees_per_dof == pytest.approx(1.0 / 3.0)
    joined = evaluate([*joined_log(of, 0.3), *samples(team)]).robots["r1"]
    # The map's alignment takes its shift of (0.3, −0.3) off the online poses as well.
    assert joined.online_aligned_rmse_m == pytest.approx(np.hypot(0.3, 1.3))


def test_damaged_messages_are_counted_and_left_out():
    log = joined_log(scenario(), 0.1)
    torn = (ch.FINAL_MAP.key(), ch.START.key("r1"))
    damaged = [replace(s, payload=s.payload[:-3]) if s.key in torn else s for s in log]
    run = evaluate([*damaged, Sample("nobody/knows", b"\xc1", 0, 0, 0)])
    assert run.map is None
    assert run.unsound == 2
    assert run.channels["nobody/knows"].bytes == 1


FIGURES = (
    "landmark_rmse_m", "landmark_rmse_aligned_m", "map_nees_per_dof", "joint_cost_per_dof",
    "shape_nees_per_landmark", "shape_coverage_95", "landmark_coverage_95",
    "landmarks", "final_map_digest", "robots", "channels", "processes", "log", "wall_s",
)  # fmt: skip
ROBOT_FIGURES = (
    "steps", "measurements_published", "measurements_consumed", "position_rmse_m",
    "heading_rmse_rad", "pose_nees_per_dof", "pose_coverage_95", "uplink_bytes", "submaps",
    "position_rmse_aligned_m", "online_position_rmse_m", "online_position_rmse_aligned_m",
    "online_pose_nees_per_dof", "online_pose_coverage_95",
)  # fmt: skip


def test_the_json_has_every_promised_name_and_takes_what_the_launcher_adds():
    extra = {"processes": {"world": {"pid": 7, "exit": 0}}, "log": "run.mcap", "wall_s": 1.5}
    figures = json.loads(json.dumps(to_json(evaluate(joined_log(scenario(), 0.1)), extra)))
    assert set(FIGURES) <= set(figures)
    assert set(ROBOT_FIGURES) <= set(figures["robots"]["r1"])
    assert figures["processes"]["world"]["exit"] == 0
    assert set(figures["channels"][ch.ODOMETRY.key("r1")]) == {"messages", "bytes"}


def test_a_frame_that_is_turned_about_its_origin_is_off_by_that_turn_alone():
    """A pose 100 m away errs by 5 m along the circle and 0.13 m across it; sigma there: 1 mm."""
    turn, sigma = 0.05, 0.05
    truth = np.array([[100.0, 0.0, 0.3]])
    pose = np.array([[100.0 * np.cos(turn), 100.0 * np.sin(turn), 0.3 + turn]])
    A = np.array([[1.0, 0.0, pose[0, 1]], [0.0, 1.0, -pose[0, 0]], [0.0, 0.0, 1.0]])
    back = np.linalg.inv(A)
    covariance = back @ np.diag([1e-6, 1e-6, sigma**2]) @ back.T
    stamps = np.array([0])
    found = pose_errors(Path(stamps, pose), covariance[None], Path(stamps, truth))
    assert found.motion_nees[0] == pytest.approx((turn / sigma) ** 2)
    assert found.nees[0] > 1000.0


def test_what_a_driver_never_got_is_a_note():
    figures = {"messages": 90.0, "messages_lost": 9.0, "messages_dropped": 1.0}

    def notes(**of: object) -> tuple[str, ...]:
        said = build.status(stamp_ns=1, node="source/r1", state="ended", **of)
        log = world_log(scenario()) + samples([Outgoing(ch.STATUS, "source/r1", said)])
        return evaluate(log).notes

    (note,) = notes(figures=figures)
    assert note.startswith("r1: 10 messages of its topics are not in its stream, beside 90")
    assert not notes()


def unnamed_log(means: np.ndarray, *, named: int = 0, labels: bool = False) -> list[Sample]:
    """A world whose final map has landmarks without identities, the first `named` excepted."""
    of = scenario()
    world = streams(of)
    ids = [*world.landmark_ids.tolist()[:named], *range(UNNAMED, UNNAMED + len(means) - named)]
    said = [final_map(ids, means, 0.01 * np.eye(2 * len(means)))]
    if labels:  # a scan without labels
        scan = {"stamps": from_stamps([5]), "counts": from_ids([1])}
        none = from_ids([m.NO_LABEL])
        unknown = m.TruthLabels(robot="r1", stamp_ns=5, **scan, labels=none)
        said.append(Outgoing(ch.TRUTH_LABELS, "r1", unknown))
    return world_log(of) + samples(said)


@pytest.mark.parametrize(("named", "labels"), [(0, False), (3, False), (0, True)])
def test_landmarks_without_identities_have_their_errors_by_the_nearest_true_ones(named, labels):
    true = streams(scenario()).landmarks
    means = true + 0.1
    means[-1] += 40.0
    run = evaluate(unnamed_log(means, named=named, labels=labels))
    assert run.map.errors.rmse_m == pytest.approx(0.1 * np.sqrt(2.0))
    assert run.map.known.tolist() == [True] * 7 + [False]
    matching = run.map.matching
    assert (matching.matched, matching.of) == (7 - named, 8 - named)
    words = f"nearest neighbour within {matching.gate_m:.3g} m, {7 - named} of {8 - named} matched"
    rows = dict(team_rows(run))
    assert rows["landmark errors"] == f"by {words}"
    assert rows["landmark RMSE"] == "0.141 m, nearest neighbour"
    assert "association" not in rows
    assert to_json(run)["landmark_matching"] == {
        "gate_m": matching.gate_m, "matched": 7 - named, "of": 8 - named,
        "by": "nearest neighbour",
    }  # fmt: skip
    assert ("landmark errors by", (words,)) in compare_rows({"a": run})


def test_a_map_far_from_all_true_landmarks_has_no_errors_and_says_within_which_gate():
    run = evaluate(unnamed_log(streams(scenario()).landmarks + 100.0))
    assert run.map.errors is None
    assert dict(team_rows(run))["landmark errors"] == (
        f"can not be computed: nearest neighbour within {run.map.matching.gate_m:.3g} m, "
        "0 of 8 matched"
    )


@pytest.mark.parametrize("text", ["x", '{"a": ' + 100_000 * "[" + 100_000 * "]" + "}"])
def test_a_run_whose_configurations_are_not_readable_has_no_scenario(text):
    log = joined_log(scenario(), 0.1)
    for channel in (ch.WORLD_CONFIG, ch.ROBOT_CONFIG):
        log = changed(log, channel, lambda each: replace(each, configuration=text))
    run = evaluate(log)
    assert (run.scenario, run.data_set) == (None, "")
    assert run.map is not None
