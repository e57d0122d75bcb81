"""Time and error of the first team pose of robots without a start, in a team with a saved map.

    python -m tests.trials.day_two [--starts 20] [--set UTIAS_1.zip] [--wild 0.2] [--json FILE]

The map is of a first day in memory: a run of `thesis-b`, a new one for every five starts, or with
--set the first 250 s of this UTIAS set. The team begins at unknown poses at various times of a
second day (the set's later part), and runs for 40 s. For the first pose in the map's frame of each
robot that sees two landmarks of the map in the first 30 s: the time since, the error, and the NEES
(three degrees of freedom); beyond six standard deviations it is a wrong placement. With --wild this
share of the second day's ranges is uniform between the day's least and largest. Ends with 1 if
there is a wrong placement, or, without --wild, if a robot that has seen two landmarks is not placed
within 10 s, or if fewer than 85 % are within two standard deviations.
"""

import argparse
import json
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from teamslam.sim.scenarios.scenario import Scenario, load, with_options
from teamslam.sim.scenarios.source import streams_of
from teamslam.sim.world.streams import RobotStream, WorldStreams
from teamslam.team.estimation.consistency import chi2_limit
from teamslam.team.wire import messages as m
from teamslam.team.wire.arrays import floats, ids
from teamslam.team.wire.bus import opened
from tests.central.test_saved_map import day, part

SECOND_NS = 1_000_000_000
LENGTH_NS = 30 * SECOND_NS
FIRST_DAY_NS = 250 * SECOND_NS
PER_MAP = 5
WITHIN_S = 10.0
RUN_NS = LENGTH_NS + round(WITHIN_S) * SECOND_NS
NAMED_SIGMAS = {"two": 0.0455, "six": 2e-9}  # probabilities beyond two and six standard deviations


class Start(NamedTuple):
    """A saved map, and the streams of a team that begins at unknown poses."""

    scenario: Scenario
    saved: m.SavedMap
    world: WorldStreams


def simulated(starts: int) -> Iterator[Start]:
    """Cut days of `thesis-b`, a new first and second day for every PER_MAP starts."""
    for number in range(starts):
        if number % PER_MAP == 0:
            seed = 1 + number // PER_MAP
            _, centre, _ = day(seed)
            saved = centre.maps.fold.save_map("site")
            scenario = with_options(load("thesis-b"), seed=1000 + seed)
            world = streams_of(scenario)
            first_ns = min(first for first, _ in world.spans_ns.values())
        at = first_ns + (7 + 55 * (number % PER_MAP)) * SECOND_NS
        yield Start(scenario, saved, part(world, at, at + RUN_NS, begins=False))


def recorded(path: Path, starts: int) -> Iterator[Start]:
    """Cut a UTIAS set: the map is that of its first FIRST_DAY_NS."""
    scenario = with_options(load("utias"), dataset=path, robots=3)
    world = streams_of(scenario)
    first_ns = min(first for first, _ in world.spans_ns.values())
    until_ns = first_ns + FIRST_DAY_NS
    streams = part(world, first_ns, until_ns, begins=True)
    _, centre, _ = day(1, scenario=scenario, streams=streams)
    saved = centre.maps.fold.save_map("site")
    for number in range(starts):
        at = until_ns + number * LENGTH_NS
        yield Start(scenario, saved, part(world, at, at + RUN_NS, begins=False))


def spoil(start: Start, share: float, seed: int) -> Start:
    """Replace a share of the ranges by uniform ones between the day's least and largest."""
    if not share:
        return start
    random = np.random.default_rng(seed)
    ranges = np.concatenate([each.landmark_detections.ranges for each in start.world.streams])
    least, most = ranges.min(initial=1.0), ranges.max(initial=1.0)
    streams = []
    for each in start.world.streams:
        seen = each.landmark_detections
        is_wild = random.random(len(seen.ranges)) < share
        wild = np.where(is_wild, random.uniform(least, most, len(seen.ranges)), seen.ranges)
        streams.append(replace(each, landmark_detections=replace(seen, ranges=wild)))
    return start._replace(world=replace(start.world, streams=tuple(streams)))


def judge(start: Start) -> list[dict[str, Any]]:
    """Run a start; judge each robot that has seen two landmarks of the map."""
    samples, _, _ = day(0, [start.saved], scenario=start.scenario, streams=start.world)
    first: dict[str, m.PoseEstimate] = {}
    for sample in samples:
        message = opened(sample)[2]
        is_pose = isinstance(message, m.PoseEstimate) and "/team/" in str(sample.key)
        if is_pose and message.in_team_frame and message.frame == "map-site/0":
            first.setdefault(message.robot, message)
    known = set(ids(start.saved.ids, "ids").tolist())
    begins_ns = min(first for first, _ in start.world.spans_ns.values())
    found = []
    for each in start.world.streams:
        seen_ns = _second_landmark(each, known)
        if seen_ns is None or seen_ns > begins_ns + LENGTH_NS:
            continue
        row: dict[str, Any] = {"robot": each.robot, "placed": each.robot in first}
        if (pose := first.get(each.robot)) is not None:
            error, covariance = _error(each, pose), floats(pose.covariance, "c").reshape(3, 3)
            row |= {
                "delay_s": (pose.stamp_ns - seen_ns) * 1e-9,
                "error_m": float(np.hypot(*error[:2])),
                "error_deg": float(np.degrees(abs(error[2]))),
                "sigma_m": float(np.sqrt(np.trace(covariance[:2, :2]))),
                "nees": float(error @ np.linalg.solve(covariance, error)),
            }
        found.append(row)
    return found


def _second_landmark(stream: RobotStream, known: set[int]) -> int | None:
    """Time at which the robot has seen two landmarks of the map."""
    seen, of = set[int](), stream.landmark_detections
    for k, stamp_ns in enumerate(of.stamps_ns.tolist()):
        seen |= {*of.ids[of.rows(k)].tolist()} & known
        if len(seen) > 1:
            return int(stamp_ns)
    return None


def _error(stream: RobotStream, pose: m.PoseEstimate) -> np.ndarray:
    assert stream.truth_ns is not None
    assert stream.truth is not None
    x, y = (np.interp(pose.stamp_ns, stream.truth_ns, stream.truth[:, k]) for k in (0, 1))
    turn = np.interp(pose.stamp_ns, stream.truth_ns, np.unwrap(stream.truth[:, 2]))
    error = floats(pose.pose, "pose") - [x, y, turn]
    error[2] = (error[2] + np.pi) % (2.0 * np.pi) - np.pi
    return error


def summary(rows: list[dict[str, Any]]) -> dict[str, float]:
    placed = [row for row in rows if row["placed"]]
    of = {name: np.array([row[name] for row in placed]) for name in placed[0] if name != "robot"}
    return {
        "robots": len(rows),
        "not_placed": len(rows) - len(placed),
        "median_delay_s": float(np.median(of["delay_s"])),
        "worst_delay_s": float(of["delay_s"].max()),
        "median_error_m": float(np.median(of["error_m"])),
        "worst_error_m": float(of["error_m"].max()),
        "worst_error_deg": float(of["error_deg"].max()),
        "median_sigma_m": float(np.median(of["sigma_m"])),
        "nees_per_dof": float(of["nees"].mean() / 3.0),
        "within_two_sigma": float((of["nees"] <= chi2_limit(3, NAMED_SIGMAS["two"])).mean()),
        "wrong": int((of["nees"] > chi2_limit(3, NAMED_SIGMAS["six"])).sum()),
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--starts", type=int, default=20)
    parser.add_argument("--set", type=Path)
    parser.add_argument("--wild", type=float, default=0.0, help="share of wrong ranges")
    parser.add_argument("--json", type=Path)
    asked = parser.parse_args()
    starts = simulated(asked.starts) if asked.set is None else recorded(asked.set, asked.starts)
    rows = []
    for number, start in enumerate(starts):
        rows += (found := judge(spoil(start, asked.wild, number)))
        print(json.dumps(found), flush=True)
    of_all = summary(rows)
    for name, value in of_all.items():
        print(f"{name:18} {value:.3f}")
    if asked.json is not None:
        asked.json.write_text(json.dumps({"rows": rows, "summary": of_all}, indent=2) + "\n")
    late = of_all["not_placed"] or of_all["worst_delay_s"] > WITHIN_S
    poor = late or of_all["within_two_sigma"] < 0.85
    return int(bool(of_all["wrong"] or (poor and not asked.wild)))


if __name__ == "__main__":
    sys.exit(main())
