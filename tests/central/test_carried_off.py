import math
from itertools import compress

import msgspec
import numpy as np
import pytest

from teamslam.central.diagnosis import describe, diagnose
from teamslam.central.tick_fold import TickFold
from teamslam.sim.in_memory.team import final_map, run_team
from teamslam.sim.scenarios.source import streams_of
from teamslam.team import translate
from teamslam.team.estimation.map_joining.marginals import BELIEVED, bias_estimates, joint_cost
from teamslam.team.estimation.se2 import compose, inverse
from teamslam.team.wire import messages as m
from teamslam.team.wire.arrays import floats, from_floats, stamps
from tests.central.test_withdrawal import messages, scenario, team_run
from tests.scenarios import final_only, scenario_in
from tests.trials.stress_world import CarriedOff, StressWorld, write

FIRST, LAST = 4, 6
"""The submaps of r3 that are left out: it is carried from the end of submap 3 to the start of 7."""


def chain() -> list[m.Submap]:
    own = [each for each in messages(team_run(), m.Submap) if each.robot == "r3"]
    return sorted(own, key=lambda each: each.sequence)


def carried() -> list[m.Submap]:
    own = [each for each in chain() if not FIRST <= each.sequence <= LAST]
    gone = LAST + 1 - FIRST
    return [
        each if each.sequence < FIRST else renumbered(each, each.sequence - gone) for each in own
    ]


def renumbered(submap: m.Submap, sequence: int) -> m.Submap:
    return msgspec.structs.replace(submap, sequence=sequence, sightings=0)


def mirrored() -> list[m.Submap]:
    found = []
    for each in chain():
        poses = 1 + len(stamps(each.nodes, "nodes"))
        mean = floats(each.mean, "mean").copy()
        sign = np.ones(len(mean))
        sign[1 : 3 * poses : 3] = sign[2 : 3 * poses : 3] = sign[3 * poses + 1 :: 2] = -1.0
        rows, columns = np.triu_indices(len(mean))
        covariance = floats(each.covariance, "covariance") * sign[rows] * sign[columns]
        found.append(
            msgspec.structs.replace(
                each, mean=from_floats(mean * sign), covariance=from_floats(covariance), sightings=0
            )
        )
    return found


def folded(own: list[m.Submap], backwards: bool = False) -> TickFold:
    ticks = TickFold(scenario().central)
    for start in messages(team_run(), m.InitialPose):
        ticks.add_start(translate.start_of(start))
    rest = [each for each in messages(team_run(), m.Submap) if each.robot != "r3"]
    for each in sorted([*rest, *own], key=lambda each: each.stamp_ns, reverse=backwards):
        ticks.add_submap(each, bytes(8))
    return ticks


def jumps(ticks: TickFold) -> list[m.Diagnosis]:
    fold = ticks.solve()
    biases = bias_estimates(fold)
    left_out = ticks.submaps_of_withdrawn()
    found = diagnose(fold, biases, left_out, 1.0, 1.0, final=True)
    return [each for each in found if each.cause == "carried_off"]


def test_the_seam_and_the_motion_are_those_of_the_way_that_the_robot_was_carried():
    ticks = folded(carried())
    (found,) = jumps(ticks)
    assert not ticks.withdrawn
    fold = ticks.solve()
    assert {each.key for each in fold.contributions if each.robot == "r3"} == {
        (each.stamp_ns, "r3", 1, each.sequence) for each in carried()
    }
    assert (found.robot, found.at_ns) == ("r3", chain()[FIRST - 1].stamp_ns)
    is_outlier = (joint_cost(fold).submaps.weight < BELIEVED).tolist()
    submaps = [each.contribution for each in fold.main.graph.submaps]
    outliers = [each.sequence for each in compress(submaps, is_outlier)]
    assert outliers == [FIRST - 1], "one submap of r3 contradicts the others"
    true = folded(chain()).solve().main.graph.landmarks
    assert fold.main.graph.landmarks.keys() == true.keys()
    way = np.zeros(3)
    for each in chain()[FIRST : LAST + 1]:
        way = compose(way, floats(each.mean, "mean")[:3])
    assert math.hypot(*found.value[:2]) == pytest.approx(math.hypot(*way[:2]), abs=0.3)
    assert math.remainder(found.value[2] - way[2], 2 * math.pi) == pytest.approx(0.0, abs=0.05)
    assert jumps(folded(carried(), backwards=True)) == [found], "arrival order changes nothing"


def test_nothing_is_said_of_a_robot_whose_camera_and_gyro_are_mirrored():
    ticks = folded(mirrored())
    assert jumps(ticks) == []
    assert set(ticks.convicted) == {"r3"}


def test_nothing_is_said_of_a_robot_whose_wheels_are_a_third_too_large():
    final = final_map(list(team_run("odometry")))
    assert final.withdrawn == ("r3",)
    assert not any(each.cause == "carried_off" for each in final.diagnosis)


def test_the_final_map_says_when_a_robot_was_carried_off_and_by_how_much(tmp_path):
    """A scan every 0.5 s: none lies between the seam at 50 s and 50.2 s."""
    off = CarriedOff("r2", 4.0, 0.6, 50.2)
    folder = write(StressWorld(seed=5, seconds=100.0, carried_off=(off,)), tmp_path)
    of = final_only(scenario_in(folder))
    final = final_map(list(run_team(of, streams_of(of))))
    assert not final.withdrawn
    (found,) = (each for each in final.diagnosis if each.cause == "carried_off")
    assert describe(found).startswith("r2 was carried off or slipped at 50.0 s")
    means = floats(final.means, "means").reshape(-1, 2)
    true = np.loadtxt(folder / "landmarks.csv", delimiter=",", skiprows=1)[:, 1:]
    assert np.hypot(*(means[:, None] - true).transpose(2, 0, 1)).min(axis=1).max() < 0.5
    rows = np.loadtxt(folder / "r2" / "truth.csv", delimiter=",", skiprows=1)
    (at,) = np.flatnonzero(np.abs(rows[:, 0] - off.at_s) < 0.01)
    before, after = rows[at - 1, 1:], rows[at, 1:]
    x, y, turn = found.value
    dx, dy, _ = after - before
    assert math.hypot(x - dx, y - dy) < 0.5
    assert turn == pytest.approx(float(inverse(before)[2] + after[2]), abs=0.1)
