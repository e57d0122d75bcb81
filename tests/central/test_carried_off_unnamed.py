import math
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest

from teamslam.central.diagnosis import cuts_of
from teamslam.central.tick_fold import TickFold
from teamslam.sim.in_memory.team import final_map, run_team
from teamslam.sim.scenarios.source import streams_of
from teamslam.team import translate
from teamslam.team.estimation.se2 import compose, inverse
from teamslam.team.wire import channels as ch
from teamslam.team.wire import messages as m
from teamslam.team.wire.arrays import floats
from teamslam.team.wire.bus import opened
from tests.scenarios import final_only, scenario_in
from tests.trials.stress_world import CarriedOff, StressWorld, write

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
            self.samples = list(run_team(self.scenario, streams_of(self.scenario)))
            self.landmarks = _rows(place / "landmarks.csv")[:, 1:]
            self.path = _rows(place / "r2" / "truth.csv")

    @property
    def messages(self) -> list[m.Message]:
        return [opened(each)[2] for each in self.samples]

    @property
    def final(self) -> m.FusedMap:
        return final_map(self.samples)


def _rows(path: Path) -> np.ndarray:
    return np.loadtxt(path, delimiter=",", skiprows=1)


@cache
def run(*off: CarriedOff) -> Run:
    return Run(4 if off == (INSIDE,) else 1, *off)


def said(fused: m.FusedMap) -> list[m.Diagnosis]:
    return [each for each in fused.diagnosis if each.cause == "carried_off"]


@pytest.mark.parametrize("off", [FAR, NEAR, INSIDE], ids=["far", "near", "inside a window"])
def test_the_map_is_right_and_names_the_robot_the_time_and_the_motion(off):
    of = run(off)
    final, path = of.final, of.path
    means = floats(final.means, "means").reshape(-1, 2)
    away = np.hypot(*(means[:, None] - of.landmarks).transpose(2, 0, 1))
    assert len(means) >= 20
    assert away.min(axis=1).max() < 1.0
    assert len(means) <= len({*away.argmin(axis=1).tolist()}) + 2, "no second copy of the place"
    (found,) = said(final)
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
    of = run(FAR)
    sent = (opened(each) for each in of.samples)
    poses = [
        each
        for channel, robot, each in sent
        if channel == ch.TEAM_POSE and robot == "r2" and isinstance(each, m.PoseEstimate)
    ]
    poses = [each for each in poses if each.in_team_frame]
    late = [each for each in poses if each.stamp_ns * 1e-9 > 215.0]
    assert late, "it is in the team's map again"
    for each in late:
        true = of.path[int(np.abs(of.path[:, 0] - each.stamp_ns * 1e-9).argmin()), 1:3]
        assert math.hypot(*(floats(each.pose, "pose")[:2] - true)) < 1.5


def test_the_cut_depends_on_no_order_of_arrival():
    of = run(FAR)
    folds = []
    for backwards in (False, True):
        ticks = TickFold(of.scenario.central)
        for start in (each for each in of.messages if isinstance(each, m.InitialPose)):
            ticks.add_start(translate.start_of(start))
        submaps = [each for each in of.messages if isinstance(each, m.Submap)]
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
    of = run()
    assert said(of.final) == []
    assert not any("look alike" in each or "refused" in each for each in of.final.reasons)
