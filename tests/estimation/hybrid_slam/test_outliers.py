from dataclasses import replace

import msgspec
import numpy as np
import pytest

from teamslam.central.desk.evaluation.evaluation import evaluate
from teamslam.sim.in_memory.team import run_team
from teamslam.sim.scenarios.scenario import Scenario, load
from teamslam.sim.scenarios.source import streams_of
from teamslam.sim.world.streams import RobotStream
from teamslam.team.config import RobotConfig
from teamslam.team.estimation.hybrid_slam.pipeline import OpenWindow
from teamslam.team.robot.node import RobotNode
from teamslam.team.wire import messages as m
from tests.scenarios import final_only, with_front_ends, with_world
from tests.teams import config, driven, published, stream


def robot() -> RobotConfig:
    plain = config()
    front_end = msgspec.structs.replace(plain.front_end, window_s=5.0)
    return msgspec.structs.replace(plain, front_end=front_end)


def spoilt(given: RobotStream) -> RobotStream:
    seen = given.landmark_detections
    rows = np.arange(len(seen.ids)) % 5 == 2
    ranges = np.where(rows, 2.0 + seen.ranges, seen.ranges)
    bearings = np.where(rows, 0.8 - seen.bearings, seen.bearings)
    return replace(given, landmark_detections=replace(seen, ranges=ranges, bearings=bearings))


def submaps(of: RobotConfig, measurements: list[m.Measurement]) -> list[m.Submap]:
    sent = driven(RobotNode(of), measurements)
    return [each.message for each in sent if isinstance(each.message, m.Submap)]


def test_a_submap_is_as_if_the_outliers_had_never_been_measured():
    clean = stream("r1", 20)
    seen = clean.landmark_detections
    rows = np.arange(len(seen.ids)) % 5 == 2
    kept = np.concatenate(([0], np.cumsum(~rows)))
    less = replace(
        clean,
        landmark_detections=replace(
            seen, offsets=kept[seen.offsets], ids=seen.ids[~rows], ranges=seen.ranges[~rows],
            bearings=seen.bearings[~rows],
        ),
    )  # fmt: skip
    found, expected = (submaps(robot(), published(each)) for each in (spoilt(clean), less))
    pairs = [each for each in zip(found, expected, strict=True) if each[0].ids == each[1].ids]
    assert len(pairs) >= len(found) - 1, "in one window landmarks with one measurement are left out"
    for one, other in pairs:
        assert (one.mean, one.covariance) == (other.mean, other.covariance)
    assert sum(s.gated for s in found) >= np.count_nonzero(rows)


def test_of_clean_measurements_none_is_gated_and_each_window_is_computed_once(monkeypatch):
    confirm, particles = OpenWindow.confirm, config().front_end.particles

    def counted(window: OpenWindow) -> None:
        confirm(window)
        with_more = len(window.particles.particles.poses) > particles
        assert window.core.restarts == with_more, "computed again, and not with more particles"

    monkeypatch.setattr(OpenWindow, "confirm", counted)
    assert sum(s.gated for s in submaps(config(), published(stream("r1", 20)))) == 0


def world_with(kind: str, steps: int = 200) -> Scenario:
    scenario = load("thesis-b")
    scenario = with_world(scenario, steps=steps, outlier_share=0.3, outlier_kind=kind)
    return with_front_ends(scenario, particles=60)


def aligned_rmse(scenario: Scenario) -> float:
    found = evaluate(list(run_team(final_only(scenario), streams_of(scenario)))).map
    assert found.errors.aligned_rmse_m is not None
    return found.errors.aligned_rmse_m


@pytest.fixture(scope="module")
def clean_rmse():
    return aligned_rmse(world_with("drop"))


@pytest.mark.parametrize("kind", ["measurement", "identity"])
def test_with_outliers_the_map_is_nearly_that_of_the_good_measurements(kind, clean_rmse):
    assert aligned_rmse(world_with(kind)) < 1.3 * clean_rmse
