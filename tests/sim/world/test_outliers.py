import numpy as np
import pytest
from scipy.stats import kstest

from teamslam.sim.scenarios.scenario import load
from teamslam.sim.scenarios.source import streams_of
from teamslam.sim.world.streams import WorldStreams
from tests.scenarios import with_world
from tests.sim.world.test_simulator import content


def world_with(outlier_share: float, kind: str, name: str = "thesis-b") -> WorldStreams:
    scenario = load(name)
    return streams_of(with_world(scenario, outlier_share=outlier_share, outlier_kind=kind))


@pytest.fixture(scope="module")
def clean():
    return world_with(0.0, "measurement")


def joined(world: WorldStreams, field: str) -> np.ndarray:
    return np.concatenate([getattr(s.landmark_detections, field) for s in world.streams])


def test_three_in_ten_measurements_are_spoilt_the_same_ones_for_every_kind(clean):
    spoilt = world_with(0.3, "measurement")
    other = world_with(0.3, "identity")
    dropped = world_with(0.3, "drop")
    bad = joined(spoilt, "ranges") != joined(clean, "ranges")
    assert np.mean(bad) == pytest.approx(0.3, abs=3.3 * np.sqrt(0.21 / len(bad)))
    assert np.array_equal(joined(other, "ids") != joined(clean, "ids"), bad)
    for field in ("ids", "ranges", "bearings"):
        assert np.array_equal(joined(dropped, field), joined(clean, field)[~bad])
        assert np.array_equal(joined(spoilt, field)[~bad], joined(clean, field)[~bad])
    assert np.array_equal(joined(spoilt, "ids"), joined(clean, "ids"))
    assert np.array_equal(joined(other, "ranges"), joined(clean, "ranges"))


def test_what_is_spoilt_is_the_landmarks_measurements_alone(clean):
    for kind in ("measurement", "identity", "drop"):
        for before, after in zip(clean.streams, world_with(0.3, kind).streams, strict=True):
            assert np.array_equal(before.stamps_ns, after.stamps_ns), "no message is lost"
            assert np.array_equal(before.intervals.forward, after.intervals.forward)
            assert np.array_equal(
                before.teammate_detections.ranges, after.teammate_detections.ranges
            )
            assert np.array_equal(before.truth, after.truth)


def test_a_spoilt_measurement_is_uniform_over_what_can_be_seen(clean):
    spoilt = world_with(1.0, "measurement")
    assert kstest((joined(spoilt, "ranges") - 3.0) / 17.0, "uniform").pvalue > 1e-3
    assert kstest(joined(spoilt, "bearings") / (2.0 * np.pi) + 0.5, "uniform").pvalue > 1e-3
    assert kstest((joined(clean, "ranges") - 3.0) / 17.0, "uniform").pvalue < 1e-3


def test_a_world_without_outliers_is_as_it_was_whatever_its_kind(clean):
    for before, after in zip(clean.streams, world_with(0.0, "drop").streams, strict=True):
        assert content(before) == content(after)
