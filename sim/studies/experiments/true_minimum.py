"""Decide by the cost, not the covariance, whether map and truth lie in the same minimum.

By `plain_cost`: whether a solution from the truth has less cost, or ends elsewhere about as
likely, and the rise of the cost with the truth fixed (likelihood ratio, χ² of the fixed
coordinates).
"""

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import NamedTuple

import msgspec
import numpy as np

from teamslam.central.desk.evaluation.errors import Path, interpolate_truth
from teamslam.central.desk.evaluation.results import Evaluation
from teamslam.central.desk.verification.recorded import Recorded
from teamslam.central.tick_fold import TickFold
from teamslam.sim.studies.experiments.plain_cost import PlainCost
from teamslam.team import translate
from teamslam.team.estimation.consistency import chi2_quantile
from teamslam.team.estimation.map_joining.gauss_newton import Island
from teamslam.team.estimation.map_joining.joining import Fold, solve_fold
from teamslam.team.shapes import Float
from teamslam.team.wire import messages as m
from teamslam.team.wire.bus import Sample

LOWER = 1.0
"""Decrease of the cost that indicates another minimum."""
LIKELY = 0.999
"""Quantile of χ² beyond which a place, or the truth, is excluded."""
NEARBY = 3
"""Number of initial states near the truth, besides the truth."""
NEARBY_RAD = 0.1
"""Standard deviation [rad] of these states' headings about the truth."""
Values = Float[np.ndarray, " _"]


class TrueMinimum(NamedTuple):
    """The map's minimum compared with that of a solution from the truth.

    lower: by how much the latter's cost is less. other_minimum: it ends outside the map's 99.9 %
    ellipsoid, at a cost that does not exclude it. rise: of the cost with landmarks and first
    submaps' ends fixed at the truth; dof: number of these coordinates.
    """

    lower: float
    other_minimum: bool
    rise: float
    dof: int

    @property
    def wrong(self) -> bool:
        """Whether map and truth lie in different minima."""
        return self.lower > LOWER or self.other_minimum

    @property
    def excluded(self) -> bool:
        """Whether the submaps exclude the truth with 99.9 %."""
        return self.rise > float(chi2_quantile(LIKELY, self.dof))


def true_minimum(samples: Iterable[Sample], run: Evaluation) -> TrueMinimum | None:
    """Figures of the final map under `join`; None without a known initial pose."""
    fold = final_fold(samples)
    if run.map is None or not fold.starts:
        return None
    landmarks = dict(
        zip(run.map.ids[run.map.known].tolist(), run.map.truth[run.map.known], strict=True)
    )
    return compare_minima(
        fold.main, landmarks, {name: each.truth for name, each in run.robots.items()}
    )


def final_fold(
    samples: Iterable[Sample], *, is_robust: bool = False, has_biases: bool = False
) -> Fold:
    """Recompute the final fold, by default with plain squares and no biases."""
    log = Recorded()
    for sample in samples:
        log.take(sample)
    ticks = TickFold(log.central_config()[0], limits=None)
    sightings = log.sightings()
    for stream, measurements in log.measurements.items():
        start = measurements.get(0)
        value = translate.start_of(start) if isinstance(start, m.InitialPose) else None
        if value is not None:
            ticks.add_start(value)
        for sequence, submap in sorted(log.submaps().get(stream, {}).items()):
            taken = submap if has_biases else _without_biases(submap)
            ticks.add_submap(taken, b"", sightings.get((*stream, sequence), ()))
    ticks.fold_until(float("inf"))
    return solve_fold(ticks.fold, replace(ticks.settings, robust=is_robust))


def _without_biases(submap: m.Submap) -> m.Submap:
    return msgspec.structs.replace(submap, biases=(), sensitivity=b"", curvature=b"")


def compare_minima(
    island: Island,
    landmarks: Mapping[int, Float[np.ndarray, "2"]],
    paths: Mapping[str, Path],
) -> TrueMinimum:
    """Figures of an island in the truth's frame, with plain squares and no biases."""
    graph, settings = island.graph, island.settings
    if settings.robust:
        raise NotImplementedError("this cost has plain squares, without a robust loss")
    if settings.joined_ranges:
        raise NotImplementedError("this cost has no central.joined_ranges: leave it out")
    fixed = np.repeat(graph.fixed, np.diff(graph.offset))
    cost = PlainCost(graph, settings.covariance_factor, fixed)
    ours = cost.of(island.state)
    truth, known = _at_truth(island, landmarks, paths)
    headings = graph.headings[~fixed[graph.headings]]
    rng = np.random.default_rng(0)
    found = [cost.solved(truth)]
    for _ in range(NEARBY):
        near = truth.copy()
        near[headings] += NEARBY_RAD * rng.normal(size=len(headings))
        found.append(cost.solved(near))
    ends = found[0]
    away = ends.state - island.state
    away[graph.headings] = np.angle(np.exp(1j * away[graph.headings]))
    whitened = cost.jacobian(island.state) @ away[cost.free]
    place = float(chi2_quantile(LIKELY, 3))
    other = ends.at_rest and whitened @ whitened > place and ends.cost - ours < place
    firsts = {nodes[1] for nodes in graph.streams.values()}
    pinned_nodes = sorted(({*graph.landmarks.values()} | firsts) & known)
    spans = [np.arange(graph.offset[node], graph.offset[node + 1]) for node in pinned_nodes]
    pinned = fixed.copy()
    pinned[np.concatenate([np.zeros(0, np.int64), *spans])] = True
    given = PlainCost(graph, settings.covariance_factor, pinned)
    from_ours = np.where(pinned, truth, island.state)
    rise = min(given.solved(state).cost for state in (truth, from_ours)) - ours
    dof = len(cost.free) - len(given.free)
    lower = ours - min(each.cost for each in found)
    return TrueMinimum(lower, bool(other), rise, dof)


def _at_truth(
    island: Island, landmarks: Mapping[int, Float[np.ndarray, "2"]], paths: Mapping[str, Path]
) -> tuple[Values, set[int]]:
    graph, state = island.graph, island.state.copy()
    known: set[int] = set()

    def place(node: int, value: Values) -> None:
        state[graph.offset[node] : graph.offset[node + 1]] = value
        known.add(node)

    for id_, node in graph.landmarks.items():
        if id_ in landmarks:
            place(node, landmarks[id_])
    for contribution, nodes, *_ in graph.submaps:
        path = paths[contribution.robot]
        stamps = np.array([contribution.end_ns, *contribution.local.node_stamps.tolist()])
        poses, there = interpolate_truth(path, stamps)
        for node, pose, is_known in zip(nodes[1:], poses, there, strict=False):
            if is_known:
                place(int(node), pose)
        if contribution.sequence == 0 and not graph.fixed[nodes[0]] and len(path.poses):
            place(int(nodes[0]), path.poses[0])
    return state, known
