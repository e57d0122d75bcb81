"""Merge three robots' object maps by shape and class: SlideSLAM's forest, parking and indoor sets.

Each file has an object a line, `class x y z`, in its robot's frame. A map is one submap without
odometry, its objects unnamed landmarks with independent errors of --sigma [m]. Prints for each
ordered pair: accepted or the failed test, and the figures; and the loop 0-1-2-0.

    python -m tests.trials.class_maps ../shared/benchmarks/classes [--without-classes]
"""

import argparse
import sys
from pathlib import Path

import numpy as np

from teamslam.central.desk.evaluation.errors import transform_points
from teamslam.team.association import profile_for
from teamslam.team.config import UNNAMED, Sensor
from teamslam.team.estimation.association.closure import search_other_island
from teamslam.team.estimation.association.island_view import IslandView
from teamslam.team.estimation.association.verification import Closure
from teamslam.team.estimation.contribution import Contribution
from teamslam.team.estimation.map_joining.alignment import procrustes
from teamslam.team.estimation.map_joining.fold_association import view_island
from teamslam.team.estimation.map_joining.gauss_newton import JoinSettings
from teamslam.team.estimation.map_joining.joining import EMPTY_FOLD, fold_submaps
from teamslam.team.estimation.se2 import compose
from teamslam.team.estimation.submap import LocalMap, Unnamed

SITES = ("forest", "parking", "indoor")
ROBOTS = (0, 1, 2)
RIGHT = 0.95  # probability that an object's class is right
TAILS = 4.0  # degrees of freedom of the differences of the same objects in two maps
STEPS = 100


def contribution(rows: np.ndarray, robot: int, sigma: float, classes: np.ndarray) -> Contribution:
    """Objects as a robot's only submap; classes: those that the detector distinguishes."""
    count = len(rows)
    mean = np.concatenate((np.zeros(3), rows[:, 1:3].ravel()))
    variances = np.concatenate((np.full(3, 1e-2), np.full(2 * count, sigma**2)))
    reported = rows[:, :1] == classes
    likelihoods = np.log(np.where(reported, RIGHT, (1.0 - RIGHT) / max(len(classes) - 1, 1)))
    unnamed = Unnamed(np.ones(count, np.uint32), np.eye(count, dtype=np.bool_), likelihoods)
    ids = (UNNAMED + np.arange(count)).astype(np.uint32)
    local = LocalMap(ids, mean, np.diag(variances), unnamed=unnamed)
    return Contribution(f"r{robot}", 1, 0, 10**9, local)


def find(folder: Path, site: str, sigma: float, *, classed: bool) -> dict[tuple[int, int], Closure]:
    objects = [np.loadtxt(folder / f"robot{robot}Map_{site}.txt") for robot in ROBOTS]
    classes = np.unique(np.concatenate(objects)[:, 0]) if classed else np.empty(0)
    profile = profile_for(Sensor(range_sigma=sigma, bearing_sigma=1e-6), 1.0)
    settings = JoinSettings(association=profile)
    maps = [
        contribution(rows, robot, sigma, classes)
        for robot, rows in zip(ROBOTS, objects, strict=True)
    ]
    fold = fold_submaps(EMPTY_FOLD, maps, settings)
    views = [view_island(fold.islands[each.stream], fold.landmarks) for each in maps]
    found = {}
    for one in ROBOTS:
        for two in ROBOTS:
            if one != two:
                closure = search_other_island(views[one], views[two], maps[one].stream, 0)
                if closure is not None:
                    motion = fit_motion(views[one], views[two], closure)
                    found[one, two] = closure._replace(motion=motion)
    return found


def fit_motion(one: IslandView, two: IslandView, closure: Closure) -> np.ndarray:
    """Motion of the first map's landmarks onto the second's, by maximum likelihood.

    A map may have an object several times. The partner of a landmark is therefore unknown: one of
    the second map's, in Student's t of TAILS degrees of freedom about it, or none, with the
    density of landmarks. Expectation maximisation (Granger and Pennec 2002, ECCV; Lange, Little
    and Taylor 1989).
    """
    a, b = one.joint.mean, two.joint.mean
    first, second = np.array([(pair.first, pair.second) for pair in closure.pairs]).T
    motion = np.array(procrustes(b[second], a[first], np.ones(len(first))))
    variance = float(((b[second] - transform_points(motion, a[first])) ** 2).mean())
    for _ in range(STEPS):
        off = ((transform_points(motion, a)[:, None] - b) ** 2).sum(axis=2)
        near = (1.0 + off / (TAILS * variance)) ** (-0.5 * TAILS - 1.0) / (2.0 * np.pi * variance)
        partner = near / (near.sum(axis=1, keepdims=True) + one.profile.density)
        weights = partner * (TAILS + 2.0) / (TAILS + off / variance)
        variance = (weights * off).sum() / (2.0 * partner.sum())
        towards = weights @ b / weights.sum(axis=1)[:, None]
        motion = np.array(procrustes(towards, a, weights.sum(axis=1)))
    return motion


def loop_error(found: dict[tuple[int, int], Closure]) -> tuple[float, float]:
    """Distance [m] and angle [deg] by which the motions 0 to 1 to 2 to 0 miss the identity."""
    end = np.zeros(3)
    for pair in ((0, 1), (1, 2), (2, 0)):
        end = compose(found[pair].motion, end)
    return float(np.hypot(*end[:2])), float(np.degrees(abs(end[2])))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--sigma", type=float, default=0.07)
    parser.add_argument("--without-classes", action="store_true")
    options = parser.parse_args()
    for site in SITES:
        found = find(options.folder, site, options.sigma, classed=not options.without_classes)
        for (one, two), closure in found.items():
            why = closure.why or "accepted"
            print(
                f"{site:8} {one}-{two}  {len(closure.pairs):4} pairs, llr {closure.llr:7.1f}, "
                f"rival {closure.rival_llr:6.1f} of {closure.rival_pairs}, share "
                f"{closure.share:.2f}, {np.round(closure.motion, 2)}  {why}"
            )
        if all(pair in found for pair in ((0, 1), (1, 2), (2, 0))):
            print("{:8} loop closes to {:.3f} m, {:.3f} deg".format(site, *loop_error(found)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
