import math
from functools import cache
from itertools import compress
from pathlib import Path
from tempfile import TemporaryDirectory

import msgspec
import numpy as np
import pytest

from teamslam.central.diagnosis import cuts_of, describe, diagnose
from teamslam.central.tick_fold import TickFold
from teamslam.sim.in_memory.team import final_map
from teamslam.team import translate
from teamslam.team.estimation.map_joining.marginals import BELIEVED, bias_estimates, joint_cost
from teamslam.team.estimation.map_joining.minima import MISFIT
from teamslam.team.estimation.se2 import compose, inverse
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.arrays import floats, from_floats, stamps
from teamslam.team.wire.bus import opened
from tests.central.test_withdrawal import messages, scenario, team_run
from tests.scenarios import final_only, scenario_in
from tests.sim.reruns import team_samples
from tests.trials.stress_world import CarriedOff, StressWorld, write

FIRST, LAST = 4, 6
"""The submaps of r3 that are left out: it is carried from the end of submap 3 to the start of 7."""


def chain() -> list[m.Submap]:
    own = [each for each in messages(team_run(), m.Submap) if each.robot == "r3"]
    return sorted(own, key=lambda each: each.sequence)


def carried() -> list[m.Submap]:
    before, after = chain()[:FIRST], chain()[LAST + 1 :]
    return before + [
        msgspec.structs.replace(each, sequence=k, sightings=0)
        for k, each in enumerate(after, FIRST)
    ]


def mirrored() -> list[m.Submap]:
    found = []
    for each in chain():
        poses = 1 + len(stamps(each.nodes, "nodes"))
        mean = floats(each.mean, "mean").copy()
        sign = np.ones(len(mean))
        sign[1 : 3 * poses : 3] = sign[2 : 3 * poses : 3] = sign[3 * poses + 1 :: 2] = -1.0
        rows, columns = np.triu_indices(len(mean))
        covariance = floats(each.covariance, "covariance") * sign[rows] * sign[columns]
        other = {"mean": from_floats(mean * sign), "covariance": from_floats(covariance)}
        found.append(msgspec.structs.replace(each, **other, sightings=0))
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
    fold, left_out = ticks.solve(), ticks.submaps_of_withdrawn()
    found = diagnose(fold, bias_estimates(fold), left_out, 1.0, 1.0, final=True)
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


def rows_of(path: Path) -> np.ndarray:
    return np.loadtxt(path, delimiter=",", skiprows=1)


def test_the_final_map_says_when_a_robot_was_carried_off_and_by_how_much(tmp_path):
    """A scan every 0.5 s: none lies between the seam at 50 s and 50.2 s."""
    off = CarriedOff("r2", 4.0, 0.6, 50.2)
    folder = write(StressWorld(seed=5, seconds=100.0, carried_off=(off,)), tmp_path)
    final = final_map(team_samples(final_only(scenario_in(folder))))
    assert not final.withdrawn
    assert not any(MISFIT in each for each in final.reasons), "it is explained"
    (found,) = final.diagnosis
    assert (found.cause, found.robot) == ("carried_off", "r2")
    assert describe(found).startswith("r2 was carried off or slipped at 50.0 s")
    means = floats(final.means, "means").reshape(-1, 2)
    true = rows_of(folder / "landmarks.csv")[:, 1:]
    assert np.hypot(*(means[:, None] - true).transpose(2, 0, 1)).min(axis=1).max() < 0.5
    rows = rows_of(folder / "r2" / "truth.csv")
    (at,) = np.flatnonzero(np.abs(rows[:, 0] - off.at_s) < 0.01)
    before, after = rows[at - 1, 1:], rows[at, 1:]
    x, y, turn = found.value
    dx, dy, _ = after - before
    assert math.hypot(x - dx, y - dy) < 0.5
    assert turn == pytest.approx(float(inverse(before)[2] + after[2]), abs=0.1)


# Without landmark names.


AT_S = 100.0
FAR = CarriedOff("r2", 15.0, 2.0, AT_S)
NEAR = CarriedOff("r2", 2.2, 0.5, AT_S)
INSIDE = CarriedOff("r2", 15.0, 2.0, AT_S + 4.3)  # inside a window of ten seconds


class Run:
    def __init__(self, seed: int, *off: CarriedOff) -> None:
        world = StressWorld(seed=seed, seconds=220.0, hidden=True, carried_off=off)
        with TemporaryDirectory() as folder:
            place = write(world, Path(folder))
            live = scenario_in(place)
            self.scenario = live if off == (FAR,) else final_only(live)
            self.samples = team_samples(self.scenario)
            self.landmarks = rows_of(place / "landmarks.csv")[:, 1:]
            self.path = rows_of(place / "r2" / "truth.csv")

    @property
    def final(self) -> m.FusedMap:
        return final_map(self.samples)


@cache
def run_without_names(*off: CarriedOff) -> Run:
    return Run(4 if off == (INSIDE,) else 1, *off)


def jumps_in(fused: m.FusedMap) -> list[m.Diagnosis]:
    return [each for each in fused.diagnosis if each.cause == "carried_off"]


@pytest.mark.parametrize("off", [FAR, NEAR, INSIDE], ids=["far", "near", "inside a window"])
def test_the_map_is_right_and_names_the_robot_the_time_and_the_motion(off):
    of = run_without_names(off)
    final, path = of.final, of.path
    means = floats(final.means, "means").reshape(-1, 2)
    away = np.hypot(*(means[:, None] - of.landmarks).transpose(2, 0, 1))
    assert len(means) >= 20
    assert away.min(axis=1).max() < 1.0
    assert len(means) <= len({*away.argmin(axis=1).tolist()}) + 2, "no second copy of the place"
    (found,) = jumps_in(final)
    inside = off is INSIDE
    assert (found.robot, found.at_ns) == ("r2", 100_000_000_000)
    at_s = (AT_S - 0.1, off.at_s - 0.1, off.at_s, AT_S + 10.0 * inside)
    before, there, put_down, after = (path[np.abs(path[:, 0] - t).argmin(), 1:] for t in at_s)
    if inside:  # the window's own motion was measured
        before = compose(before, compose(inverse(before), there))
        before = compose(before, compose(inverse(put_down), after))
    x, y, turn = found.value
    assert math.hypot(*(np.array([x, y]) - (after - before)[:2])) < 1.0
    assert len(found.sigma) == 3
    assert 0.0 < max(found.sigma[:2]) < 1.0
    assert math.remainder(turn - (after - before)[2], 2 * math.pi) == pytest.approx(0.0, abs=0.15)


def test_the_robots_online_pose_is_withheld_until_its_place_is_found_and_right_then():
    of = run_without_names(FAR)
    sent = (opened(each) for each in of.samples if each.key == ch.TEAM_POSE.key("r2"))
    late = [each for _, _, each in sent if each.in_team_frame and each.stamp_ns > 215 * 10**9]
    assert late, "it is in the team's map again"
    for each in late:
        true = of.path[int(np.abs(of.path[:, 0] - each.stamp_ns * 1e-9).argmin()), 1:3]
        assert math.hypot(*(floats(each.pose, "pose")[:2] - true)) < 1.5


def test_the_cut_depends_on_no_order_of_arrival():
    of = run_without_names(FAR)
    folds = []
    for backwards in (False, True):
        ticks = TickFold(of.scenario.central)
        for start in messages(of.samples, m.InitialPose):
            ticks.add_start(translate.start_of(start))
        submaps = messages(of.samples, m.Submap)
        ordered = sorted(submaps, key=lambda each: each.stamp_ns, reverse=backwards)
        for number, each in enumerate(ordered):
            ticks.add_submap(each, bytes(8))
            if not backwards and number % 10 == 0:
                ticks.fold_until(each.stamp_ns)
        folds.append(ticks.solve())
        assert ticks.members(folds[-1])["r2", 1] == 21
    one, two = folds
    assert one.cuts == two.cuts
    assert list(cuts_of(one)) == list(cuts_of(two))
    assert (one.main.state == two.main.state).all()


def test_a_team_that_is_left_alone_is_not_cut():
    of = run_without_names()
    assert jumps_in(of.final) == []
    assert not any("look alike" in each or "refused" in each for each in of.final.reasons)
