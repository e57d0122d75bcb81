"""A bearing's standard deviation in degrees is refused in scenarios and by the driver."""

from pathlib import Path

import pytest

from teamslam.sim.scenarios.checks import ScenarioError
from teamslam.sim.scenarios.scenario import load
from teamslam.team.driver.measured import MeasurementError, observations


@pytest.mark.parametrize("place", ["[defaults.sensor]", '[[robots]]\nid = "r1"\n[robots.sensor]'])
def test_a_bearing_s_sigma_in_degrees_is_refused_in_a_scenario(tmp_path: Path, place: str) -> None:
    file = tmp_path / "mine.toml"
    file.write_text(f'base = "waypoints"\n{place}\nbearing_sigma = 2.0\n')
    with pytest.raises(ScenarioError, match=r"2 rad is 115°.*sensor.bearing_sigma; .*0\.0349"):
        load(file)
    file.write_text(f'base = "waypoints"\n{place}\nbearing_sigma = 0.5\n')
    assert load(file).robots[0].sensor.bearing_sigma == 0.5


def test_a_bearing_s_variance_in_degrees_is_refused_by_the_driver() -> None:
    with pytest.raises(MeasurementError, match=r"2 rad is 115°; if it is in degrees, give 0\.0349"):
        observations("r1", 10, [7], ([2.0], [0.1]), [[[0.01, 0.0], [0.0, 4.0]]])
