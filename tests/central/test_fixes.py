import dataclasses
from functools import cache

import msgspec
import numpy as np
import pytest

from teamslam.central.config import CentralConfig
from teamslam.central.desk.export.take_home import take_home
from teamslam.central.desk.verification.centre import recorded_map
from teamslam.central.desk.verification.recorded import Recorded
from teamslam.central.survey import datum_of
from teamslam.sim.in_memory.team import final_map, run_team
from teamslam.sim.scenarios.scenario import load
from teamslam.sim.scenarios.source import streams_of
from teamslam.team.config import GNSS, SURVEY_FRAME, Bounds, Gnss
from teamslam.team.datum import Datum
from teamslam.team.estimation.plausibility import sighting_beyond
from teamslam.team.saved_map import datum_in, map_figures
from teamslam.team.translate import sighting_of
from teamslam.team.wire import messages as m
from teamslam.team.wire.bus import opened
from tests.central.test_survey import errors
from tests.scenarios import final_only, with_front_ends, with_robots, with_world
from tests.sim.reruns import check_recomputed

SIGMA_M = 0.3
ANTENNA = (0.8, -0.5)
DATUM = Datum(48.745, 9.105)
UTM = np.array([399_000.0, 5_756_000.0])


def with_fixes(stream, seed, origin, jumps):
    """A fix every 2 s at the antenna; jumps: indices of fixes displaced by 15 m."""
    at = np.arange(0, len(stream.truth), 2)
    x, y, turn = stream.truth[at].T
    s, c = np.sin(turn), np.cos(turn)
    (ahead, left), noise = ANTENNA, np.random.default_rng(seed).normal(0, SIGMA_M, (len(at), 2))
    fixes = np.column_stack([x + c * ahead - s * left, y + s * ahead + c * left]) + noise + origin
    fixes[list(jumps)] += [15.0, 0.0]
    fixes = np.hstack([fixes, np.full((len(at), 3), np.nan)])
    return dataclasses.replace(stream, fixes_ns=stream.truth_ns[at], fixes=fixes)


@cache
def day(
    seed,
    *,
    fixed=("r1",),
    unknown=("*",),
    origin=(0.0, 0.0),
    jumps=(),
    live=False,
):
    scenario = load("thesis-b")
    scenario = with_world(scenario, unknown_starts=unknown, steps=250)
    scenario = with_robots(scenario, gnss=Gnss(antenna=ANTENNA, sigma_m=SIGMA_M))
    scenario = with_front_ends(scenario, node_s=2.0)
    central = msgspec.structs.replace(scenario.central, datum=DATUM)
    scenario = msgspec.structs.replace(scenario, seed=seed, central=central)
    streams = streams_of(scenario)
    own = tuple(
        with_fixes(each, seed, np.array(origin), jumps) if each.robot in fixed else each
        for each in streams.streams
    )
    scenario = scenario if live else final_only(scenario)
    return list(run_team(scenario, dataclasses.replace(streams, streams=own))), streams


def test_fixes_of_one_robot_place_a_team_without_known_starts():
    samples, streams = day(3)
    fused = final_map(samples)
    assert fused.frame == SURVEY_FRAME
    assert {each.robot for each in fused.members} == {"r1", "r2"}
    assert not any("fixes" in each for each in fused.reasons)
    rmse, nees = errors(fused, streams)
    assert rmse < 0.3
    assert nees < 2.0
    factors = [
        x for s in samples if isinstance(x := opened(s)[2], m.SightingFactor) and x.teammate == GNSS
    ]
    used = [n for each in factors for n in each.measurements]
    assert len(used) == len(set(used)) > 50


def test_a_fix_that_jumps_moves_nothing():
    rmse, nees = errors(final_map(day(3, jumps=tuple(range(5, 120, 10)))[0]), day(3)[1])
    assert rmse < 0.3
    assert nees < 2.0


def test_coordinates_of_a_national_grid_are_used_as_they_are():
    samples, streams = day(3, origin=tuple(UTM))
    plain = errors(final_map(day(3)[0]), streams)
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
    factors = (opened(s)[2] for s in day(3)[0])
    first = next(x for x in factors if isinstance(x, m.SightingFactor) and x.teammate == GNSS)
    found = sighting_beyond(dataclasses.replace(sighting_of(first), **changed), Bounds())
    assert (found is None) if why is None else (found is not None and why in found)


def test_maps_with_fixes_are_recomputed_from_the_log():
    check_recomputed(day(3, live=True)[0])


def test_a_map_of_fixes_keeps_the_datum_where_its_frame_is_the_datums_plane():
    recorded = Recorded()
    recorded.take_all(day(3)[0])
    assert take_home(recorded).datum == DATUM
    saved = recorded_map(recorded, "site")
    assert datum_in(saved) == DATUM
    first = map_figures(saved)["landmarks"][0]
    assert abs(first["latitude_deg"] - DATUM.latitude_deg) < 1e-3
    later = msgspec.structs.replace(saved, name="later")
    final = final_map(day(3)[0])
    assert datum_of(CentralConfig(), final, [later]) == DATUM
    config = CentralConfig(datum=DATUM)
    assert datum_of(config, msgspec.structs.replace(final, frame="r1/1"), []) is None
    assert datum_of(config, final_map(day(3, origin=tuple(UTM))[0]), []) is None
