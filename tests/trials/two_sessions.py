"""A recording cut into two sessions, the second with the saved map of the first and no start.

    python -m tests.trials.two_sessions --set MRCLAM_Dataset1.zip
    python -m tests.trials.two_sessions --set cityTrees10000.txt --robots 4 --by 1
    python -m tests.trials.two_sessions --set victoria --robots 4 --by 1

Each row is a map: error after alignment, NEES per degree of freedom with its 95 % band, number of
landmarks, and those reported as moved or gone. `whole` is one session, cut into two halves of
time, and into its first, third, … robots and the others; a single robot's recording is first cut
into --robots pieces. `robots: whole` is one session with the measurements and starts of both,
without measurements between the groups. In `displaced` the landmark that the second session
observes most has been moved by --by metres before. A landmark without identity is compared with the
true one of most of its labelled detections. Ends with 1 if the error of two sessions exceeds 1.05
times that of one session with the same measurements, a joined map's NEES is above the band, a
change is reported falsely, or the displacement is not found within 4 standard deviations.
"""

import argparse
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np

from teamslam.central.desk.evaluation.association import association_result
from teamslam.central.desk.evaluation.errors import transform_points
from teamslam.central.desk.evaluation.log import collect_log
from teamslam.sim.in_memory.team import final_map
from teamslam.sim.scenarios.scenario import Scenario, load, with_options
from teamslam.sim.scenarios.source import scenario_beside, streams_of, with_present_robots
from teamslam.sim.world.streams import NO_LABEL, Detections, RobotStream, WorldStreams
from teamslam.team.config import UNNAMED, Sensor
from teamslam.team.core import unpacked
from teamslam.team.estimation.consistency import chi2_limit
from teamslam.team.estimation.contribution import is_map
from teamslam.team.estimation.map_joining.alignment import Maps, align, procrustes
from teamslam.team.wire import messages as m
from teamslam.team.wire.arrays import floats, ids
from teamslam.team.wire.bus import Sample, opened
from tests.central.test_saved_map import changed, day, part
from tests.scenarios import selected


class Session(NamedTuple):
    scenario: Scenario
    world: WorldStreams


class Figures(NamedTuple):
    """Error [m], NEES per degree of freedom, its 95 % limit, and the true landmark of each row."""

    rmse: float
    nees: float
    limit: float
    truth: dict[int, int]


def labels_of(samples: Sequence[Sample], before: Mapping[int, int]) -> dict[int, int]:
    """Label each unnamed landmark of the final map by the most of its detections.

    before: labels of the saved map's landmarks, for those that no detection of today has.
    """
    log = collect_log(samples)
    found = association_result(log)
    labels = {}
    for each in final_map(samples).memberships:
        if is_map((each.robot, each.incarnation)):
            locals_, identities = ids(each.locals, "locals"), ids(each.identities, "identities")
            saved = zip(locals_.tolist(), identities.tolist(), strict=True)
            labels |= {id_: before[UNNAMED + k] for k, id_ in saved if UNNAMED + k in before}
    today = {} if found is None else found.label_of
    return labels | {id_: label for id_, label in today.items() if label != NO_LABEL}


def figures(fused: m.FusedMap, world: WorldStreams, labels: Mapping[int, int]) -> Figures:
    """Compare a map with the true landmarks, after alignment; labels: of unnamed landmarks."""
    assert world.landmarks is not None
    own = ids(fused.ids, "ids")
    numbers = np.array([labels.get(k, k) for k in own.tolist()], own.dtype)
    means = floats(fused.means, "means").reshape(-1, 2)
    rows = np.searchsorted(world.landmark_ids, np.minimum(numbers, world.landmark_ids[-1]))
    rows = np.where(world.landmark_ids[rows] == numbers, rows, -1)
    known = rows >= 0
    truth, means, count = world.landmarks[rows[known]], means[known], int(known.sum())
    chosen = np.flatnonzero(np.repeat(known, 2))
    P = unpacked(floats(fused.covariance, "covariance"), 2 * len(numbers))[np.ix_(chosen, chosen)]
    fit = align(Maps(truth, 1e-12 * np.eye(len(P)), means, P))
    off = truth - transform_points(np.array(procrustes(truth, means, np.ones(count))), means)
    limit = chi2_limit(fit.dof, 0.025) / fit.dof
    of = dict(zip(own[known].tolist(), world.landmark_ids[rows[known]].tolist(), strict=True))
    return Figures(float(np.sqrt((off**2).sum(axis=1).mean())), fit.chi2 / fit.dof, limit, of)


def poses(stream: RobotStream, samples: Sequence[Sample]) -> tuple[np.ndarray, np.ndarray]:
    """Times and poses of a robot: the true ones, else those of its run in the team's frame."""
    if stream.truth_ns is not None and stream.truth is not None:
        return stream.truth_ns, stream.truth
    found = [
        (message.stamp_ns, floats(message.pose, "pose"))
        for message in (opened(each)[2] for each in samples if "/team/pose" in str(each.key))
        if isinstance(message, m.PoseEstimate)
        and message.in_team_frame
        and message.robot == stream.robot
    ]
    return np.array([each[0] for each in found]), np.array([each[1] for each in found])


def displace(
    seen: Detections,
    landmark: int,
    by: np.ndarray,
    path: tuple[np.ndarray, np.ndarray],
    sensor: Sensor,
) -> Detections:
    """Change a robot's measurements of a landmark as if it had been moved."""
    stamps_ns, pose = path
    of = np.repeat(seen.stamps_ns, np.diff(seen.offsets))
    heading = np.interp(of, stamps_ns, np.unwrap(pose[:, 2]))
    rows = seen.ids == landmark
    s, c = np.sin(heading), np.cos(heading)
    step = np.where(
        rows[:, None], np.column_stack([c * by[0] + s * by[1], c * by[1] - s * by[0]]), 0.0
    )
    if seen.points is not None:
        points = seen.points + step
        ranges, bearings = np.hypot(*points.T), np.arctan2(points[:, 1], points[:, 0])
        return replace(seen, ranges=np.maximum(ranges, 1e-3), bearings=bearings, points=points)
    true = seen.bearings - sensor.bearing_offset * (abs(sensor.bearing_offset) > 0.5)
    away = seen.ranges / np.cos(true) if sensor.range_is_depth else seen.ranges
    before = away[:, None] * np.column_stack([np.cos(true), np.sin(true)])
    after = before + step
    turn = np.arctan2(after[:, 1], after[:, 0]) - np.arctan2(before[:, 1], before[:, 0])
    bearings = np.pi - np.remainder(np.pi - (seen.bearings + turn), 2.0 * np.pi)
    ranges = seen.ranges + (step[:, 0] if sensor.range_is_depth else np.hypot(*after.T) - away)
    return replace(seen, ranges=np.maximum(ranges, 1e-3), bearings=bearings)


def most_observed(world: WorldStreams, since_ns: dict[str, int], known: set[int]) -> int:
    """The known landmark observed most, of those first observed since a time."""
    counts, early = Counter[int](), {int(NO_LABEL)}
    for stream in world.streams:
        seen = stream.landmark_detections
        counts.update(seen.ids.tolist())
        first = int(np.searchsorted(seen.stamps_ns, since_ns[stream.robot]))
        early |= {*seen.ids[: seen.offsets[first]].tolist()}
    return max((each for each in counts if each in known - early), key=lambda x: (counts[x], x))


def row(
    name: str, samples: Sequence[Sample], world: WorldStreams, before: Mapping[int, int]
) -> Figures:
    fused = final_map(samples)
    found = figures(fused, world, labels_of(samples, before))
    told = {k: each.state for k, each in changed(fused).items() if each.state != "new"}
    shown = f"{found.rmse:8.4f} {found.nees:6.2f} ({found.limit:.2f}) {len(found.truth):4d}"
    print(f"{name:20} {shown}  {told}", flush=True)
    return found


def joined(name: str, first: Session, second: Session, limit_m: float, by: np.ndarray) -> bool:
    """Run two sessions, also with a displaced landmark; return whether all bounds hold."""
    samples, centre, _ = day(1, scenario=first.scenario, streams=first.world)
    of_first = row(f"{name}: first", samples, first.world, {})
    saved = centre.maps.fold.save_map("first")
    samples, _, _ = day(1, [saved], scenario=second.scenario, streams=second.world)
    both = row(f"{name}: joined", samples, second.world, of_first.truth)
    is_good = both.rmse <= limit_m and both.nees <= both.limit
    is_good &= not [x for x in changed(final_map(samples)).values() if x.state != "new"]
    paths = {each.robot: poses(each, samples) for each in second.world.streams}
    since = {robot: int(stamps_ns[0]) for robot, (stamps_ns, _) in paths.items()}
    landmark = most_observed(second.world, since, {*of_first.truth.values()})
    sensor_of = {each.id: each.sensor for each in second.scenario.robots}
    streams = []
    for each in second.world.streams:
        of = landmark, by, paths[each.robot], sensor_of[each.robot]
        seen = displace(each.landmark_detections, *of)
        streams.append(replace(each, landmark_detections=seen))
    assert second.world.landmarks is not None
    places = second.world.landmarks.copy()
    places[np.searchsorted(second.world.landmark_ids, landmark)] += by
    world = replace(second.world, streams=tuple(streams), landmarks=places)
    samples, _, _ = day(1, [saved], scenario=second.scenario, streams=world)
    fused = final_map(samples)
    truth = row(f"{name}: displaced", samples, world, of_first.truth).truth
    told = {truth.get(k): each for k, each in changed(fused).items() if each.state != "new"}
    found = told.get(landmark)
    if found is None:
        print(f"landmark {landmark} is not found")
        return False
    off = np.array([found.dx, found.dy]) - by
    print(
        f"landmark {landmark} moved by ({found.dx:.3f}, {found.dy:.3f}) ± {found.sigma:.3f} m, in "
        f"truth ({by[0]:.3f}, {by[1]:.3f}); chi2 {found.chi2:.0f}",
        flush=True,
    )
    return bool(is_good and list(told) == [landmark] and (np.abs(off) < 4.0 * found.sigma).all())


def of_robots(session: Session, robots: Sequence[str], *, begins: bool) -> Session:
    """Choose robots of a session, without their measurements of the others."""
    streams = []
    for each in session.world.streams:
        if each.robot not in robots:
            continue
        seen = each.teammate_detections
        chosen = np.array([each.teammates[k] in robots for k in seen.ids.tolist()], np.bool_)
        start = each.start if begins else None
        streams.append(replace(each, start=start, teammate_detections=selected(seen, chosen)))
    team = tuple(each for each in session.scenario.robots if each.id in robots)
    return Session(
        msgspec.structs.replace(session.scenario, robots=team),
        replace(session.world, streams=tuple(streams)),
    )


def in_one(whole: Session, parts: Sequence[Session]) -> Session:
    of = {each.robot: each for session in parts for each in session.world.streams}
    streams = tuple(of[each.robot] for each in whole.world.streams)
    return Session(whole.scenario, replace(whole.world, streams=streams))


def until(world: WorldStreams, length_s: float | None) -> WorldStreams:
    """Cut a recording at its length."""
    if length_s is None:
        return world
    first_ns = min(first for first, _ in world.spans_ns.values())
    return part(world, first_ns, first_ns + round(length_s * 1e9), begins=True)


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--set", type=Path, required=True)
    parser.add_argument("--length", type=float, help="seconds of the recording")
    parser.add_argument("--robots", type=int, help="number of robots, or of pieces of a single one")
    parser.add_argument("--by", type=float, default=0.05)
    asked = parser.parse_args()
    scenario = with_options(load(scenario_beside(asked.set)), dataset=asked.set)
    scenario, _ = with_present_robots(scenario)
    is_single = len(scenario.robots) == 1
    if not is_single:
        scenario = with_options(scenario, robots=asked.robots)
    whole = Session(scenario, until(streams_of(scenario), asked.length))
    by = asked.by * np.array([0.8, -0.6])
    print("session                RMSE [m]   NEES (limit) landmarks changes")
    samples, _, _ = day(1, scenario=whole.scenario, streams=whole.world)
    limit_m = 1.05 * row("whole", samples, whole.world, {}).rmse
    begins_ns, ends_ns = zip(*whole.world.spans_ns.values(), strict=True)
    first_ns, last_ns = min(begins_ns), max(ends_ns)
    middle_ns = (first_ns + last_ns) // 2
    first = Session(scenario, part(whole.world, first_ns, middle_ns, begins=True))
    second = Session(scenario, part(whole.world, middle_ns, last_ns, begins=False))
    is_good = joined("halves", first, second, limit_m, by)
    if is_single and asked.robots is not None:
        scenario = with_options(scenario, robots=asked.robots)
        whole = Session(scenario, until(streams_of(scenario), asked.length))
    names = [each.id for each in whole.scenario.robots]
    if len(names) > 1:
        first = of_robots(whole, names[::2], begins=True)
        second = of_robots(whole, names[1::2], begins=False)
        reference = in_one(whole, (first, second))
        samples, _, _ = day(1, scenario=reference.scenario, streams=reference.world)
        of_both = row("robots: whole", samples, reference.world, {})
        limit_m = 1.05 * of_both.rmse
        is_good &= joined("robots", first, second, limit_m, by)
    return int(not is_good)


if __name__ == "__main__":
    sys.exit(main())
