from functools import cache

import msgspec
import numpy as np
import pytest

from teamslam.central.config import CentralConfig, SurveyedLandmark
from teamslam.central.desk.evaluation.evaluation import evaluate
from teamslam.central.node import CentralNode, make_centre
from teamslam.sim.in_memory.team import final_map, run_team
from teamslam.sim.scenarios.scenario import load
from teamslam.sim.scenarios.source import streams_of
from teamslam.team.config import SURVEY_FRAME
from teamslam.team.core import unpacked
from teamslam.team.saved_map import SavedMapError, map_name
from teamslam.team.wire import messages as m
from teamslam.team.wire.arrays import floats, ids
from teamslam.team.wire.bus import opened
from tests.scenarios import final_only, with_world
from tests.sim.reruns import check_recomputed

SIGMA_M = 0.05
UTM = (399_000.0, 5_756_000.0)  # an origin of the survey far from the site, as in a national grid


@cache
def drive(seed, unknown=("*",)):
    scenario = load("thesis-b")
    scenario = msgspec.structs.replace(
        with_world(scenario, unknown_starts=unknown, steps=200), seed=seed
    )
    streams = streams_of(scenario)
    return scenario, streams, list(run_team(final_only(scenario), streams))


def surveyed_landmarks(seed, numbers, wrong=None, origin=(0.0, 0.0)):
    _, streams, _ = drive(seed)
    noise = np.random.default_rng(seed).normal(0.0, SIGMA_M, (len(numbers), 2))
    at = np.searchsorted(streams.landmark_ids, numbers)
    found = []
    for number, place in zip(
        numbers, (streams.landmarks[at] + noise + origin).tolist(), strict=True
    ):
        x, y = np.add(place, (wrong or {}).get(number, (0.0, 0.0))).tolist()
        found.append(SurveyedLandmark(number, x, y, sigma_m=SIGMA_M))
    return tuple(found)


def fold_drive(seed, surveyed, *, unknown=("*",), maps=()) -> tuple[m.FusedMap, CentralNode]:
    scenario, _, samples = drive(seed, unknown)
    config = msgspec.structs.replace(scenario.central, surveyed=surveyed)
    centre = make_centre(config, [each.id for each in scenario.robots])
    for message in (*maps, *(opened(each)[2] for each in samples)):
        centre.maps.fold.store.add(message)
    return centre.maps.fold.make_map("final")[-1].message, centre


def day(seed, numbers, *, unknown=("*",), wrong=None, origin=(0.0, 0.0)):
    surveyed = surveyed_landmarks(seed, numbers, wrong, origin)
    return fold_drive(seed, surveyed, unknown=unknown)[0], drive(seed)[1]


@cache
def live_day():
    scenario, streams, _ = drive(1)
    central = msgspec.structs.replace(scenario.central, surveyed=surveyed_landmarks(1, (3, 15)))
    return list(run_team(msgspec.structs.replace(scenario, central=central), streams))


def errors(fused: m.FusedMap, streams, origin=(0.0, 0.0)):
    """Absolute RMSE [m], and NEES per degree of freedom in the joint covariance."""
    found = ids(fused.ids, "ids")
    truth = streams.landmarks[np.searchsorted(streams.landmark_ids, found)] + origin
    e = floats(fused.means, "means") - truth.ravel()
    P = unpacked(floats(fused.covariance, "covariance"), len(e))
    return float(np.sqrt((e @ e) / len(found))), float(e @ np.linalg.solve(P, e)) / len(e)


def test_two_surveyed_landmarks_make_the_map_absolute_without_any_known_start():
    samples = live_day()
    fused, streams = final_map(samples), drive(1)[1]
    folded, _ = day(1, (3, 15))
    assert (fused.ids, fused.means) == (folded.ids, folded.means)
    assert fused.frame == SURVEY_FRAME
    assert {each.robot for each in fused.members} == {"r1", "r2"}
    assert not fused.changes
    assert errors(fused, streams)[0] < 0.3
    found = evaluate(samples)
    assert not found.arbitrary_frame
    assert found.map.errors.rmse_m < 0.3
    assert found.robots["r2"].online is not None


def test_the_absolute_covariance_is_right():
    nees = [errors(*day(seed, (3, 9, 15)))[1] for seed in range(8)]
    assert 0.8 < np.mean(nees) < 1.25


def test_one_surveyed_landmark_and_a_known_start_are_in_one_frame():
    fused, streams = day(1, (3,), unknown=("r2",))
    assert fused.frame == SURVEY_FRAME
    assert not any("not joined" in each for each in fused.reasons)
    assert errors(fused, streams)[0] < 0.3


@pytest.mark.parametrize("unknown", [("*",), ()])
def test_a_surveyed_landmark_that_contradicts_the_rest_is_named_and_left_out(unknown):
    numbers = (3, 6, 9, 12, 15)
    fused, streams = day(1, numbers, unknown=unknown, wrong={9: (2.0, 1.0)})
    words = [each for each in fused.reasons if "surveyed landmark" in each]
    assert len(words) == 1
    assert "the surveyed landmark 9 is (" in words[0]
    assert errors(fused, streams)[0] < 0.3


def test_a_sound_survey_warns_of_nothing():
    assert not [r for r in day(1, (3, 15))[0].reasons if "survey" in r]


def test_a_survey_of_another_place_leaves_the_team_its_own_map():
    fused, _ = day(1, (3, 9, 15), wrong={3: (30.0, 0.0), 9: (0.0, 40.0), 15: (9.0, 9.0)})
    assert fused.frame == "r1/1"
    assert any("the surveyed landmarks not joined" in each for each in fused.reasons)


def test_coordinates_of_a_national_grid_lose_no_accuracy():
    a, _ = day(1, (3, 15))
    b, _ = day(1, (3, 15), origin=UTM)
    off = floats(b.means, "means").reshape(-1, 2) - UTM - floats(a.means, "means").reshape(-1, 2)
    assert np.abs(off).max() < 1e-4
    assert b.frame == SURVEY_FRAME


def test_every_map_is_computed_again_from_the_log():
    check_recomputed(live_day())


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
        surveyed = surveyed_landmarks(seed, (3, 9, 15)) if seed == 1 else ()
        fused, centre = fold_drive(seed, surveyed, maps=maps)
        maps = [centre.maps.fold.save_map(f"day{seed}")]
        assert fused.frame == maps[0].frame == SURVEY_FRAME
    assert errors(fused, drive(3)[1])[0] < 0.3
    assert not any("second time" in each for each in fused.reasons)
    fused, _ = fold_drive(3, surveyed_landmarks(3, (3,)), maps=maps)
    assert any("second time" in each for each in fused.reasons)
    with pytest.raises(SavedMapError, match="surveyed"):
        map_name("survey")
