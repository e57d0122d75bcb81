"""Export a log's measurements: a landmark graph (g2o, isam, pyfg) or a UTIAS data set.

Poses of a graph are the sensor's at keyframes, from the final map and odometry, or odometry alone.
Edges are the odometry, and accepted measurements as points with first-order covariance.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from teamslam.central.desk.evaluation.errors import interpolate_truth
from teamslam.central.desk.evaluation.evaluation import evaluate
from teamslam.central.desk.evaluation.results import Evaluation
from teamslam.central.desk.export.take_home import seconds
from teamslam.sim.datasets.factor_graph import (
    FactorGraph,
    Key,
    Matrix,
    PointEdge,
    PoseEdge,
    place_by_odometry,
    turn_covariance,
)
from teamslam.sim.datasets.utias import beyond_utias, write_utias
from teamslam.sim.recorded.chains import (
    BatchReferenceError,
    Chain,
    anchor_chain,
    chains_of,
    place_chains,
)
from teamslam.sim.recorded.streams import recorded_streams
from teamslam.team.config import UNNAMED
from teamslam.team.core import predicted
from teamslam.team.driver.source import FIRST_INCARNATION
from teamslam.team.estimation.se2 import compose
from teamslam.team.recording.reader import Log, LogError
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.bus import try_open

FLOOR = np.diag((1e-4, 2e-3, 1e-4)) ** 2
"""Added to a singular covariance of a motion: without slip, or without motion."""
SINGULAR = 1e-12


def export_graph(log: Log, folder: Path, form: str) -> list[Path]:
    """Write graph.g2o, graph.pyfg, or isam's ROBOT.txt of each robot; raises LogError."""
    run = evaluate(log.samples())
    graph = _graph(log, run)
    if form == "isam":
        texts = {f"{robot}.txt": isam_lines(graph, robot) for robot in graph.robots}
    elif form == "g2o":
        texts = {"graph.g2o": g2o_lines(graph)}
    else:
        if len(graph.robots) > len(LETTERS):
            what = f"{len(graph.robots)} robots, and pyfg has names for {len(LETTERS)}"
            raise LogError(log.path, what, "`--format g2o` has no limit")
        _place_truly(graph, run)
        texts = {"graph.pyfg": pyfg_lines(graph)}
    folder.mkdir(parents=True, exist_ok=True)
    for name, lines in texts.items():
        text = "".join(f"{line}\n" for line in lines)
        (folder / name).write_text(text, encoding="ascii")
    return [folder / name for name in texts]


def _graph(log: Log, run: Evaluation) -> FactorGraph:
    if run.scenario is None:
        raise LogError(
            log.path, "no scenario in it, so no noise of the measurements", "record a run whole"
        )
    try:
        chains = chains_of(log.samples(), run.scenario)
    except BatchReferenceError as error:
        raise LogError(log.path, str(error), "") from None
    graph = FactorGraph(log.path.stem)
    with_place, anchors, _ = place_chains(chains, run)
    for chain, anchor in zip(with_place, anchors, strict=True):
        for k, pose in enumerate(anchor_chain(chain, anchor)[2]):
            graph.poses[_name(chain), k] = pose
    if run.map is not None:
        graph.landmarks = dict(zip(run.map.ids.tolist(), run.map.means, strict=True))
    for chain in chains:
        _add_chain(graph, chain)
    if not graph.point_edges:
        raise LogError(
            log.path,
            "no measurement of a landmark with an identity in it",
            "detections without identities are no edges of a graph; `--format csv` writes them",
        )
    place_by_odometry(graph)
    seen = {edge.landmark for edge in graph.point_edges}
    graph.landmarks = {i: point for i, point in graph.landmarks.items() if i in seen}
    return graph


def _name(chain: Chain) -> str:
    return f"{chain.config.id}{'' if chain.incarnation == 1 else f'/{chain.incarnation}'}"


def _add_chain(graph: FactorGraph, chain: Chain) -> None:
    robot = _name(chain)
    keys: list[Key] = [(robot, k) for k in range(len(chain.stamps_ns))]
    graph.stamps_ns |= dict(zip(keys, chain.stamps_ns.tolist(), strict=True))
    if chain.start is not None:
        graph.priors[keys[0]] = chain.start, chain.start_covariance
        graph.poses.setdefault(keys[0], chain.start)
    for start, end, increment in zip(keys, keys[1:], chain.increments, strict=False):
        covariance = increment.covariance
        if np.linalg.eigvalsh(covariance)[0] < SINGULAR:
            covariance = covariance + FLOOR
        graph.pose_edges.append(PoseEdge(start, end, increment.mean, covariance))
    for key, scan in zip(keys[1:], chain.scans, strict=True):
        seen = zip(scan.ids.tolist(), scan.ranges.tolist(), scan.bearings.tolist(), strict=True)
        for i, (landmark, r, b) in enumerate(seen):
            if landmark >= UNNAMED:
                continue
            distance = r
            if key in graph.poses and landmark in graph.landmarks:
                distance, _ = predicted(graph.poses[key], graph.landmarks[landmark])
            c, s = np.cos(b), np.sin(b)
            J = np.array([[c, -r * s], [s, r * c]])
            covariance = J @ scan.noise(i, chain.config.sensor, distance) @ J.T
            graph.point_edges.append(PointEdge(key, landmark, np.array([r * c, r * s]), covariance))


def _place_truly(graph: FactorGraph, run: Evaluation) -> None:
    for robot in graph.robots:
        found = run.robots.get(robot)
        if found is None or run.scenario is None:
            continue
        keys = graph.chain(robot)[0]
        stamps = np.array([graph.stamps_ns[key] for key in keys])
        poses, known = interpolate_truth(found.truth, stamps)
        if known.all():
            config = next(each for each in run.scenario.robots if each.id == robot)
            mount = np.array(config.sensor.mount)
            graph.poses |= {key: compose(p, mount) for key, p in zip(keys, poses, strict=True)}
    if run.map is not None:
        rows = np.flatnonzero(run.map.known).tolist()
        truth = {int(run.map.ids[k]): run.map.truth[k] for k in rows}
        graph.landmarks |= {i: truth[i] for i in graph.landmarks if i in truth}


CHANNELS = (*ch.SENSORS, ch.TRUTH, ch.TRUTH_LANDMARKS)


def export_utias(log: Log, folder: Path) -> list[str]:
    """Write the first incarnations, robots in the order of their numbers; raises LogError."""
    opened = filter(None, map(try_open, log.samples(CHANNELS)))
    messages = [message for _, _, message in opened]
    measurements = [each for each in messages if isinstance(each, m.Measurement)]
    robots = {each.robot for each in measurements if each.incarnation == FIRST_INCARNATION}
    if not robots:
        raise LogError(
            log.path, "no sensor measurements in it", "`--format csv` writes what there is"
        )
    sighted = {n for each in measurements if isinstance(each, m.Sightings) for n in each.teammates}
    if sighted - robots:
        what = (
            f"it has sightings of {', '.join(sorted(sighted - robots))} but not their measurements"
        )
        raise LogError(log.path, what, "`teamslam log merge` puts the robots' logs together")
    try:
        world = recorded_streams(messages, log.path.name)
    except ValueError as error:
        remedy = "the format needs measurements without gaps: `teamslam log cut` to a part without"
        raise LogError(log.path, str(error), remedy) from None
    lost = beyond_utias(world)
    if lost:
        what = f"it has {', '.join(lost)}, which the format does not have"
        raise LogError(
            log.path, what, f"`teamslam import {log.path} -o FOLDER` writes tables of it"
        )
    write_utias(world, folder)
    return [stream.robot for stream in world.streams]


LETTERS = "ABCDEFGHIJKMNOPQRSTUVWXYZ"  # names of robots in pyfg, where L is a landmark's


def g2o_lines(graph: FactorGraph) -> Iterator[str]:
    """Lines of a g2o file: poses are numbered behind landmarks."""
    first = max(graph.landmarks, default=-1) + 1
    vertex: dict[Key, int] = {}
    for landmark, point in sorted(graph.landmarks.items()):
        yield f"VERTEX_XY {landmark} {_numbers(point)}"
    for robot in graph.robots:
        yield f"# robot {robot}"
        for key in graph.chain(robot)[0]:
            vertex[key] = first + len(vertex)
            yield f"VERTEX_SE2 {vertex[key]} {_numbers(graph.poses[key])}"
            if key in graph.priors and graph.priors[key][1] is None:
                yield f"FIX {vertex[key]}"
        first += 1  # a gap in the numbers, where no odometry leads from robot to robot
    for pose_edge in graph.pose_edges:
        ends = f"{vertex[pose_edge.start]} {vertex[pose_edge.end]}"
        information = _upper(np.linalg.inv(pose_edge.covariance))
        yield f"EDGE_SE2 {ends} {_numbers(pose_edge.motion)} {information}"
    for seen in graph.point_edges:
        ends = f"{vertex[seen.pose]} {seen.landmark}"
        yield f"EDGE_SE2_XY {ends} {_numbers(seen.point)} {_upper(np.linalg.inv(seen.covariance))}"


def isam_lines(graph: FactorGraph, robot: str) -> Iterator[str]:
    """Lines of one robot, with the root S of the information SᵀS."""
    number = {key: k for k, key in enumerate(graph.chain(robot)[0])}
    seen_from: dict[Key, list[str]] = {}
    for seen in graph.point_edges:
        if seen.pose in number:
            seen_from.setdefault(seen.pose, []).append(
                f"LANDMARK {number[seen.pose]} {seen.landmark} {_numbers(seen.point)} "
                f"{_upper(_root(seen.covariance))}"
            )
    for edge in graph.chain(robot)[1]:
        yield from seen_from.pop(edge.start, ())
        covariance = turn_covariance(edge.covariance, -edge.motion[2])
        ends = f"{number[edge.start]} {number[edge.end]}"
        yield f"ODOMETRY {ends} {_numbers(edge.motion)} {_upper(_root(covariance))}"
    for rest in seen_from.values():
        yield from rest


def pyfg_lines(graph: FactorGraph) -> Iterator[str]:
    """Lines of a pyfg file: robots are A, B, C, …, in order."""
    name: dict[Key, str] = {}
    for letter, robot in zip(LETTERS, graph.robots, strict=False):
        for k, key in enumerate(graph.chain(robot)[0]):
            name[key] = f"{letter}{k}"
            yield f"VERTEX_SE2 {_time(graph, key)} {name[key]} {_numbers(graph.poses[key])}"
    for landmark, point in sorted(graph.landmarks.items()):
        yield f"VERTEX_XY L{landmark} {_numbers(point)}"
    for key, (pose, covariance) in sorted(graph.priors.items()):
        if covariance is not None:
            placed = f"{_time(graph, key)} {name[key]} {_numbers(pose)}"
            yield f"VERTEX_SE2:PRIOR {placed} {_upper(covariance)}"
    for edge in graph.pose_edges:
        ends = f"{_time(graph, edge.end)} {name[edge.start]} {name[edge.end]}"
        yield f"EDGE_SE2 {ends} {_numbers(edge.motion)} {_upper(edge.covariance)}"
    for seen in graph.point_edges:
        ends = f"{_time(graph, seen.pose)} {name[seen.pose]} L{seen.landmark}"
        yield f"EDGE_SE2_XY {ends} {_numbers(seen.point)} {_upper(seen.covariance)}"


def _time(graph: FactorGraph, key: Key) -> str:
    return seconds(graph.stamps_ns[key])


def _root(covariance: Matrix) -> Matrix:
    """Upper root S of the information, SᵀS = C⁻¹."""
    return np.asarray(np.linalg.cholesky(np.linalg.inv(covariance)).T)


def _upper(matrix: Matrix) -> str:
    return _numbers(matrix[np.triu_indices(len(matrix))])


def _numbers(values: Sequence[float] | np.ndarray) -> str:
    return " ".join(f"{value:.17g}" for value in values)
