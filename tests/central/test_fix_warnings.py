import numpy as np
import pytest

from teamslam.central.fixes import fix_warnings
from teamslam.team.config import GNSS
from teamslam.team.estimation.contribution import STATION, Contribution, InitialPoseFactor
from teamslam.team.estimation.inter_robot import STATION_POSE, InterRobotFactor, from_station
from teamslam.team.estimation.map_joining.gauss_newton import JoinSettings
from teamslam.team.estimation.map_joining.joining import (
    EMPTY_FOLD,
    add_start,
    fold_submaps,
    solve_fold,
)
from teamslam.team.estimation.se2 import compose, inverse, transformed
from teamslam.team.estimation.submap import LocalMap

PLACE = np.array([40.0, -7.0, 2.0])
NO_IDS = np.empty(0, np.uint32)
SIGMA_M, STATED_M = 0.3, 0.6
NODES = 80
EACH = 2
NODE_S = 2.0
STEP_S = 0.05


def path():
    """Poses every STEP_S of a winding path at 0.6 to 4 m/s, which separates delay from antenna."""
    t = np.arange(0.0, NODE_S * (NODES + 2), STEP_S)
    speed, turn = 2.3 + 1.7 * np.sin(0.5 * t), 2.0 * np.sin(0.11 * t)
    x, y = np.cumsum([speed * np.cos(turn), speed * np.sin(turn)], axis=1) * STEP_S
    return np.column_stack([x - x[0], y - y[0], turn])


def warnings(*, late_s=0.0, off=(0.0, 0.0), wrong=0, stated_m=STATED_M, seed=1):
    """Warnings of a team whose only robot has a fix at each node, of an antenna off by `off`."""
    rng, poses = np.random.default_rng(seed), path()
    steps = round(NODE_S / STEP_S) * np.arange(1, NODES + 1)
    stamps = np.round(NODE_S * 1e9 * np.arange(1, NODES + 1)).astype(np.int64)
    submaps, start = [], poses[0]
    for k in range(0, NODES, EACH):
        nodes = np.array([compose(inverse(start), poses[step]) for step in steps[k : k + EACH]])
        mean = np.concatenate([nodes[-1:], nodes]).ravel()
        local = LocalMap(NO_IDS, mean, 1e-5 * np.eye(len(mean)), stamps[k : k + EACH])
        submaps.append(Contribution("r1", 0, k // EACH, int(stamps[k + EACH - 1]) + 1, local))
        start = poses[steps[k + EACH - 1]]
    station = LocalMap(NO_IDS, np.zeros(3), 1e-6 * np.eye(3))
    fixes = []
    for k, (step, stamp) in enumerate(zip(steps, stamps.tolist(), strict=True)):
        antenna = transformed(poses[step - round(late_s / STEP_S)], np.array(off))
        at = transformed(PLACE, antenna) + rng.normal(0.0, SIGMA_M, 2)
        at += rng.normal(0.0, 20.0, 2) * (k < wrong)
        measured = from_station(at, stated_m**2 * np.eye(2))
        fixes.append(InterRobotFactor("r1", 0, k // EACH, stamp, GNSS, *measured, np.zeros(2)))
    fold = add_start(EMPTY_FOLD, InitialPoseFactor(*STATION, STATION_POSE))
    fold = fold_submaps(fold, [Contribution(*STATION, 0, 0, station)], JoinSettings())
    fold = fold_submaps(fold, submaps, JoinSettings(), fixes)
    return [*fix_warnings(solve_fold(fold, JoinSettings()))]


def number_after(text, word):
    return float(text.partition(word)[2].split()[0].strip("(,)"))


@pytest.mark.parametrize("seed", range(5))
def test_fixes_without_an_error_of_their_own_are_not_named(seed):
    assert warnings(seed=seed) == []
    assert warnings(seed=seed, wrong=10) == []


def test_late_and_early_fixes_are_named_with_their_delay():
    for late_s, word in ((0.4, " late"), (-0.4, " early")):
        (found,) = warnings(late_s=late_s)
        assert found.startswith("r1 (incarnation 0): its fixes are 0.")
        assert word in found
        assert number_after(found, "add ") == pytest.approx(late_s, abs=0.1)


def test_an_antenna_that_is_elsewhere_is_named_with_its_displacement():
    (found,) = warnings(off=(0.8, -0.5))
    assert "its fixes are of a point (" in found
    place = found.partition("(+")[2].partition(") m from gnss.antenna")[0]
    x, y = (float(each) for each in place.split(", "))
    assert (x, y) == pytest.approx((0.8, -0.5), abs=0.3)


def test_fixes_that_are_stated_six_times_too_sure_are_named():
    (found,) = warnings(stated_m=0.05)
    assert f" of {NODES} fixes contradict the map beyond chance" in found
