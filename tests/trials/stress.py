"""Stress suite: worlds with a known fault, and whether the team's map is right or its cause named.

    python -m tests.trials.stress [--only CASE …] [--seeds N] [--first SEED] [--drawn]

--drawn: each seed draws another world for the case's fault: 1 to 4 robots, 12 to 40 landmarks in a
square of 30 to 50 m, a reach of 6 to 12 m, 170 to 240 s.

Each case runs in memory, from a CSV folder whose scenario states only the noise of sensor and
odometry (`stress_world`). A line gives the map's error, the worst landmark in its standard
deviations, NEES per degree of freedom, and the reported causes; all without alignment where the
robots' starts are known, else after it.

named: the right cause is among them. silent: the worst landmark is beyond 4 sigma (for many
landmarks, beyond the same chance) without a cause, a robot left out, or a warning other than of
omitted landmarks. Exit status 1 if a map is silently wrong, or if the cause is named in less than
90 % of the runs in which it shifts the map by more than 2 sigma.
"""

import argparse
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from teamslam.central.desk.evaluation.evaluation import evaluate
from teamslam.central.desk.evaluation.results import MapResult
from teamslam.sim.in_memory.team import run_team
from teamslam.sim.scenarios.scenario import load, with_options
from teamslam.sim.scenarios.source import streams_of
from tests.trials.stress_world import Burst, CarriedOff, MovedLandmark, StressWorld, write

WORLD = StressWorld()
ALL = ("r1", "r2", "r3")
SHIFTED = 2.0
WRONG = 4.0
GOAL = 0.9
HALF_S = 150.0


class Case(NamedTuple):
    """A world, and the causes to name one of; none where the estimator must cope."""

    world: StressWorld
    causes: frozenset[str] = frozenset()


def _case(*causes: str, **fields: object) -> Case:
    return Case(replace(WORLD, **fields), frozenset(causes))


def _carried(metres: float, radians: float, **fields: object) -> Case:
    off = (CarriedOff("r2", metres, radians, HALF_S),)
    return _case("carried_off", carried_off=off, **fields)


def _moved(by: float) -> Case:
    return _case("landmark_moved", landmarks=20, moved=(MovedLandmark(7, (by, 0.0), HALF_S),))


NOISE = ("noise_underestimated",)
CASES: Mapping[str, Case] = {
    "clean": _case(),
    "outliers-1": _case(*NOISE, outlier_share=0.01),
    "outliers-5": _case(*NOISE, outlier_share=0.05),
    "outliers-20": _case(*NOISE, outlier_share=0.2),
    "moved-0.5": _moved(0.5),
    "moved-2": _moved(2.0),
    "same-id": _case("identity_shared", same_id=((3, 9),)),
    "clock-0.1": _case("clock_offset", late={"r2": 0.1}),
    "clock-0.2": _case("clock_offset", late={"r2": 0.2}),
    "clock-0.5": _case("clock_offset", late={"r2": 0.5}),
    "odometry+5": _case("odometry_scale", odometry_scale=dict.fromkeys(ALL, 1.05)),
    "odometry-5": _case("odometry_scale", odometry_scale=dict.fromkeys(ALL, 0.95)),
    "bearing": _case("bearing_offset", bearing_offset=dict.fromkeys(ALL, 0.05)),
    "mirrored": _case("mirrored", mirrored=("r2",)),
    "carried-15": _carried(15.0, 2.0),
    "carried-2": _carried(2.0, 0.5),
    "carried-15-no-starts": _carried(15.0, 2.0, starts=False),
    "carried-2-no-starts": _carried(2.0, 0.5, starts=False),
    "carried-15-hidden": _carried(15.0, 2.0, hidden=True),
    "carried-2-hidden": _carried(2.0, 0.5, hidden=True),
    "carried-alone-hidden": _case(
        "carried_off",
        robots=1,
        landmarks=10,
        hidden=True,
        carried_off=(CarriedOff("r1", 15.0, 2.0, HALF_S),),
    ),
    "carried-15-hidden-no-starts": _carried(15.0, 2.0, hidden=True, starts=False),
    "noise-2": _case("noise_underestimated", noise=2.0),
    "noise-0.5": _case("noise_overestimated", noise=0.5),
    "heavy-tails": _case(*NOISE, tails=2.0),
    "correlated": _case(*NOISE, correlated_s=20.0),
    "corridor": _case(corridor=True),
    "1-hz": _case(step_s=1.0),
    "100-hz": _case(step_s=0.01, seconds=100.0),
    "two-moved": _case(
        "landmark_moved",
        landmarks=20,
        moved=(MovedLandmark(7, (0.5, 0.0), HALF_S), MovedLandmark(12, (-0.4, 0.7), 100.0)),
    ),
    "outliers-burst": _case(*NOISE, bursts=(Burst("r2", 100.0, 130.0, 1.0, 0.5),)),
    "clock-and-scale": _case("clock_offset", late={"r2": 0.2}, odometry_scale={"r2": 1.05}),
    "one-of-five-mirrored": _case("mirrored", robots=5, mirrored=("r4",)),
    "carried-twice": _case(
        "carried_off",
        carried_off=(CarriedOff("r2", 5.0, 0.7, 100.0), CarriedOff("r2", 5.0, 0.7, 200.0)),
    ),
    "odometry-of-one": _case("odometry_scale", odometry_scale={"r2": 1.05}),
    "bearing-of-one": _case("bearing_offset", bearing_offset={"r2": 0.05}),
    "range-of-one": _case("range_offset", range_offset={"r2": 0.3}),
    "yaw-bias": _case(yaw_bias={"r2": 0.02}),
    "mirrored-alone": _case("mirrored", robots=1, mirrored=("r1",)),
}


def draw(world: StressWorld, seed: int) -> StressWorld:
    """Draw another world with the same faults, at the same share of the run."""
    rng = np.random.default_rng([1, seed])
    seconds = float(rng.choice([170.0, 240.0]))
    late = seconds / world.seconds
    robots = max(int(rng.integers(1, 5)), *(int(name[1:]) for name in _faulty(world)), 1)
    return replace(
        world,
        seed=seed,
        robots=robots,
        landmarks=int(rng.choice([12, 20, 30, 40])),
        half_m=float(rng.choice([15.0, 20.0, 25.0])),
        reach_m=float(rng.choice([6.0, 8.0, 10.0, 12.0])),
        seconds=seconds,
        carried_off=tuple(replace(each, at_s=late * each.at_s) for each in world.carried_off),
        moved=tuple(replace(each, from_s=late * each.from_s) for each in world.moved),
        bursts=tuple(
            replace(each, from_s=late * each.from_s, to_s=late * each.to_s) for each in world.bursts
        ),
    )


def _faulty(world: StressWorld) -> set[str]:
    """Robots of a world's faults that not all robots have."""
    by_robot = (world.late, world.odometry_scale, world.yaw_bias, world.bearing_offset)
    names = {name for each in (*by_robot, world.range_offset) for name in each}
    if names == {*ALL}:
        names = set()
    return names.union(world.mirrored, (each.robot for each in (*world.carried_off, *world.bursts)))


class Outcome(NamedTuple):
    """Errors of a run's map and the reported causes; `is_said`: anything is reported but omitted
    landmarks.
    """

    rmse_m: float
    worst_sigmas: float
    nees: float
    causes: tuple[str, ...]
    is_said: bool

    @property
    def is_shifted(self) -> bool:
        """Whether a landmark is beyond SHIFTED standard deviations more than chance."""
        return self.worst_sigmas > SHIFTED

    @property
    def is_silently_wrong(self) -> bool:
        """Whether a landmark is beyond WRONG standard deviations, and nothing is reported."""
        return self.worst_sigmas > WRONG and not self.is_said


def run(world: StressWorld) -> Outcome:
    with tempfile.TemporaryDirectory() as folder:
        place = write(world, folder)
        scenario = with_options(load(str(place / "scenario.toml")), dataset=place)
        samples = list(run_team(scenario, streams_of(scenario)))
    result = evaluate(samples)
    causes = tuple(each.cause for each in result.diagnosis)
    is_said = any(not words.startswith("left out") for words in result.warnings)
    if result.map is None or result.map.errors is None:
        return Outcome(np.nan, np.inf, np.nan, causes, is_said)
    errors, shape = result.map.errors, result.map.errors.shape
    is_said = bool(result.warnings)
    if world.starts or errors.aligned_rmse_m is None or shape is None:
        worst = _worst_sigmas(result.map, aligned=False)
        return Outcome(errors.rmse_m, worst, errors.nees_per_dof, causes, is_said)
    worst = _worst_sigmas(result.map, aligned=True)
    return Outcome(errors.aligned_rmse_m, worst, shape.nees_per_landmark / 2.0, causes, is_said)


def _worst_sigmas(found: MapResult, *, aligned: bool) -> float:
    """Largest error of a landmark in the standard deviations of two numbers.

    √χ² of the largest one, less the chance of the largest of so many: a normal number with the
    same tail probability.
    """
    error = (found.means - found.truth)[found.known]
    if not len(error):
        return float("nan")
    if aligned:
        error = _aligned(found.means[found.known], found.truth[found.known])
    n, k = len(found.ids), np.flatnonzero(found.known)
    P = np.asarray(found.covariance)
    blocks = (
        P if P.ndim == 3 else np.array([P[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] for i in range(n)])
    )
    chi2 = np.array([e @ np.linalg.solve(P, e) for e, P in zip(error, blocks[k], strict=True)])
    return float(np.sqrt(max(chi2.max() - 2.0 * np.log(len(chi2)), 0.0)))


def _aligned(points: np.ndarray, truth: np.ndarray) -> np.ndarray:
    z, w = ((each - each.mean(axis=0)) @ np.array([1.0, 1.0j]) for each in (points, truth))
    turn = (w * z.conj()).sum()
    left = z * turn / abs(turn) - w
    return np.column_stack([left.real, left.imag])


def main(arguments: Sequence[str] | None = None) -> int:
    """Print a line for each case, and the totals."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--only", nargs="*", choices=[*CASES], default=[*CASES], metavar="CASE")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first", type=int, default=1)
    parser.add_argument("--drawn", action="store_true", help="another world for each seed")
    given = parser.parse_args(arguments)
    print(
        f"{'case':28} {'error [m]':>9} {'worst':>7} {'NEES':>8} {'shifted':>8} named silent  causes"
    )
    shifted = named = silent = 0
    for name in given.only:
        case = CASES[name]
        seeds = range(given.first, given.first + given.seeds)
        worlds = (replace(case.world, seed=seed) for seed in seeds)
        if given.drawn:
            worlds = (draw(case.world, seed) for seed in seeds)
        outcomes = [run(world) for world in worlds]
        moved = [each for each in outcomes if each.is_shifted and case.causes]
        right = sum(bool(case.causes.intersection(each.causes)) for each in outcomes)
        of_moved = sum(bool(case.causes.intersection(each.causes)) for each in moved)
        quiet = sum(each.is_silently_wrong for each in outcomes)
        told = {c: sum(c in each.causes for each in outcomes) for e in outcomes for c in e.causes}
        figures = np.array([each[:3] for each in outcomes])
        rmse, worst, nees = np.median(figures, axis=0)
        print(
            f"{name:28} {rmse:9.3f} {worst:7.1f} {nees:8.2f} "
            f"{len(moved):8d} {right:5d} {quiet:6d}  "
            + ", ".join(f"{cause} {count}" for cause, count in sorted(told.items())),
            flush=True,
        )
        shifted, named, silent = shifted + len(moved), named + of_moved, silent + quiet
    share = named / shifted if shifted else 1.0
    print(f"silently wrong: {silent}; cause named where it shifts the map: {named} of {shifted}")
    return int(silent > 0 or share < GOAL)


if __name__ == "__main__":
    sys.exit(main())
