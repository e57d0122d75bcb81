import sys
from dataclasses import replace

import gtsam
import msgspec
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.stats import chi2

from teamslam.sim.recorded.chains import BatchReferenceError, Chain, Scan, chains_of
from teamslam.sim.scenarios.scenario import Scenario
from teamslam.sim.studies.batch_reference.graph import FLOOR_SIGMAS, factor_graph, values_of
from teamslam.sim.studies.batch_reference.reference import batch_map
from teamslam.team.config import MotionModel, MotionNoise, RobotConfig
from teamslam.team.estimation.models import increment_of
from teamslam.team.estimation.se2 import compose, exponential
from tests.scenarios import with_robots, with_world
from tests.sim.logs import counted_twice, joined_log, scenario, streams, without_starts, world_log

small = st.floats(-0.3, 0.3)


def chain_of_one(motion: MotionModel) -> Chain:
    increment = increment_of(motion, 1.0, 1.0, 0.4)
    nothing = Scan(np.empty(0, np.uint32), np.empty(0), np.empty(0))
    return Chain(
        config=RobotConfig("r1", motion),
        incarnation=1,
        start=np.zeros(3),
        start_covariance=None,
        stamps_ns=np.array([0, 10**9]),
        increments=(increment,),
        scans=(nothing,),
    )


@settings(deadline=None, max_examples=30)
@given(forward=small, left=st.floats(-0.01, 0.01), turn=small)
def test_the_odometry_factor_is_the_increments_gaussian(forward, left, turn):
    noise = MotionNoise(per_s=0.1)
    chain = chain_of_one(MotionModel("velocity", forward=noise, turn=noise, lateral=noise))
    increment = chain.increments[0]
    xi = np.array([forward, left, turn])
    poses = np.array([[1.0, 2.0, 0.5], compose(np.array([1.0, 2.0, 0.5]), increment.mean)])
    poses[1] = compose(poses[1], exponential(xi))
    graph = factor_graph(gtsam, [replace(chain, start=poses[0])], [poses], {}, None)
    values = values_of(gtsam, [poses], {})
    P = increment.covariance + np.diag(FLOOR_SIGMAS) ** 2
    assert 2.0 * graph.error(values) == pytest.approx(xi @ np.linalg.solve(P, xi), rel=1e-6)


def test_a_chain_has_the_measurements_in_order_each_once():
    log, of = world_log(scenario()), scenario()
    chain = chains_of([*reversed(log), *log], of)[0]
    stream = streams(of).streams[0]
    seen = stream.landmark_detections
    assert np.array_equal(chain.stamps_ns[1:], seen.stamps_ns)
    assert np.array_equal(np.concatenate([s.ranges for s in chain.scans]), seen.ranges)
    assert len(chain.increments) == len(chain.scans) == 20


def lasting(of: Scenario) -> Scenario:
    lasts = {f"{x}_white": 0.1 for x in ("range", "bearing")}
    lasts |= {f"{x}_correlation_s": 10.0 for x in ("range", "bearing")}
    return with_robots(of, sensor=msgspec.structs.replace(of.robots[0].sensor, **lasts))


@pytest.mark.parametrize(
    ("case", "kind", "seeds"),
    [("once", "white", 80), ("twice", "white", 30), ("lasting", "profile", 30),
     ("lasting", "white", 30)],
)  # fmt: skip
def test_the_map_is_consistent_unless_measurements_count_twice_or_lasting_errors_as_white(
    case, kind, seeds
):
    """Mutants need fewer runs."""
    errors = []
    for seed in range(100, 100 + seeds):
        of = lasting(scenario(seed)) if case == "lasting" else scenario(seed)
        log = joined_log(with_world(of, steps=8), 0.02)
        found = batch_map(counted_twice(log) if case == "twice" else log, kind).errors
        errors += [] if found is None else [found]
    dof = sum(2 * e.count for e in errors)
    total = sum(e.nees_per_dof * 2 * e.count for e in errors)
    inside = chi2.ppf(0.0005, dof) <= total <= chi2.ppf(0.9995, dof)
    is_right = case == "once" or (case, kind) == ("lasting", "profile")
    assert inside == is_right, f"NEES/dof {total / dof:.3f} over {dof}"


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


def test_without_gtsam_the_error_says_how_to_install_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "gtsam", None)
    with pytest.raises(BatchReferenceError, match=r"pip install '?gtsam"):
        batch_map([])
