"""A recording cut into two sessions, the second with the saved map of the first and no start.

    python -m tests.trials.two_sessions --set UTIAS_1.zip --length 500
    python -m tests.trials.two_sessions --set cityTrees10000.txt

Each row is a map: error after alignment, NEES per degree of freedom, and the landmarks that are
reported as moved or gone. `whole` is one session; `halves` are its two halves of time; in
`displaced` the landmark of the second half that is observed most has been moved by --by metres
before. Ends with 1 if the halves' error exceeds 1.05 times that of the whole, a change is reported
falsely, or the displacement is not found within 4 standard deviations.
"""

import argparse
import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np

from teamslam.sim.datasets.graph import is_graph
from teamslam.sim.in_memory.team import final_map
from teamslam.sim.scenarios.scenario import Scenario, load, with_options
from teamslam.sim.scenarios.source import streams_of
from teamslam.sim.world.streams import RobotStream, WorldStreams
from teamslam.team.wire import messages as m
from tests.central.test_saved_map import changed, day, errors, part


def displace(stream: RobotStream, landmark: int, point: np.ndarray, by: np.ndarray) -> RobotStream:
    """Change a robot's measurements of a landmark at `point` as if it had been moved.

    The displacement of range and bearing, and of a point, is that at the true poses.
    """
    seen = stream.landmark_detections
    assert stream.truth is not None
    assert stream.truth_ns is not None
    of = np.repeat(seen.stamps_ns, np.diff(seen.offsets))
    x, y, heading = (
        np.interp(of, stream.truth_ns, column)
        for column in (*stream.truth[:, :2].T, np.unwrap(stream.truth[:, 2]))
    )
    before = point[:, None] - [x, y]
    after = before + by[:, None]
    rows = seen.ids == landmark
    turn = np.arctan2(after[1], after[0]) - np.arctan2(before[1], before[0])
    bearings = np.where(rows, seen.bearings + turn, seen.bearings)
    ranges = seen.ranges + np.where(rows, np.hypot(*after) - np.hypot(*before), 0.0)
    points = seen.points
    if points is not None:
        s, c = np.sin(heading), np.cos(heading)
        step = np.column_stack([c * by[0] + s * by[1], c * by[1] - s * by[0]])
        points = points + np.where(rows[:, None], step, 0.0)
    bearings = np.pi - np.remainder(np.pi - bearings, 2.0 * np.pi)
    moved = replace(seen, ranges=np.maximum(ranges, 1e-3), bearings=bearings, points=points)
    return replace(stream, landmark_detections=moved)


def row(name: str, fused: m.FusedMap, world: WorldStreams) -> float:
    """Print a row of the table; return the error."""
    rmse, nees = errors(fused, world)
    told = {k: each.state for k, each in changed(fused).items() if each.state != "new"}
    print(f"{name:10} {rmse:8.4f} {nees:6.2f}  {told}", flush=True)
    return rmse


def trial(scenario: Scenario, world: WorldStreams, length_s: float | None, by_m: float) -> bool:
    """Run the sessions of a recording; whether all is as it should be."""
    first_ns = min(first for first, _ in world.spans_ns.values())
    last_ns = max(last for _, last in world.spans_ns.values())
    if length_s is not None:
        last_ns = min(last_ns, first_ns + round(length_s * 1e9))
    middle_ns = (first_ns + last_ns) // 2
    print("session     RMSE [m]   NEES  changes")
    whole, _, _ = day(1, scenario=scenario, streams=part(world, first_ns, last_ns, begins=True))
    limit = 1.05 * row("whole", final_map(whole), world)
    first = part(world, first_ns, middle_ns, begins=True)
    samples, centre, _ = day(1, scenario=scenario, streams=first)
    row("first", final_map(samples), world)
    saved = centre.maps.fold.save_map("first")
    second = part(world, middle_ns, last_ns, begins=False)
    samples, _, _ = day(1, [saved], scenario=scenario, streams=second)
    halves = final_map(samples)
    is_good = row("halves", halves, world) <= limit
    is_good &= not [each for each in changed(halves).values() if each.state != "new"]
    counts = Counter[int]()
    for stream in second.streams:
        counts.update(stream.landmark_detections.ids.tolist())
    landmark = max(counts, key=lambda each: (counts[each], each))
    by = by_m * np.array([0.8, -0.6])
    assert world.landmarks is not None
    point = world.landmarks[np.searchsorted(world.landmark_ids, landmark)]
    moved = tuple(displace(each, landmark, point, by) for each in second.streams)
    samples, _, _ = day(1, [saved], scenario=scenario, streams=replace(second, streams=moved))
    fused = final_map(samples)
    places = world.landmarks.copy()
    places[np.searchsorted(world.landmark_ids, landmark)] += by
    row("displaced", fused, replace(world, landmarks=places))
    told = {k: each for k, each in changed(fused).items() if each.state != "new"}
    found = told.get(landmark)
    if found is None:
        print(f"landmark {landmark} is not found")
        return False
    off = np.array([found.dx, found.dy]) - by
    print(
        f"landmark {landmark} moved by ({found.dx:.3f}, {found.dy:.3f}) ± {found.sigma:.3f} m, in "
        f"truth ({by[0]:.3f}, {by[1]:.3f}); chi2 {found.chi2:.0f}"
    )
    return bool(is_good and list(told) == [landmark] and (np.abs(off) < 4.0 * found.sigma).all())


def main() -> int:
    """Run the sessions of one recording."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--set", type=Path, required=True)
    parser.add_argument("--length", type=float, help="seconds of the recording")
    parser.add_argument("--by", type=float, default=0.05)
    asked = parser.parse_args()
    if is_graph(asked.set):
        scenario = with_options(load("graph"), dataset=asked.set, robots=1)
    else:
        scenario = with_options(load("utias"), dataset=asked.set, robots=3)
    world = streams_of(scenario)
    return int(not trial(scenario, world, asked.length, asked.by))


if __name__ == "__main__":
    sys.exit(main())
