import math
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import msgspec
import numpy as np
import pytest

from teamslam.central.desk.evaluation.errors import MapErrors, map_errors
from teamslam.central.desk.evaluation.evaluation import evaluate
from teamslam.central.desk.evaluation.results import MapResult
from teamslam.central.diagnosis import describe, doubt_signs, to_object
from teamslam.sim.in_memory.team import final_map
from teamslam.sim.scenarios.scenario import Scenario
from teamslam.sim.studies.experiments.true_minimum import final_fold
from teamslam.team.estimation.map_joining.marginals import landmark_map
from teamslam.team.wire import messages as m
from teamslam.team.wire.arrays import floats, ids
from teamslam.team.wire.bus import Sample
from tests.commands import run
from tests.scenarios import final_only, scenario_in, with_front_ends
from tests.sim.reruns import team_samples
from tests.trials.stress_world import Burst, CarriedOff, MovedLandmark, StressWorld, write

WORLD = StressWorld(robots=2, landmarks=12, half_m=10.0, seconds=120.0)
TEAM = StressWorld(landmarks=15, half_m=12.0, seconds=100.0)


def scenario(world: StressWorld, place: Path) -> Scenario:
    return final_only(scenario_in(write(world, place)))


@cache
def noisy(noise: float) -> list[Sample]:
    with TemporaryDirectory() as place:
        return team_samples(scenario(replace(TEAM, noise=noise), Path(place)))


def diagnosed(of: Scenario) -> tuple[m.Diagnosis, ...]:
    return final_map(team_samples(of)).diagnosis


def test_a_right_map_has_no_cause_of_misfit(tmp_path):
    assert diagnosed(scenario(WORLD, tmp_path)) == ()


@pytest.mark.parametrize("by", [(0.5, 0.0), (1.4, 1.4)], ids=["half a metre", "two metres"])
def test_a_landmark_that_was_moved_is_named_with_its_motion(tmp_path, by):
    of = scenario(replace(WORLD, moved=(MovedLandmark(7, by, 60.0),)), tmp_path)
    fused = final_map(team_samples(of))
    first, *_ = fused.diagnosis
    assert (first.cause, first.landmark) == ("landmark_moved", 7)
    for value, sigma, true in zip(first.value, first.sigma, by, strict=True):
        assert value == pytest.approx(true, abs=4.0 * sigma)
        assert sigma < 0.1
    assert first.at_ns * 1e-9 == pytest.approx(60.0, abs=10.0)
    assert describe(first).startswith("landmark 7 moved by (")
    places = [np.array(first.place), np.add(first.place, first.value)]
    means = floats(fused.means, "means").reshape(-1, 2)
    mean = means[ids(fused.ids, "ids").tolist().index(7)]
    away = [float(np.linalg.norm(mean - each)) for each in places]
    assert min(away) < 0.25 * float(np.linalg.norm(first.value))
    assert first.map_has == ("first" if away[0] < away[1] else "second")
    assert f"the map has its {first.map_has} place" in describe(first)
    assert to_object(first)["map_has"] == first.map_has


def test_one_number_of_two_landmarks_is_named(tmp_path):
    first, *_ = diagnosed(scenario(replace(WORLD, same_id=((3, 9),)), tmp_path))
    assert (first.cause, first.landmark) == ("identity_shared", 3)


def wrong_start(world: StressWorld, place: Path) -> m.Diagnosis:
    folder = write(world, place)
    start = folder / "r2" / "start.csv"
    head, row = start.read_text("utf-8").split()
    x, y, a = map(float, row.split(","))
    start.write_text(f"{head}\n{x - 3.0},{y + 2.0},{a - 0.7}\n", "utf-8")
    found, *_ = diagnosed(final_only(scenario_in(folder)))
    return found


def test_a_wrong_initial_pose_is_named_with_its_error(tmp_path):
    found = wrong_start(TEAM, tmp_path)
    assert (found.cause, found.robot) == ("carried_off", "r2")
    assert found.value == pytest.approx((3.0, -2.0, 0.7), abs=0.2)
    assert describe(found).startswith("r2's initial pose is wrong: ")
    assert found.remedy.startswith("correct its initial pose")
    assert "may be the wrong one" not in found.remedy, "the other two agree"
    assert "at_s" not in to_object(found)


@pytest.mark.parametrize("seed", [1, 2])
def test_of_two_initial_poses_that_contradict_each_other_both_are_named(tmp_path, seed):
    found = wrong_start(replace(WORLD, seed=seed), tmp_path)
    (other,) = {"r1", "r2"} - {found.robot}
    assert "initial pose is wrong" in describe(found)
    assert found.remedy.endswith(f"{other}'s may be the wrong one")


def test_a_robot_carried_off_in_its_first_window_has_a_right_initial_pose(tmp_path):
    off = CarriedOff("r2", 4.0, 0.6, 6.0)
    found, *_ = diagnosed(scenario(replace(TEAM, carried_off=(off,)), tmp_path))
    assert (found.cause, found.robot) == ("carried_off", "r2")
    assert 0 < found.at_ns <= 10_000_000_000
    assert describe(found).startswith("r2 was carried off or slipped at ")


def test_a_robot_that_was_carried_off_twice_is_named_with_both_times(tmp_path):
    off = CarriedOff("r2", 5.0, 0.7, 40.0), CarriedOff("r2", 5.0, 0.7, 70.0)
    found = diagnosed(scenario(replace(TEAM, carried_off=off), tmp_path))
    assert {(each.cause, each.robot) for each in found} == {("carried_off", "r2")}
    assert sorted(each.at_ns * 1e-9 for each in found) == pytest.approx([40.0, 70.0], abs=10.0)


def test_wild_measurements_of_a_robot_for_a_while_are_no_fault_of_landmarks(tmp_path):
    wild = Burst("r2", 40.0, 70.0, 1.0, 0.5)
    found = diagnosed(scenario(replace(TEAM, bursts=(wild,)), tmp_path))
    assert not [each for each in found if each.landmark is not None]


def test_the_sign_of_the_bearings_is_doubted_where_a_robot_is_carried_off_three_times():
    """Without landmark names nothing else shows a mirrored robot that has few landmarks."""
    off = m.Diagnosis(cause="carried_off", robot="r2", remedy="leave it")
    start = msgspec.structs.replace(off, robot="r1")
    once = msgspec.structs.replace(start, at_ns=5)
    other = m.Diagnosis(cause="clock_offset", robot="r2", remedy="add")
    often = [msgspec.structs.replace(off, at_ns=at_ns) for at_ns in (1, 2, 3)]
    rest = [once, start, other]
    assert doubt_signs([*often[:2], *rest]) == [*often[:2], *rest]
    found = doubt_signs([*often, *rest])
    assert found[3:] == rest
    for each in found[:3]:
        assert each.remedy.startswith("leave it; ")
        assert "check the sign of its bearings" in each.remedy


def test_a_mirrored_robot_without_landmark_names_is_mirrored_and_not_carried_off(tmp_path):
    world = StressWorld(seed=2, robots=2, landmarks=20, seconds=120.0, hidden=True)
    found = diagnosed(scenario(replace(world, mirrored=("r2",)), tmp_path))
    assert [(each.cause, each.robot) for each in found if each.robot] == [("mirrored", "r2")]
    assert "negate the robot's bearings" in found[0].remedy


def test_a_mirrored_robot_is_named_as_mirrored(tmp_path):
    first, *rest = diagnosed(scenario(replace(TEAM, mirrored=("r2",)), tmp_path))
    assert (first.cause, first.robot) == ("mirrored", "r2")
    assert not rest


@pytest.mark.parametrize(
    ("noise", "cause"), [(2.0, "noise_underestimated"), (0.5, "noise_overestimated")]
)
def test_noise_that_is_stated_wrong_is_named_with_its_factor(noise, cause):
    (found,) = final_map(noisy(noise)).diagnosis
    assert (found.cause, found.robot) == (cause, "")
    assert found.value[0] == pytest.approx(noise**2, rel=0.35)


def test_noise_far_from_the_stated_one_is_answered_by_the_data_first_and_is_no_failure():
    result = evaluate(noisy(5.0))
    (found,) = result.diagnosis
    assert found.cause == "noise_underestimated"
    assert found.remedy.index("check the columns") < found.remedy.index("multiply the sigmas")
    assert result.failures == ()


def test_measurements_that_contradict_each_other_beyond_any_noise_are_no_success():
    result = evaluate(noisy(16.0))
    (of_team,) = [each for each in result.diagnosis if each.cause == "noise_underestimated"]
    assert of_team.robot == ""
    assert "multiply" not in of_team.remedy
    (failure,) = result.failures
    assert failure.startswith("the measurements contradict each other far beyond the stated noise")
    assert "check the columns" in failure
    assert "sensor's frame" not in failure, "these robots measure range and bearing"


def test_points_in_the_axes_of_the_world_fail_the_run_and_name_their_frame(tmp_path):
    place = write(TEAM, tmp_path / "set")
    for robot in sorted(place.glob("r*")):
        t, _, _, theta = np.loadtxt(robot / "truth.csv", delimiter=",", skiprows=1).T
        seen = np.loadtxt(robot / "observations.csv", delimiter=",", skiprows=1)
        angle = seen[:, 3] + np.interp(seen[:, 0], t, np.unwrap(theta))
        x, y = seen[:, 2] * np.cos(angle), seen[:, 2] * np.sin(angle)
        rows = zip(seen[:, 0], seen[:, 1].astype(int), x, y, strict=True)
        lines = ["t_s,landmark,x_m,y_m", *(f"{a!s},{b},{c!s},{d!s}" for a, b, c, d in rows)]
        (robot / "observations.csv").write_text("\n".join(lines) + "\n")
    result = run("rerun", place)
    assert result.exit_code == 1, result.output
    *_, error = result.stderr.splitlines()
    assert "the measurements contradict each other far beyond the stated noise" in error
    frame = "points are in the sensor's frame (ahead, left): check those of r1, r2, r3"
    assert frame in error


def test_noise_that_is_stated_far_too_large_is_answered_by_sigmas_and_units():
    (found,) = final_map(noisy(0.2)).diagnosis
    assert found.cause == "noise_overestimated"
    assert f"by {math.sqrt(found.value[0]):.2g}, or" in found.remedy
    assert "units" in found.remedy


def test_noise_that_is_stated_too_small_widens_the_covariance_of_the_final_map():
    samples = noisy(2.0)
    found = evaluate(samples).map
    stated = landmark_map(final_fold(samples, is_robust=True, has_biases=True), found.ids.tolist())
    before, after = map_errors(stated.means, stated.covariance, found.truth), found.errors
    assert after.rmse_m < 1.05 * before.rmse_m
    assert after.nees_per_dof < after.band[1] < 2.0 < before.nees_per_dof


def test_errors_that_change_slowly_are_noise_and_no_error_that_the_submaps_share(tmp_path):
    """The offset of a robot's bearings is many stated sigmas from 0; the scatter of its submaps
    shows that it is not constant.
    """
    (found,) = diagnosed(scenario(replace(TEAM, correlated_s=20.0), tmp_path))
    assert found.cause == "noise_underestimated"


def test_the_object_of_a_cause_has_a_number_or_the_two_of_a_motion():
    moved = m.Diagnosis(
        cause="landmark_moved", landmark=7, value=(2.0, 0.1), sigma=(0.1, 0.1), at_ns=10**9
    )
    scale = m.Diagnosis(cause="noise_underestimated", value=(4.0,), sigma=(0.5,))
    assert to_object(moved).items() >= {"landmark": 7, "value": [2.0, 0.1], "at_s": 1.0}.items()
    held = msgspec.structs.replace(moved, place=(1.0, -0.5), map_has="second")
    assert "and the map has its second place" in describe(held)
    assert to_object(held)["map_has"] == "second"
    np.testing.assert_allclose(to_object(held)["places"], [[1.0, -0.5], [3.0, -0.4]])
    assert to_object(scale).items() >= {"robot": None, "value": 4.0, "sigma": 0.5}.items()


# Errors that the submaps of a robot share.


ALL = ("r1", "r2", "r3")
CAUSES = ("clock_offset", "odometry_scale", "bearing_offset", "range_offset")


def mapped(world: StressWorld, place: Path, *, blind: bool = False) -> MapResult:
    of = scenario(world, place)
    found = evaluate(team_samples(with_front_ends(of, biases=()) if blind else of)).map
    assert found.errors is not None
    return found


def shared_errors_of(found: MapResult) -> list[m.Diagnosis]:
    return [each for each in found.diagnosis if each.cause in CAUSES]


@pytest.mark.parametrize(
    ("world", "cause", "value", "robots"),
    [
        (StressWorld(seed=4, late={"r2": 0.1}), "clock_offset", 0.1, {"r2"}),
        (StressWorld(bearing_offset={"r2": 0.05}), "bearing_offset", 0.05, {"r2"}),
        (StressWorld(odometry_scale=dict.fromkeys(ALL, 1.05)), "odometry_scale", -0.048, {*ALL}),
    ],
    ids=["clock", "bearing", "odometry +5 %"],
)
def test_a_robot_with_a_fault_is_named_with_its_value_and_the_map_stays_consistent(
    world, cause, value, robots, tmp_path
):
    found = mapped(world, tmp_path / "seen")
    named = [each for each in shared_errors_of(found) if each.cause == cause]
    assert {each.robot for each in named} == robots
    for each in named:
        assert abs(each.value[0] - value) < max(3.5 * each.sigma[0], 0.25 * abs(value))
    assert found.errors.nees_per_dof < 2.0
    if robots == {*ALL}:  # a lone robot with bearings that are off is withdrawn otherwise
        blind = mapped(world, tmp_path / "blind", blind=True)
        assert not shared_errors_of(blind)
        assert blind.errors.nees_per_dof > 3.0


def test_a_clock_beyond_the_linear_range_is_named_as_late(tmp_path):
    late = 0.5
    found = mapped(StressWorld(seed=1, late={"r2": late}), tmp_path)
    named = next(each for each in shared_errors_of(found) if each.cause == "clock_offset")
    assert named.robot == "r2"
    assert 0.5 * late < named.value[0] < late + 3.0 * named.sigma[0]
    assert found.errors.nees_per_dof < 6.0


def test_a_robot_with_one_landmark_keeps_its_configuration(tmp_path):
    """Its biases are determined by their prior alone."""
    found = mapped(StressWorld(seed=2, landmarks=1, robots=1, seconds=120.0), tmp_path)
    assert not shared_errors_of(found)
    assert found.errors.nees_per_dof < 5.0


# The rest of a map with a fault.


ROBUST = StressWorld(seed=3, landmarks=20, half_m=14.0, seconds=150.0)
FAULTS = {
    "20 % outliers": replace(ROBUST, outlier_share=0.2),
    "moved by 2 m": replace(ROBUST, moved=(MovedLandmark(7, (1.4, 1.4), 75.0),)),
    "one identity of two": replace(ROBUST, same_id=((7, 9),)),
    "carried off": replace(ROBUST, carried_off=(CarriedOff("r2", 8.0, 2.0, 75.0),)),
}
WRONG = (7, 9)
"""Landmarks that are left out of the comparison: only the rest of the map must be right."""


def errors_of_rest(found: MapResult) -> MapErrors:
    kept = np.flatnonzero(found.known & ~np.isin(found.ids, WRONG))
    rows = np.column_stack([2 * kept, 2 * kept + 1]).ravel()
    return map_errors(found.means[kept], found.covariance[np.ix_(rows, rows)], found.truth[kept])


@pytest.fixture(scope="module")
def clean(tmp_path_factory):
    return errors_of_rest(mapped(ROBUST, tmp_path_factory.mktemp("clean")))


@pytest.mark.parametrize("fault", FAULTS)
def test_the_rest_of_the_map_is_right(fault, clean, tmp_path):
    found = evaluate(team_samples(scenario(FAULTS[fault], tmp_path)))
    of_rest = errors_of_rest(found.map)
    assert of_rest.count >= clean.count - 1
    assert of_rest.nees_per_dof < 2.2
    assert of_rest.aligned_rmse_m < 2.0 * clean.aligned_rmse_m
    assert not [robot for robot, of in found.states.items() if of.state == "withdrawn"]
