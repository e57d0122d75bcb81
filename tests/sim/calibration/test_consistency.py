from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from teamslam.central.config import CentralConfig
from teamslam.central.tick_fold import join_settings
from teamslam.sim.calibration.consistency import (
    EXCESSIVE,
    central_figures,
    covariance_factor,
    disagreements,
    factor_by_cost,
    landmark_sigma,
    without_excess,
)
from teamslam.sim.calibration.detections import claim_notes, detection_figures, windows_of
from teamslam.sim.calibration.figures import Figure
from teamslam.sim.calibration.join import fold_of, join_team
from teamslam.sim.scenarios.scenario import Scenario, load, with_options
from teamslam.sim.scenarios.source import streams_of
from teamslam.sim.world.config import SimulatedWorld
from teamslam.sim.world.simulator import simulate
from teamslam.sim.world.streams import NO_LABEL
from teamslam.team.association import AssociationProfile
from teamslam.team.config import (
    AssociationSettings,
    FrontEnd,
    MotionModel,
    MotionNoise,
    RobotConfig,
    Sensor,
)
from teamslam.team.estimation.hybrid_slam.window import Innovation
from teamslam.team.estimation.map_joining.joining import Fold, JoinSettings, solve_fold
from tests.estimation.association.unnamed_worlds import circle, drive
from tests.estimation.sighting_world import joined_with
from tests.estimation.submap_world import team
from tests.scenarios import with_world

SIGMAS = (0.05, 0.01, 0.1)


@cache
def folds_of(seeds, claimed=1.0):
    folds: list[Fold] = []
    for seed in seeds:
        world = team(seed, robots=4, submaps=8, landmarks=8, reach=30.0, sigmas=SIGMAS)
        submaps = [told(each, claimed) for each in world.submaps]
        fold = joined_with(submaps, world.starts, (), JoinSettings(), len(submaps))
        folds.append(solve_fold(fold, JoinSettings()))
    return folds


def told(contribution, claimed):
    local = replace(contribution.local, covariance=claimed * contribution.local.covariance)
    return replace(contribution, local=local)


def test_robots_whose_covariances_are_right_disagree_as_much_as_they_say():
    settings = join_settings(CentralConfig())
    found = np.array(
        [each for fold in folds_of(range(30)) for each in disagreements(fold, settings)]
    )
    assert len(found) == 120
    assert (found[:, 1] == 13).all()
    # The four of a team share submaps in the others' maps, so their D is not independent.
    assert found[:, 0].sum() / found[:, 1].sum() == pytest.approx(1.0, abs=0.15)


def test_the_factor_makes_up_for_covariances_that_are_too_small():
    factor = covariance_factor(folds_of(range(12), 0.4), CentralConfig())
    assert factor.value == pytest.approx(2.5, rel=0.2)
    assert 0.0 < factor.sigma < 0.4


def test_figures_of_the_team_are_named_as_the_centres_fields():
    stray = Figure("bias_sigma.range_scale", 0.01, 0.001, "")
    found = central_figures(folds_of(range(12), 0.4), load("thesis"), [stray], lambda _: None)
    assert [each.name for each in found] == [stray.name, "covariance_factor", "normal_scale"]
    assert found[-1].value == pytest.approx(1.0, abs=0.3)


def central_of(folds):
    return central_figures(folds, load("thesis"), (), lambda _: None)


def test_sigmas_that_nis_shows_too_large_stay_in_sight_of_the_monitor():
    figures = central_of(folds_of(range(12), 2.25))
    assert figures[-1].value == pytest.approx(1.0 / 2.25, rel=0.2)
    sensor = Sensor(range_sigma=0.09, bearing_sigma=0.03)
    found, notes = without_excess(figures, Innovation(4000.0 / 2.25, 4000), 4000.0, sensor)
    assert [each.name for each in found] == [each.name for each in figures]
    assert found[-1].value == pytest.approx(2.25 * figures[-1].value)
    assert notes[0].startswith(
        "NIS 0.44 per degree of freedom: the stated sigmas are too large by 1.5: multiply those "
        "of sensor and odometry by 0.67 (range_sigma = 0.06 for 0.09, bearing_sigma = 0.02 "
    )


@pytest.mark.parametrize(
    ("nis", "least", "factor"),
    [
        (1.0, 1.0, Figure("covariance_factor", 1.1, 0.5, "")),
        (0.56, 0.62, Figure("covariance_factor", 1.1, 0.5, "")),  # white shares below 1
        (0.44, 1.0, Figure("covariance_factor", 2.6, 0.9, "")),  # robots disagree
    ],
)
def test_a_normal_scale_of_errors_that_outlast_windows_stays(nis, least, factor):
    figures = (factor, Figure("normal_scale", 0.28, 0.01, ""))
    innovation = Innovation(4000 * nis, 4000)
    assert without_excess(figures, innovation, 4000 * least, Sensor()) == (figures, ())


def test_how_far_all_robots_see_landmarks_from_their_survey_is_learnt_by_the_truth():
    folds, config = folds_of(range(30))[:12], CentralConfig()
    rng = np.random.default_rng(5)
    exact = [
        dict(enumerate(team(seed, robots=4, submaps=8, landmarks=8).landmarks))
        for seed in range(12)
    ]
    surveyed = [
        {id_: place + rng.normal(0.0, 0.08, 2) for id_, place in each.items()} for each in exact
    ]
    none = landmark_sigma(list(zip(folds, exact, strict=True)), config)
    found = landmark_sigma(list(zip(folds, surveyed, strict=True)), config)
    assert none.value < 0.02
    assert found.value == pytest.approx(0.08, abs=3.0 * found.sigma)
    assert found.sigma < 0.015


def test_where_the_covariances_are_wider_than_the_errors_landmarks_have_no_sigma():
    folds = folds_of(range(5), 4.0)[:4]
    true = [
        dict(enumerate(team(seed, robots=4, submaps=8, landmarks=8).landmarks)) for seed in range(4)
    ]
    found = landmark_sigma(list(zip(folds, true, strict=True)), CentralConfig())
    assert found.value == 0.0


def test_lasting_errors_lower_nis_by_no_more_than_their_share():
    motion = MotionModel(
        forward=MotionNoise(per_m=0.01), turn=MotionNoise(per_m=0.02, per_rad=0.02)
    )
    sensor = Sensor(range_sigma=0.05, bearing_sigma=0.02, range_white=0.3, bearing_white=0.3)
    robot = RobotConfig("r1", motion, sensor, FrontEnd(particles=50, window_s=10.0))
    place = SimulatedWorld(
        steps=120, size_m=12.0, landmark_count=15, visible_from_m=0.5, visible_to_m=6.0
    )
    told = Scenario(name="one", team="one", world=place, robots=(robot,))
    team_of_one = join_team(simulate(place, told.robots, 11), told)
    nis = team_of_one.innovation
    assert team_of_one.least == pytest.approx(0.3 * nis.dof)
    assert team_of_one.least < nis.squared < EXCESSIVE * nis.dof


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
