"""Surveyed landmarks fix the team's frame, also where no robot has a known start."""

from functools import cache

import msgspec
import numpy as np
import pytest

from teamslam.central.config import CentralConfig, SurveyedLandmark
from teamslam.central.desk.evaluation.evaluation import evaluate
from teamslam.central.desk.verification.centre import recomputed_centre
from teamslam.central.desk.verification.recorded import Recorded, identity
from teamslam.central.node import CentralNode, make_centre
from teamslam.sim.in_memory.team import final_map, run_team
from teamslam.sim.scenarios.scenario import load
from teamslam.sim.scenarios.source import streams_of
from teamslam.team.config import SURVEY_FRAME
from teamslam.team.estimation.gaussian import unpacked
from teamslam.team.saved_map import SavedMapError, map_name
from teamslam.team.wire import channels as ch
from teamslam.team.wire import messages as m
from teamslam.team.wire.arrays import floats, ids
from teamslam.team.wire.codec import encoded

SIGMA_M = 0.05
UTM = (399_000.0, 5_756_000.0)
"""An origin of the survey far from the site, as in a national grid."""


def world_of(seed: int, unknown: tuple[str, ...], steps: int):
    scenario = load("thesis-b")
    world = msgspec.structs.replace(scenario.world, unknown_starts=unknown, steps=steps)
    scenario = msgspec.structs.replace(scenario, seed=seed, world=world)
    return scenario, streams_of(scenario)


def surveyed_landmarks(seed, streams, numbers, wrong=None, origin=(0.0, 0.0)):
    """Survey landmarks with an error of SIGMA_M; wrong: displacements [m] by number."""
    noise = np.random.default_rng(seed).normal(0.0, SIGMA_M, (len(numbers), 2))
    at = np.searchsorted(streams.landmark_ids, numbers)
    found = []
    for number, place in zip(
        numbers, (streams.landmarks[at] + noise + origin).tolist(), strict=True
    ):
        x, y = np.add(place, (wrong or {}).get(number, (0.0, 0.0))).tolist()
        found.append(SurveyedLandmark(number, x, y, sigma_m=SIGMA_M))
    return tuple(found)


def team(scenario, streams, surveyed, maps=()):
    """Run a team; return the samples and the centre."""
    central = msgspec.structs.replace(scenario.central, surveyed=surveyed)
    scenario = msgspec.structs.replace(scenario, central=central)
    centres = []

    def made(config, names) -> CentralNode:
        centres.append(make_centre(config, names, maps=maps))
        return centres[-1]

    return list(run_team(scenario, streams, central=made)), centres[0]


def day(seed, numbers, *, unknown=("*",), wrong=None, steps=500, origin=(0.0, 0.0)):
    """Run a team with surveyed landmarks."""
    scenario, streams = world_of(seed, unknown, steps)
    surveyed = surveyed_landmarks(seed, streams, numbers, wrong, origin)
    return team(scenario, streams, surveyed)[0], streams


day_once = cache(lambda *args, **options: day(*args, **options))


def errors(fused: m.FusedMap, streams, origin=(0.0, 0.0)):
    """Absolute RMSE [m], and NEES per degree of freedom in the joint covariance."""
    found = ids(fused.ids, "ids")
    truth = streams.landmarks[np.searchsorted(streams.landmark_ids, found)] + origin
    e = floats(fused.means, "means") - truth.ravel()
    P = unpacked(floats(fused.covariance, "covariance"), len(e))
    return float(np.sqrt((e @ e) / len(found))), float(e @ np.linalg.solve(P, e)) / len(e)


def test_two_surveyed_landmarks_make_the_map_absolute_without_any_known_start():
    samples, streams = day_once(1, (3, 15))
    fused = final_map(samples)
    assert fused.frame == SURVEY_FRAME
    assert {each.robot for each in fused.members} == {"r1", "r2"}
    assert not fused.changes
    assert errors(fused, streams)[0] < 0.3
    found = evaluate(samples)
    assert not found.arbitrary_frame
    assert found.map.errors.rmse_m < 0.3
    assert found.robots["r2"].online is not None


def test_the_absolute_covariance_is_right():
    nees = [errors(final_map(s), w)[1] for s, w in (day(k, (3, 9, 15)) for k in range(20))]
    assert 0.8 < np.mean(nees) < 1.25


def test_one_surveyed_landmark_and_a_known_start_are_in_one_frame():
    samples, streams = day(1, (3,), unknown=("r2",))
    fused = final_map(samples)
    assert fused.frame == SURVEY_FRAME
    assert not any("not joined" in each for each in fused.reasons)
    assert errors(fused, streams)[0] < 0.3


@pytest.mark.parametrize("unknown", [("*",), ()])
def test_a_surveyed_landmark_that_contradicts_the_rest_is_named_and_left_out(unknown):
    numbers = (3, 6, 9, 12, 15)
    samples, streams = day(1, numbers, unknown=unknown, wrong={9: (2.0, 1.0)})
    fused = final_map(samples)
    words = [each for each in fused.reasons if "surveyed landmark" in each]
    assert len(words) == 1
    assert "the surveyed landmark 9 is (" in words[0]
    assert errors(fused, streams)[0] < 0.3


def test_a_sound_survey_warns_of_nothing():
    assert not [r for r in final_map(day_once(1, (3, 15))[0]).reasons if "survey" in r]


def test_a_survey_of_another_place_leaves_the_team_its_own_map():
    samples, _ = day(1, (3, 9, 15), wrong={3: (30.0, 0.0), 9: (0.0, 40.0), 15: (9.0, 9.0)})
    fused = final_map(samples)
    assert fused.frame == "r1/1"
    assert any("the surveyed landmarks not joined" in each for each in fused.reasons)


def test_coordinates_of_a_national_grid_lose_no_accuracy():
    near, _ = day(1, (3, 15), steps=200)
    far, _ = day(1, (3, 15), steps=200, origin=UTM)
    a, b = final_map(near), final_map(far)
    off = floats(b.means, "means").reshape(-1, 2) - UTM - floats(a.means, "means").reshape(-1, 2)
    assert np.abs(off).max() < 1e-4
    assert b.frame == SURVEY_FRAME


def test_every_map_is_computed_again_from_the_log():
    samples, _ = day_once(1, (3, 15))
    recorded = Recorded()
    recorded.take_all(samples)
    computed = recomputed_centre(recorded)
    maps = [*recorded.outputs_of(ch.FUSED_MAP), *recorded.outputs_of(ch.FINAL_MAP)]
    for each in maps:
        assert encoded(computed[identity(each.sample.key, each.message)]) == each.sample.payload


@pytest.mark.parametrize(
    ("surveyed", "fusion", "words"),
    [
        ([{"landmark": 1, "x": 0.0, "y": 0.0}] * 2, "join", "once"),
        ([{"landmark": 1, "x": 0.0, "y": 0.0}], "kalman", "rule join"),
        ([{"landmark": 1, "x": 0.0, "y": 0.0, "covariance": [1.0, 2.0, 1.0]}], "join", "definite"),
        ([{"landmark": 1, "x": 0.0, "y": 0.0, "sigma_m": 0.0}], "join", "sigma_m"),
    ],
)
def test_a_meaningless_survey_is_refused_with_the_reason(surveyed, fusion, words):
    with pytest.raises(msgspec.ValidationError, match=words):
        msgspec.convert({"surveyed": surveyed, "fusion": fusion}, CentralConfig)


def test_the_saved_map_of_a_surveyed_day_keeps_its_frame_on_later_days():
    maps = []
    for seed in (1, 2, 3):
        scenario, streams = world_of(seed, ("*",), 300)
        surveyed = surveyed_landmarks(seed, streams, (3, 9, 15)) if seed == 1 else ()
        samples, centre = team(scenario, streams, surveyed, maps)
        maps = [centre.maps.fold.save_map(f"day{seed}")]
        fused = final_map(samples)
        assert fused.frame == maps[0].frame == SURVEY_FRAME
        assert not evaluate(samples).arbitrary_frame
    assert errors(fused, streams)[0] < 0.3
    assert not any("second time" in each for each in fused.reasons)
    samples, _ = team(scenario, streams, surveyed_landmarks(3, streams, (3,)), maps)
    assert any("second time" in each for each in final_map(samples).reasons)
    with pytest.raises(SavedMapError, match="surveyed"):
        map_name("survey")
