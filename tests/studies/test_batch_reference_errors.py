import msgspec
import pytest
from scipy.stats import chi2

from teamslam.sim.scenarios.scenario import Scenario
from teamslam.sim.studies.batch_reference.reference import batch_map
from tests.scenarios import with_robots, with_world
from tests.sim.logs import joined_log, scenario, without_starts


def lasting_scenario(seed: int) -> Scenario:
    of = scenario(seed)
    sensor = msgspec.structs.replace(
        of.robots[0].sensor,
        range_white=0.1,
        bearing_white=0.1,
        range_correlation_s=10.0,
        bearing_correlation_s=10.0,
    )
    return with_robots(with_world(of, steps=8), sensor=sensor)


@pytest.mark.parametrize("kind", ["profile", "white"], ids=["profile", "mutant: white"])
def test_the_map_is_consistent_where_errors_last_and_not_if_they_are_taken_as_white(kind):
    runs = [batch_map(joined_log(lasting_scenario(seed), 0.02), kind) for seed in range(100, 130)]
    errors = [run.errors for run in runs if run.errors is not None]
    dof = sum(2 * e.count for e in errors)
    total = sum(e.nees_per_dof * 2 * e.count for e in errors)
    inside = chi2.ppf(0.0005, dof) <= total <= chi2.ppf(0.9995, dof)
    assert inside == (kind == "profile"), f"NEES/dof {total / dof:.3f} over {dof}"


def test_in_an_arbitrary_frame_the_figures_have_no_unaligned_error():
    of = scenario()
    known, unknown = (batch_map(joined_log(x, 0.02)).to_json() for x in (of, without_starts(of)))
    for name in ("landmark_rmse_m", "map_nees_per_dof", "map_nees_in_band", "coverage"):
        assert known[name] is not None
        assert known["team"][name] is not None
        assert unknown[name] is unknown["team"][name] is None
    assert known["robots"]["r1"]["position_rmse_m"] is not None
    assert unknown["robots"]["r1"]["position_rmse_m"] is None
    assert unknown["landmark_rmse_aligned_m"] is not None
    assert unknown["shape_nees_per_landmark"] is not None
