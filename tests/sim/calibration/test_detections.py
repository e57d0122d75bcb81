from dataclasses import replace

import numpy as np
import pytest

from teamslam.central.config import CentralConfig
from teamslam.sim.calibration.consistency import factor_by_cost
from teamslam.sim.calibration.detections import claim_notes, detection_figures, windows_of
from teamslam.sim.calibration.figures import Figure
from teamslam.sim.calibration.join import fold_of
from teamslam.sim.scenarios.scenario import load, with_options
from teamslam.sim.scenarios.source import streams_of
from teamslam.sim.world.streams import NO_LABEL
from teamslam.team.association import AssociationProfile
from teamslam.team.config import AssociationSettings
from tests.estimation.association.unnamed_worlds import circle, drive
from tests.scenarios import with_world

REACH_M = 12.0


def world(seed, clutter, missed):
    scenario = load("waypoints")
    scenario = with_world(
        scenario,
        size_m=60.0,
        landmark_count=60,
        visible_to_m=REACH_M,
        steps=150,
        clutter=clutter,
        missed=missed,
    )
    scenario = with_options(scenario, seed=seed, robots=2, identities="hidden")
    return streams_of(scenario), scenario


def found_in(streams, scenario):
    windows = [
        each
        for stream, robot in zip(streams.streams, scenario.robots, strict=True)
        for each in windows_of(stream, robot)
    ]
    return {each.name: each for each in detection_figures(windows)}


@pytest.mark.parametrize(
    ("seed", "clutter", "missed"), [(1, 0.0, 0.1), (2, 0.2, 0.3), (1, 0.4, 0.0)]
)
def test_the_rates_that_were_simulated_are_learnt(seed, clutter, missed):
    streams, scenario = world(seed, clutter, missed)
    seen = np.concatenate([each.landmark_detections.ids for each in streams.streams])
    share = float(np.mean(seen == NO_LABEL))
    scans = sum(len(each.landmark_detections.stamps_ns) for each in streams.streams)
    density = share * len(seen) / scans / (np.pi * REACH_M**2)
    found = found_in(streams, scenario)
    assert found["detection_probability"].value == pytest.approx(1.0 - missed, abs=0.07)
    assert found["clutter_share"].value == pytest.approx(share, rel=0.15, abs=0.02)
    assert found["clutter_per_m2"].value == pytest.approx(density, rel=0.3, abs=5e-4)


def test_no_label_is_looked_at():
    streams, scenario = world(1, 0.2, 0.1)
    other = [
        replace(
            each,
            landmark_detections=replace(
                each.landmark_detections, ids=np.full_like(each.landmark_detections.ids, NO_LABEL)
            ),
        )
        for each in streams.streams
    ]
    without = replace(streams, streams=tuple(other))
    assert found_in(without, scenario) == found_in(streams, scenario)


def test_submaps_that_claim_too_little_give_the_factor_and_a_warning():
    rng = np.random.default_rng(3)
    places = rng.uniform(-12.0, 12.0, (40, 2))
    submaps, _ = drive("r1", circle((0.0, 0.0), 6.0, 12, 1.5), places, rng)
    overconfident = [
        replace(each, local=replace(each.local, covariance=each.local.covariance / 3.0))
        for each in submaps
    ]
    central = CentralConfig(association=AssociationProfile(recent=4))
    factor = factor_by_cost(lambda config: fold_of(overconfident, (), config), central)
    assert factor.value == pytest.approx(3.0, rel=0.2)
    rates = (
        Figure("errors_over_claims", 0.5, 0.1, ""),
        Figure("detection_probability", 0.6, 0.1, ""),
    )
    inside, between, detected = claim_notes(rates, (factor,), AssociationSettings())
    assert inside.startswith("inside windows the errors are 0.71 times")
    assert f"launch with covariance_factor {factor.value:.2g}" in between
    assert detected.startswith("60% of the landmarks in view are detected")
    holds = claim_notes((), (replace(factor, value=1.2),), AssociationSettings())
    assert holds == ()
