"""A robot that differs from its configuration is found, corrected for and named; others are not."""

from pathlib import Path

import numpy as np
import pytest

from teamslam.central.desk.evaluation.evaluation import MapResult, evaluate
from teamslam.central.monitor import deviations
from teamslam.sim.in_memory.team import run_team
from teamslam.sim.scenarios.scenario import load, with_options
from teamslam.sim.scenarios.source import streams_of
from teamslam.team.config import CALIBRATED, Bias
from teamslam.team.estimation.map_joining.marginals import BiasEstimate
from tests.trials.stress_world import StressWorld, write

CONFIGURED = ("its clock_offset_s", "motion.forward_scale", "sensor.bearing_offset")
"""The fields that the warnings name."""


def mapped(world: StressWorld, place: Path, *, blind: bool = False) -> MapResult:
    """The team's final map of this world; blind: without the states of calibration errors."""
    folder = write(world, place)
    if blind:
        path = folder / "scenario.toml"
        text = path.read_text("utf-8")
        path.write_text(
            text.replace("[defaults.front_end]", "[defaults.front_end]\nbiases = []"), "utf-8"
        )
    scenario = with_options(load(str(folder / "scenario.toml")), dataset=folder)
    found = evaluate(run_team(scenario, streams_of(scenario))).map
    assert found is not None
    assert found.errors is not None
    return found


def warnings_of(found: MapResult) -> list[str]:
    return [each for each in found.reasons if any(field in each for field in CONFIGURED)]


FAULTS: dict[str, tuple[StressWorld, str, float, set[str]]] = {
    "clock": (StressWorld(seed=4, late={"r2": 0.1}), "clock_offset_s", 0.1, {"r2"}),
    "bearing": (
        StressWorld(seed=1, bearing_offset={"r2": 0.05}), "bearing_offset", 0.05, {"r2"},
    ),
    "odometry +5 %": (
        StressWorld(seed=1, odometry_scale=1.05), "forward_scale", -4.8, {"r1", "r2", "r3"},
    ),
    "odometry -5 %": (
        StressWorld(seed=1, odometry_scale=0.95), "forward_scale", 5.3, {"r1", "r2", "r3"},
    ),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_a_robot_with_a_fault_is_named_with_its_value_and_the_map_stays_consistent(
    fault: str, tmp_path: Path
) -> None:
    world, field, value, robots = FAULTS[fault]
    found = mapped(world, tmp_path / "seen")
    told = warnings_of(found)
    assert {each.split("'")[0].split()[0] for each in told} == robots
    assert all(field in each for each in told)
    for each in told:
        stated, sigma = (float(word.strip("+")) for word in _figures(each))
        assert abs(stated - value) < max(3.5 * sigma, 0.25 * abs(value))
    assert found.errors is not None
    assert found.errors.nees_per_dof < 2.0
    if "odometry" in fault:  # a lone robot with bearings that are off is withdrawn otherwise
        blind = mapped(world, tmp_path / "blind", blind=True)
        assert not warnings_of(blind)
        assert blind.errors is not None
        assert blind.errors.nees_per_dof > 3.0


def _figures(warning: str) -> tuple[str, str]:
    words = warning.split()
    at = words.index("±")
    return words[at - 1], words[at + 1]


@pytest.mark.parametrize("late", [0.2, 0.5])
def test_a_clock_beyond_the_linear_range_is_named_as_late_and_the_map_gains(
    late: float, tmp_path: Path
) -> None:
    world = StressWorld(seed=1, late={"r2": late})
    found, blind = mapped(world, tmp_path / "seen"), mapped(world, tmp_path / "blind", blind=True)
    (told, *_) = warnings_of(found)
    assert told.startswith("r2's detections are stamped")
    assert "late against" in told
    stated, sigma = map(float, _figures(told))
    assert 0.5 * late < stated < late + 3.0 * sigma
    assert found.errors is not None
    assert blind.errors is not None
    assert found.errors.nees_per_dof < 1.05 * blind.errors.nees_per_dof


def test_a_team_that_is_as_configured_is_not_named(tmp_path: Path) -> None:
    for seed in (1, 2, 3):
        found = mapped(StressWorld(seed=seed), tmp_path / str(seed))
        assert not warnings_of(found)


def test_a_robot_with_one_landmark_keeps_its_configuration(tmp_path: Path) -> None:
    """Nothing determines its errors: their prior does."""
    found = mapped(StressWorld(seed=2, landmarks=1, robots=1, seconds=120.0), tmp_path)
    assert not warnings_of(found)
    assert found.errors is not None
    assert found.errors.nees_per_dof < 5.0


@pytest.mark.parametrize(
    ("value", "sigma", "scale", "named"),
    [
        (0.05, 0.01, 1.0, True),
        (-0.05, 0.01, 1.0, True),
        (0.05, 0.013, 1.0, False),
        (0.05, 0.01, 4.0, False),
        (0.05, 0.01, 0.2, True),
        (0.014, 0.001, 1.0, False),
    ],
    ids=["late", "early", "hardly known", "errors twice as large", "too cautious", "small"],
)
def test_a_bias_is_a_deviation_beyond_four_sigmas_and_three_scales_of_its_prior(
    value: float, sigma: float, scale: float, named: bool
) -> None:
    prior: dict[Bias, float] = dict.fromkeys(CALIBRATED, 0.005)
    biases = [
        BiasEstimate(("r1", 1), "bearing", 0.0, 0.01),
        BiasEstimate(("r2", 1), "clock_offset", value, sigma),
    ]
    found = deviations(biases, prior, scale)
    assert [(each.robot, each.bias) for each in found] == [("r2", "clock_offset")] * named
    if named:
        assert found[0].significance == pytest.approx(
            abs(value) / (sigma * np.sqrt(max(scale, 1.0)))
        )
        late = "late against" if value > 0.0 else "ahead of"
        assert f"0.050 ± 0.010 s {late} its odometry" in str(found[0])
