"""Is a map in the minimum that the truth lies in? Asked of the cost, not of the covariance.

An ellipsoid is exceeded wherever the valley of the cost is curved, though the minimum is the right
one. So the final map's own cost is asked three things: whether a solution that starts at the truth
ends lower, whether it ends in another place that is about as likely, and by how much the cost rises
where the truth is held fixed (the likelihood ratio: χ² of the numbers held, however they are
written down).
"""

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.special import chdtri

from central.tick_fold import TickFold
from sim.evaluation.errors import Path, interpolated
from sim.evaluation.evaluation import Evaluation
from sim.rerun.log import Recorded
from team import translate
from team.estimation.gauss_newton import Island
from team.estimation.joining import Fold, converged
from team.estimation.minima import LIKELY, elsewhere, likely_rise, minimum, searched
from team.wire import messages as m
from team.wire.bus import Sample

LOWER = 1.0
"""A cost that is lower by more than this belongs to another minimum."""
Values = Float[np.ndarray, " _"]


class TrueMinimum(NamedTuple):
    """How the map's minimum lies to the truth.

    lower: by how much a solution from the truth has less cost. elsewhere: it ends in another place
    that is likely. rise: of the cost with the landmarks and each robot's first end of a submap held
    at the truth; dof: how many numbers that holds.
    """

    lower: float
    elsewhere: bool
    rise: float
    dof: int

    @property
    def wrong(self) -> bool:
        """Whether the map is in another minimum than the truth."""
        return self.lower > LOWER or self.elsewhere

    @property
    def excluded(self) -> bool:
        """Whether the submaps exclude the truth with 99.9 %."""
        return self.rise > float(chdtri(self.dof, 1.0 - LIKELY))


def true_minimum(samples: Iterable[Sample], run: Evaluation) -> TrueMinimum | None:
    """Of the final map of a run under `join`; None without a start that is known."""
    fold = final_fold(samples)
    if run.map is None or not fold.starts:
        return None
    landmarks = dict(
        zip(run.map.ids[run.map.known].tolist(), run.map.truth[run.map.known], strict=True)
    )
    return judged(fold.main, landmarks, {name: each.truth for name, each in run.robots.items()})


def final_fold(samples: Iterable[Sample]) -> Fold:
    """The centre's final fold, from the submaps and sightings that a log has."""
    log = Recorded()
    for sample in samples:
        log.take(sample)
    ticks = TickFold(log.central_config()[0])
    sightings = log.sightings()
    for stream, readings in log.readings.items():
        start = readings.get(0)
        value = translate.start_of(start) if isinstance(start, m.Start) else None
        if value is not None:
            ticks.know_start(value)
        for sequence, submap in sorted(log.submaps().get(stream, {}).items()):
            ticks.add(submap, b"", sightings.get((*stream, sequence), ()))
    ticks.take_until(float("inf"))
    return converged(ticks.fold, ticks.settings)


def judged(
    island: Island,
    landmarks: Mapping[int, Float[np.ndarray, "2"]],
    paths: Mapping[str, Path],
) -> TrueMinimum:
    """Of an island in the frame of the truth, solved."""
    graph = island.graph
    truth, known = _at_truth(island, landmarks, paths)
    ours = minimum(island)
    ends = minimum(replace(island, state=truth))
    lowest = min(ends.cost, searched([replace(island, state=truth)]).best.cost)
    other = elsewhere(ends, ours) and ends.cost - ours.cost < likely_rise()
    firsts = {nodes[1] for nodes in graph.streams.values()}
    held = sorted(({*graph.landmarks.values()} | firsts) & known)
    fixed = graph.fixed.copy()
    fixed[held] = True
    pinned = replace(graph, fixed=fixed)
    begins = [truth, island.state.copy()]
    for node in held:
        span = slice(graph.offset[node], graph.offset[node + 1])
        begins[1][span] = truth[span]
    rise = min(minimum(replace(island, graph=pinned, state=s)).cost for s in begins) - ours.cost
    dof = graph.unknowns - pinned.unknowns
    return TrueMinimum(ours.cost - lowest, bool(other), rise, dof)


def _at_truth(
    island: Island, landmarks: Mapping[int, Float[np.ndarray, "2"]], paths: Mapping[str, Path]
) -> tuple[Values, set[int]]:
    """The state with every node at its true value, and the nodes of which that is known."""
    graph, state = island.graph, island.state.copy()
    known: set[int] = set()

    def place(node: int, value: Values) -> None:
        state[graph.offset[node] : graph.offset[node + 1]] = value
        known.add(node)

    for id_, node in graph.landmarks.items():
        if id_ in landmarks:
            place(node, landmarks[id_])
    for contribution, nodes in graph.submaps:
        path = paths[contribution.robot]
        stamps = np.array([contribution.end_ns, *contribution.local.node_stamps.tolist()])
        poses, there = interpolated(path, stamps)
        for node, pose, told in zip(nodes[1:], poses, there, strict=False):
            if told:
                place(int(node), pose)
        if contribution.sequence == 0 and not graph.fixed[nodes[0]] and len(path.poses):
            place(int(nodes[0]), path.poses[0])
    return state, known
