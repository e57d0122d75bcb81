import dataclasses
from functools import cache

import msgspec
import numpy as np
import pytest

from teamslam.central.config import CentralConfig, SurveyedLandmark
from teamslam.central.desk.evaluation.evaluation import evaluate
from teamslam.central.desk.export.take_home import take_home
from teamslam.central.desk.verification.centre import recorded_map
from teamslam.central.desk.verification.recorded import Recorded
from teamslam.central.node import CentralNode, make_centre
from teamslam.central.survey import datum_of
from teamslam.sim.in_memory.team import final_map, run_team
from teamslam.sim.scenarios.scenario import load, with_options
from teamslam.sim.scenarios.source import streams_of
from teamslam.team.config import GNSS, SURVEY_FRAME, Bounds, Gnss
from teamslam.team.core import unpacked
from teamslam.team.datum import Datum
from teamslam.team.estimation.plausibility import sighting_beyond
from teamslam.team.saved_map import SavedMapError, datum_in, map_figures, map_name
from teamslam.team.translate import sighting_of
from teamslam.team.wire import messages as m
from teamslam.team.wire.arrays import floats, ids
from teamslam.team.wire.bus import opened
from tests.central.test_withdrawal import messages
from tests.scenarios import final_only, with_front_ends, with_robots, with_world
from tests.sim.reruns import check_recomputed

SIGMA_M = 0.05
UTM = (399_000.0, 5_756_000.0)  # an origin of the survey far from the site, as in a national grid


@cache
def drive(seed, unknown=("*",)):
    scenario = with_world(load("thesis-b"), unknown_starts=unknown, steps=200)
    scenario = with_options(scenario, seed=seed)
    streams = streams_of(scenario)
    return scenario, streams, list(run_team(final_only(scenario), streams))


def surveyed_landmarks(seed, numbers, wrong=None, origin=(0.0, 0.0)):
    _, streams, _ = drive(seed)
    noise = np.random.default_rng(seed).normal(0.0, SIGMA_M, (len(numbers), 2))
    off = [(wrong or {}).get(number, (0.0, 0.0)) for number in numbers]
    true = streams.landmarks[np.searchsorted(streams.landmark_ids, numbers)]
    places = zip(numbers, (true + noise + origin + off).tolist(), strict=True)
    return tuple(SurveyedLandmark(number, *place, sigma_m=SIGMA_M) for number, place in places)


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
    assert not [each for each in folded.reasons if "survey" in each]
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
    (words,) = (each for each in fused.reasons if "surveyed landmark" in each)
    assert "the surveyed landmark 9 is (" in words
    assert errors(fused, streams)[0] < 0.3


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


# Fixes of a satellite receiver.


FIX_SIGMA_M = 0.3
ANTENNA = (0.8, -0.5)
DATUM = Datum(48.745, 9.105)


def with_fixes(stream, seed, origin, jumps):
    """A fix every 2 s at the antenna; jumps: indices of fixes displaced by 15 m."""
    at = np.arange(0, len(stream.truth), 2)
    x, y, turn = stream.truth[at].T
    s, c = np.sin(turn), np.cos(turn)
    (ahead, left), noise = ANTENNA, np.random.default_rng(seed).normal(0, FIX_SIGMA_M, (len(at), 2))
    fixes = np.column_stack([x + c * ahead - s * left, y + s * ahead + c * left]) + noise + origin
    fixes[list(jumps)] += [15.0, 0.0]
    fixes = np.hstack([fixes, np.full((len(at), 3), np.nan)])
    return dataclasses.replace(stream, fixes_ns=stream.truth_ns[at], fixes=fixes)


@cache
def day_with_fixes(*, origin=(0.0, 0.0), jumps=(), live=False):
    """A day of `thesis-b` without known starts; r1 has fixes."""
    scenario = with_world(load("thesis-b"), unknown_starts=("*",), steps=250)
    scenario = with_robots(scenario, gnss=Gnss(antenna=ANTENNA, sigma_m=FIX_SIGMA_M))
    scenario = with_front_ends(scenario, node_s=2.0)
    central = msgspec.structs.replace(scenario.central, datum=DATUM)
    scenario = msgspec.structs.replace(scenario, seed=3, central=central)
    streams = streams_of(scenario)
    first, *others = streams.streams
    own = (with_fixes(first, 3, np.array(origin), jumps), *others)
    scenario = scenario if live else final_only(scenario)
    return list(run_team(scenario, dataclasses.replace(streams, streams=own))), streams


def fixes_in(samples):
    return [each for each in messages(samples, m.SightingFactor) if each.teammate == GNSS]


def test_fixes_of_one_robot_place_a_team_without_known_starts():
    samples, streams = day_with_fixes()
    fused = final_map(samples)
    assert fused.frame == SURVEY_FRAME
    assert {each.robot for each in fused.members} == {"r1", "r2"}
    assert not any("fixes" in each for each in fused.reasons)
    rmse, nees = errors(fused, streams)
    assert rmse < 0.3
    assert nees < 2.0
    used = [n for each in fixes_in(samples) for n in each.measurements]
    assert len(used) == len(set(used)) > 50


def test_a_fix_that_jumps_moves_nothing():
    samples, streams = day_with_fixes(jumps=tuple(range(5, 120, 10)))
    rmse, nees = errors(final_map(samples), streams)
    assert rmse < 0.3
    assert nees < 2.0


def test_coordinates_of_a_national_grid_are_used_as_they_are():
    samples, streams = day_with_fixes(origin=UTM)
    plain = errors(final_map(day_with_fixes()[0]), streams)
    assert errors(final_map(samples), streams, UTM) == pytest.approx(plain, rel=0.05)


@pytest.mark.parametrize(
    ("changed", "why"),
    [
        ({}, None),
        ({"point": np.array([1e9, 0.0])}, "of its pose node"),
        ({"covariance": 1e-30 * np.eye(2)}, "a sigma of"),
        ({"covariance": 1e30 * np.eye(2)}, "a sigma of"),
    ],
)
def test_a_fix_beyond_the_bounds_is_refused(changed, why):
    first, *_ = fixes_in(day_with_fixes()[0])
    found = sighting_beyond(dataclasses.replace(sighting_of(first), **changed), Bounds())
    assert (found is None) if why is None else (found is not None and why in found)


def test_maps_with_fixes_are_recomputed_from_the_log():
    check_recomputed(day_with_fixes(live=True)[0])


def test_a_map_of_fixes_keeps_the_datum_where_its_frame_is_the_datums_plane():
    recorded = Recorded()
    recorded.take_all(day_with_fixes()[0])
    assert take_home(recorded).datum == DATUM
    saved = recorded_map(recorded, "site")
    assert datum_in(saved) == DATUM
    first = map_figures(saved)["landmarks"][0]
    assert abs(first["latitude_deg"] - DATUM.latitude_deg) < 1e-3
    later = msgspec.structs.replace(saved, name="later")
    final = final_map(day_with_fixes()[0])
    assert datum_of(CentralConfig(), final, [later]) == DATUM
    config = CentralConfig(datum=DATUM)
    assert datum_of(config, msgspec.structs.replace(final, frame="r1/1"), []) is None
    assert datum_of(config, final_map(day_with_fixes(origin=UTM)[0]), []) is None
