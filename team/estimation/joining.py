"""The team's map as a fold over its submaps in their canonical order.

Joining minimises Σ ‖z − h(start pose, end pose, landmarks)‖² in the metric P⁻¹ over all submaps of
all robots, and over the sightings of teammates between their pose nodes. The fold takes the submaps
by ticks, each with the sightings from it; it is a pure function of their order and of the ticks'
boundaries. Streams whose start in the common frame is unknown are islands of their own until shared
landmarks and sightings tie them to the main island.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from jaxtyping import Int64

from team.estimation import alignment
from team.estimation.contribution import Contribution, Start, Stream, named
from team.estimation.gauss_newton import Island, JoinSettings, aged, iterated, settled
from team.estimation.island_ties import aligned_by, ties
from team.estimation.sighting import Sighting
from team.estimation.submap_graph import EMPTY_GRAPH, extended, merged, met

__all__ = [
    "EMPTY_FOLD",
    "Contribution",
    "Fold",
    "GapError",
    "JoinSettings",
    "LateStartError",
    "NotCanonicalError",
    "Sighting",
    "Start",
    "Stream",
    "converged",
    "folded",
    "lean",
    "started",
]

FULL_AGE = 1_000_000
"""Iterations after which every robust scale has come to its end."""


class NotCanonicalError(ValueError):
    """A submap is not behind the ones before it in the canonical order."""

    def __init__(self, contribution: Contribution) -> None:
        super().__init__(
            f"submap {contribution.sequence} of {named(contribution.stream)} comes out of order; "
            "sort by (end stamp, robot, epoch, sequence), for a late one fold again from before it"
        )
        self.contribution = contribution


class GapError(ValueError):
    """Submaps of a stream are missing before this one, so its start pose is not in the graph."""

    def __init__(self, contribution: Contribution, expected: int) -> None:
        super().__init__(
            f"{named(contribution.stream)}: submap {contribution.sequence} came, {expected} is next"
        )
        self.contribution = contribution
        self.expected = expected


class LateStartError(ValueError):
    """A start was given to a stream that the fold has submaps of already."""

    def __init__(self, start: Start) -> None:
        super().__init__(
            f"the start of {named(start.stream)} comes after its first submap; "
            "fold again with the start known from the beginning"
        )
        self.start = start


@dataclass(frozen=True, eq=False)
class Fold:
    """What the submaps taken so far say.

    home:       island (a key of `islands`) of each stream.
    reasons:    why an island other than the main one is not merged, by its frame.
    waiting:    sightings whose pose nodes are not both in one island, in canonical order.
    iterations, change: of the main island's last full solution: how many, the last step [m, rad].
    """

    contributions: tuple[Contribution, ...]
    starts: Mapping[Stream, Start]
    islands: Mapping[Stream, Island]
    home: Mapping[Stream, Stream]
    reasons: Mapping[Stream, str]
    waiting: tuple[Sighting, ...] = ()
    iterations: int = 0
    change: float = 0.0

    @property
    def main_key(self) -> Stream | None:
        """Key of the island with the known starts, else of the one with the smallest stream."""
        started = sorted(stream for stream in self.home if stream in self.starts)
        streams = started or sorted(self.home)
        return self.home[streams[0]] if streams else None

    @property
    def main(self) -> Island:
        """The island whose map is the team's. Raises KeyError before the first submap."""
        if self.main_key is None:
            raise KeyError("no submap has come yet")
        return self.islands[self.main_key]

    @property
    def frame(self) -> Stream | None:
        """The main island's frame is named by its smallest stream; None before any submap."""
        return None if self.main_key is None else min(self.main.graph.streams)

    def island(self, robot: str, epoch: int) -> Island:
        """The island of a stream. Raises KeyError for a stream without submaps."""
        return self.islands[self.home[(robot, epoch)]]

    def next_sequence(self, stream: Stream) -> int:
        """Sequence of the submap that the fold takes next from a stream."""
        if stream not in self.home:
            return 0
        return len(self.islands[self.home[stream]].graph.streams[stream]) - 1


EMPTY_FOLD = Fold((), {}, {}, {}, {})


def started(fold: Fold, start: Start) -> Fold:
    """The fold that knows where a stream starts; before that stream's first submap."""
    if start.stream in fold.home:
        raise LateStartError(start)
    return replace(fold, starts={**fold.starts, start.stream: start})


def folded(
    fold: Fold,
    contributions: Sequence[Contribution],
    settings: JoinSettings,
    sightings: Sequence[Sighting] = (),
) -> Fold:
    """One tick: take the submaps, place what is new, iterate, merge islands that can be.

    Contributions stand in canonical order, behind all that the fold has, without a gap in a
    stream; else NotCanonicalError or GapError. Islands without news keep their state. sightings:
    those from the submaps of this tick; each is a factor from the tick on in which both of its pose
    nodes are in one island.
    """
    _check(fold, contributions)
    home = dict(fold.home)
    news: dict[Stream, list[Contribution]] = {}
    for contribution in contributions:
        stream = contribution.stream
        if stream not in home:
            common = [home[other] for other in home if other in fold.starts]
            home[stream] = common[0] if common and stream in fold.starts else stream
        news.setdefault(home[stream], []).append(contribution)
    waiting = tuple(sorted((*fold.waiting, *sightings), key=lambda each: each.key))
    islands = {key: replace(island, settings=settings) for key, island in fold.islands.items()}
    for key, taken in news.items():
        island = islands.get(key, Island(EMPTY_GRAPH, np.zeros(0), _new(0), _new(0), settings))
        graph, state = extended(island.graph, island.state, taken, fold.starts, settings.bias_sigma)
        age = np.concatenate([island.age, _new(len(taken))])
        island, waiting = _sighted(replace(island, graph=graph, state=state, age=age), waiting)
        islands[key] = iterated(island)
    grown = replace(
        fold,
        contributions=(*fold.contributions, *contributions),
        islands=islands,
        home=home,
        waiting=waiting,
    )
    return _with_merges(grown)


def _new(count: int) -> Int64[np.ndarray, " count"]:
    """The ages of so many new factors."""
    return np.zeros(count, dtype=np.int64)


def _sighted(island: Island, waiting: Sequence[Sighting]) -> tuple[Island, tuple[Sighting, ...]]:
    """The island with the sightings that it has both pose nodes of, and those that still wait."""
    candidates = [(each, met(island.graph, each)) for each in waiting]
    found = [between for _, between in candidates if between is not None]
    if not found:
        return island, tuple(waiting)
    graph = replace(island.graph, sightings=(*island.graph.sightings, *found))
    age = np.concatenate([island.sighting_age, _new(len(found))])
    left = tuple(each for each, between in candidates if between is None)
    return replace(island, graph=graph, sighting_age=age), left


def lean(fold: Fold) -> Fold:
    """The same fold without what can be computed again from it: a checkpoint to keep.

    It shares the submaps with the folds before and after it; its own are the state and the graph's
    nodes, a hundredth of what a fold holds that was solved.
    """
    islands = {
        key: replace(island, graph=replace(island.graph)) for key, island in fold.islands.items()
    }
    return replace(fold, islands=islands)


def converged(fold: Fold, settings: JoinSettings) -> Fold:
    """The full solution of every island; `iterations` and `change` tell how it ended."""
    islands, iterations, change = {}, 0, 0.0
    for key, island in fold.islands.items():
        islands[key], count, last = settled(replace(island, settings=settings))
        if key == fold.main_key:
            iterations, change = count, last
    return _with_merges(replace(fold, islands=islands, iterations=iterations, change=change))


def _check(fold: Fold, contributions: Sequence[Contribution]) -> None:
    for before, after in pairwise((*fold.contributions[-1:], *contributions)):
        if not before.key < after.key:
            raise NotCanonicalError(after)
    expected: dict[Stream, int] = {}
    for contribution in contributions:
        stream = contribution.stream
        wanted = expected.get(stream, fold.next_sequence(stream))
        if contribution.sequence != wanted:
            raise GapError(contribution, wanted)
        expected[stream] = wanted + 1


def _with_merges(fold: Fold) -> Fold:
    """Merge islands into the main one while any can be; each merge is followed by a solution."""
    main_key = fold.main_key
    reasons: dict[Stream, str] = {}
    for key in sorted(fold.islands, key=lambda key: min(fold.islands[key].graph.streams)):
        if main_key is None or key == main_key:
            continue
        main, other = fold.islands[main_key], fold.islands[key]
        tied = ties(main.graph, other.graph, fold.waiting)
        seen = sum(tie.seen is not None for tie in tied)
        what = alignment.Shared(len(tied) - seen, seen)
        found = aligned_by(main, other, tied)
        settings = main.settings
        why = alignment.refusal(what, found, settings.alignment_heading_sigma)
        if found is not None and why is None:
            merge = _merged(fold, main_key, key, found)
            rise = _cost(merge.main) - _cost(main) - _cost(other)
            why = alignment.disagreement(what, rise, settings.alignment_confidence)
            if why is None:
                return _with_merges(merge)
        frame = min(other.graph.streams)
        reasons[frame] = f"{named(frame)} not joined: {why}"
    return replace(fold, reasons=reasons)


def _cost(island: Island) -> float:
    """The cost with every robust scale at its end, so that islands can be compared."""
    return aged(island, FULL_AGE).cost


def _merged(fold: Fold, main_key: Stream, key: Stream, found: alignment.Alignment) -> Fold:
    main, other = fold.islands[main_key], fold.islands[key]
    graph, state = merged(main.graph, main.state, other.graph, other.state, found.a_from_b)
    ages = _new(len(graph.submaps)), _new(len(graph.sightings))
    both, waiting = _sighted(Island(graph, state, *ages, main.settings), fold.waiting)
    island, iterations, change = settled(both)
    islands = {at: each for at, each in fold.islands.items() if at != key}
    islands[main_key] = island
    home = {stream: main_key if at == key else at for stream, at in fold.home.items()}
    return replace(
        fold, islands=islands, home=home, waiting=waiting, iterations=iterations, change=change
    )
