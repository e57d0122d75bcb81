"""The team's map as a fold over its submaps in their canonical order.

Joining minimises Σ ‖z − h(start pose, end pose, landmarks)‖² in the metric P⁻¹ over the submaps of
all robots, and over the inter-robot measurements between their pose nodes. A stream with an unknown
initial pose is an island until shared landmarks and inter-robot measurements tie it to another.
"""

import math
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import combinations, pairwise

import numpy as np

from teamslam.team.config import UNNAMED
from teamslam.team.estimation.association.landmark_sets import (
    NO_LANDMARKS,
    Landmarks,
    Opened,
    Verdict,
    add_landmarks,
)
from teamslam.team.estimation.contribution import (
    SURVEYED,
    Contribution,
    InitialPoseFactor,
    Key,
    Stream,
    first_of,
    is_map,
    moment,
    named,
    whole_of,
)
from teamslam.team.estimation.gaussian import UNSOLVABLE
from teamslam.team.estimation.inter_robot import InterRobotFactor, SightingKey
from teamslam.team.estimation.map_joining.continuity import Seam
from teamslam.team.estimation.map_joining.gauss_newton import (
    Island,
    JoinSettings,
    add_sightings,
    empty_island,
    extend_island,
    final_cost,
    is_solvable,
    is_suspicious,
    iterate_tick,
)
from teamslam.team.estimation.map_joining.landmark_view import wake_landmarks
from teamslam.team.estimation.map_joining.markers import add_markers, warn_of_unmarked
from teamslam.team.estimation.map_joining.merging import Merge, merge
from teamslam.team.estimation.map_joining.minima import (
    Minimum,
    Search,
    rival_distance,
    search_minima,
    warnings,
    widen_search,
)
from teamslam.team.estimation.map_joining.saved_maps import (
    FALSE_ALARM,
    SEQUENTIAL,
    dissociate,
    is_confirmed,
    maps_of,
    next_change,
    returned,
    reunite,
    separate,
)

NAMED = 10  # most robots named in the record of a merge
PATIENCE = 1.1  # growth in submaps after which a failed search is repeated


@dataclass(frozen=True)
class Tick:
    """The contents of one tick, in canonical order.

    starts: of the streams that begin. outside: reason for each submap refused in advance;
    set_aside: other refusals. verdicts: an operator's, on landmarks of submaps up to here.
    """

    contributions: Sequence[Contribution]
    sightings: Sequence[InterRobotFactor] = ()
    starts: Sequence[InitialPoseFactor] = ()
    outside: Mapping[Key, str] = field(default_factory=dict)
    set_aside: tuple[str, ...] = ()
    verdicts: tuple[Verdict, ...] = ()


@dataclass(frozen=True, eq=False)
class Audit:
    """A closure that may be undone: the fold before it, and the ticks since."""

    opened: Opened
    before: "Fold"
    ticks: tuple[Tick, ...]


@dataclass(frozen=True, eq=False)
class Fold:
    """The islands solved so far, and the bookkeeping of their submaps.

    home: island of each stream. reasons: why an island is not merged, by its frame. joined: each
    merge, by the former frame. warnings: signs of another minimum; rival_m: its distance [m], if
    about as likely. waiting: inter-robot measurements between two islands. judged: number of
    submaps of two islands at their last failed merge, and its reason; ambiguous: where several
    alignments passed; searched_at: at an island's last failed search for a lower minimum. refused:
    submaps not in the map, with the reason (`tick`); motion_only: those with their motion in the
    map; left_out: inter-robot measurements without a solution; set_aside: other refusals. audits:
    closures that may be undone (`tick`). cuts: seams that cut a stream (`continuity`).
    """

    contributions: tuple[Contribution, ...]
    starts: Mapping[Stream, InitialPoseFactor]
    islands: Mapping[Stream, Island]
    home: Mapping[Stream, Stream]
    reasons: Mapping[Stream, str]
    waiting: tuple[InterRobotFactor, ...] = ()
    joined: Mapping[Stream, str] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    rival_m: float | None = None
    judged: Mapping[tuple[Stream, Stream], tuple[int, str]] = field(default_factory=dict)
    searched_at: Mapping[Stream, int] = field(default_factory=dict)
    refused: Mapping[Key, str] = field(default_factory=dict)
    motion_only: frozenset[Key] = frozenset()
    left_out: frozenset[SightingKey] = frozenset()
    set_aside: tuple[str, ...] = ()
    landmarks: Landmarks = NO_LANDMARKS
    audits: tuple[Audit, ...] = ()
    ambiguous: Mapping[tuple[Stream, Stream], int] = field(default_factory=dict)
    cuts: tuple[Seam, ...] = ()

    @property
    def condensed_count(self) -> int:
        """Number of condensed submaps."""
        return self.size - len(self.contributions)

    @property
    def size(self) -> int:
        """Number of submaps, condensed ones included."""
        return sum(island.graph.size for island in self.islands.values())

    @property
    def has_maps(self) -> bool:
        """Whether the fold has a saved map, a survey or the station of fixes."""
        return any(is_map(stream) for stream in self.home)

    @property
    def has_unnamed(self) -> bool:
        """Whether any submap has an unnamed landmark."""
        return bool(self.landmarks.log.streams)

    @cached_property
    def main_key(self) -> Stream | None:
        """Key of the main island: with a known initial pose and a robot, else with a saved map and
        a robot, else with the smallest stream, of a robot if possible.
        """
        robots = sorted(stream for stream in self.home if not is_map(stream))
        placed = {self.home[robot] for robot in robots}
        started = sorted(s for s in self.home if s in self.starts and self.home[s] in placed)
        maps = sorted(s for s in self.home if is_map(s) and self.home[s] in placed)
        streams = started or maps or robots or sorted(self.home)
        return self.home[streams[0]] if streams else None

    @property
    def main(self) -> Island:
        """Island of the team's map. Raises KeyError before the first submap."""
        if self.main_key is None:
            raise KeyError("no submap has come yet")
        return self.islands[self.main_key]

    @property
    def frame(self) -> Stream | None:
        """The stream whose start fixes the main island's frame.

        The smallest with a known initial pose (all are in one frame), else with a saved map, else
        any; the survey's for a saved map with a known start.
        """
        if self.main_key is None:
            return None
        streams = self.main.graph.streams
        frame = _frame_of([stream for stream in streams if stream in self.starts] or streams)
        return SURVEYED if is_map(frame) and frame in self.starts else frame

    def island(self, robot: str, incarnation: int) -> Island:
        """Return the island of a stream. Raises KeyError."""
        return self.islands[self.home[(robot, incarnation)]]

    def next_sequence(self, stream: Stream) -> int:
        """Return the sequence number of a stream's next submap."""
        if stream not in self.home:
            return first_of(stream)
        return self.islands[self.home[stream]].graph.next_sequence(stream)

    def latest_part(self, stream: Stream) -> Stream:
        """Return the newest part of a stream that may be cut."""
        return max((each for each in self.home if whole_of(each) == stream), default=stream)


EMPTY_FOLD = Fold((), {}, {}, {}, {})


def add_start(fold: Fold, start: InitialPoseFactor) -> Fold:
    """Add a stream's initial pose; raises ValueError after its submaps."""
    if start.stream in fold.home:
        raise ValueError(
            f"the start of {named(start.stream)} comes after its first submap; "
            "fold again with the start known from the beginning"
        )
    return replace(fold, starts={**fold.starts, start.stream: start})


def fold_submaps(
    fold: Fold,
    contributions: Sequence[Contribution],
    settings: JoinSettings,
    sightings: Sequence[InterRobotFactor] = (),
) -> Fold:
    """Fold one tick: add the submaps, place new landmarks, iterate, and merge islands if possible.

    contributions: in canonical order without gaps, after all folded ones; else raises ValueError.
    sightings: from these submaps, each a factor once both of its nodes are in one island. Islands
    without new submaps keep their state.
    """
    _check_order(fold, contributions)
    home = dict(fold.home)
    arrived: dict[Stream, list[Contribution]] = {}
    for contribution in contributions:
        stream = contribution.stream
        if stream not in home:
            common = [home[other] for other in home if other in fold.starts]
            home[stream] = common[0] if common and stream in fold.starts else stream
        arrived.setdefault(home[stream], []).append(contribution)
    waiting = tuple(sorted((*fold.waiting, *sightings), key=lambda each: each.key))
    landmarks, numbers = fold.landmarks, dict[Key, list[int]]()
    if any((each.local.ids[-1:] >= UNNAMED).any() for each in contributions):
        landmarks, numbers = add_landmarks(fold.landmarks, contributions)
    islands = {key: replace(island, settings=settings) for key, island in fold.islands.items()}
    if fold.condensed_count:
        seen = {id_ for each in contributions for id_ in each.local.ids.tolist()}
        islands = {key: wake_landmarks(island, seen) for key, island in islands.items()}
    for key, taken in arrived.items():
        island = extend_island(
            islands.get(key) or empty_island(settings), taken, fold.starts, numbers
        )
        island, waiting = add_sightings(island, waiting)
        islands[key] = iterate_tick(island)
    grown = replace(
        fold,
        contributions=(*fold.contributions, *contributions),
        islands=islands,
        home=home,
        waiting=waiting,
        landmarks=landmarks,
    )
    merged = _merge_all(_search_suspicious(grown))
    return separate_moved(merged, SEQUENTIAL, contributions) if merged.has_maps else merged


def compact_fold(fold: Fold) -> Fold:
    """Drop the values of a fold that can be computed again, for a checkpoint."""
    islands = {
        key: replace(island, graph=replace(island.graph)) for key, island in fold.islands.items()
    }
    return replace(fold, islands=islands)


def solve_fold(fold: Fold, settings: JoinSettings) -> Fold:
    """Solve every island in full; one without a solution keeps its state."""
    if fold.main_key is None:
        return fold
    with np.errstate(all="ignore"):  # an overflow has no finite cost, and is not accepted
        return _solve_islands(fold, settings, fold.main_key)


def _solve_islands(fold: Fold, settings: JoinSettings, main_key: Stream) -> Fold:
    searches = {
        key: _search_island(add_markers(replace(island, settings=settings)))
        for key, island in fold.islands.items()
    }
    main = searches[main_key]
    islands = {key: each.best.island for key, each in searches.items()}
    merged = _merge_all(replace(fold, islands=islands), at_last=True)
    if merged.has_maps:
        merged = _test_saved_places(merged)
    last = main if merged.main is main.best.island else _search_island(merged.main)
    wider = None
    with suppress(*UNSOLVABLE):
        wider = widen_search(last)
    if wider is not None and is_solvable(wider.best.island):
        last = wider
    return replace(
        merged,
        islands={**merged.islands, merged.main_key or main_key: last.best.island},
        warnings=(*warnings(last), *warn_of_unmarked(last.best.island)),
        rival_m=rival_distance(last),
    )


def separate_moved(fold: Fold, chance: float, newest: Sequence[Contribution] | None = None) -> Fold:
    """Separate the landmarks that have moved since a saved map from their former places, the worst
    first. newest: submaps whose landmarks are tested; None: all.
    """
    islands = dict(fold.islands)
    for key, island in fold.islands.items():
        if not maps_of(island.graph):
            continue
        nodes = None
        if newest is not None:
            new = {id(each) for each in newest if not is_map(each.stream)}
            submaps = (s for s in island.graph.submaps if id(s.contribution) in new)
            nodes = {node for each in submaps for node in each.landmarks.tolist()}
        with suppress(*UNSOLVABLE):
            while (found := next_change(islands[key], chance, nodes)) is not None:
                saved, id_ = found[0], found[1].landmark
                if id_ < UNNAMED or is_confirmed(islands[key].graph, saved, id_):
                    apart = separate(islands[key], saved, [id_])
                else:
                    apart = dissociate(islands[key], saved, id_)
                islands[key] = iterate_tick(apart)
    return replace(fold, islands=islands)


def _test_saved_places(fold: Fold) -> Fold:
    islands = dict(fold.islands)
    for key, island in fold.islands.items():
        with suppress(*UNSOLVABLE):
            for stream, id_ in returned(island, FALSE_ALARM):
                islands[key] = iterate_tick(reunite(islands[key], stream, id_))
    return separate_moved(replace(fold, islands=islands), FALSE_ALARM)


def _search_island(island: Island) -> Search:
    with suppress(*UNSOLVABLE):
        found = search_minima([island])
        if is_solvable(found.best.island):
            return found
    return Search(Minimum(island, 0, math.inf, final_cost(island)), 0.0, None)


def _check_order(fold: Fold, contributions: Sequence[Contribution]) -> None:
    for before, after in pairwise((*fold.contributions[-1:], *contributions)):
        if not before.key < after.key:
            raise ValueError(
                f"submap {after.sequence} of {named(after.stream)} comes out of order; sort by "
                "(end stamp, robot, incarnation, sequence), for a late one fold again from before "
                "it"
            )
    expected: dict[Stream, int] = {}
    for each in contributions:
        sequence = expected.get(each.stream, fold.next_sequence(each.stream))
        if each.sequence != sequence:
            raise ValueError(
                f"{named(each.stream)}: submap {each.sequence} came, {sequence} is next"
            )
        expected[each.stream] = sequence + 1


def _merge_all(fold: Fold, at_last: bool = False) -> Fold:
    """Merge islands while possible; retry a failed pair when grown by PATIENCE, or `at_last`."""
    main_key = fold.main_key
    keys = sorted(fold.islands, key=lambda key: precedence(fold, key))
    reasons: dict[Stream, str] = {}
    judged = dict(fold.judged)
    for key, other_key in combinations(keys, 2):
        main, other = fold.islands[key], fold.islands[other_key]
        size = len(main.graph.submaps) + len(other.graph.submaps)
        before = judged.get((key, other_key))
        if before is None or at_last or size >= PATIENCE * before[0]:
            found = merge(main, other, fold.waiting)
            if isinstance(found, Merge):
                return _merge_all(
                    merge_islands(replace(fold, judged=judged), key, other_key, found)
                )
            why = found.why
            if found.after_search:
                judged[key, other_key] = (size, why)
        else:
            why = before[1]
        if main_key in (key, other_key):
            frame = min((other if key == main_key else main).graph.streams)
            reasons[frame] = f"{named(frame)} not joined: {why}"
    return replace(fold, reasons=reasons, judged=judged)


def precedence(fold: Fold, key: Stream) -> tuple[bool, bool, bool, Stream]:
    """Order islands by whose frame stays in a merge: with known initial poses, with a saved map,
    the main one, the smallest.
    """
    streams = fold.islands[key].graph.streams
    started, saved = any(s in fold.starts for s in streams), any(map(is_map, streams))
    return not started, not saved, key != fold.main_key, _frame_of(streams)


def _frame_of(streams: Collection[Stream]) -> Stream:
    return min(filter(is_map, streams), default=min(streams))


def merge_islands(fold: Fold, key: Stream, other_key: Stream, found: Merge) -> Fold:
    """Merge two islands; record the merge under the vanished frame."""
    islands = {at: each for at, each in fold.islands.items() if at != other_key}
    islands[key] = found.island
    streams = sorted(fold.islands[other_key].graph.streams)
    gone, into = streams[0], min(fold.islands[key].graph.streams)
    who = ", ".join(map(named, streams[:NAMED])) + ", …" * (len(streams) > NAMED)
    at = moment(max((each.end_ns for each in fold.contributions[-1:]), default=0))
    gone_keys = {key, other_key}
    return replace(
        fold,
        islands=islands,
        home={stream: key if at == other_key else at for stream, at in fold.home.items()},
        waiting=found.waiting,
        joined={**fold.joined, gone: f"{who} joined {named(into)} at {at}: {found.words}"},
        judged={pair: record for pair, record in fold.judged.items() if not gone_keys & {*pair}},
    )


def _search_suspicious(fold: Fold) -> Fold:
    islands, searched_at = dict(fold.islands), dict(fold.searched_at)
    for key, island in fold.islands.items():
        size = len(island.graph.submaps)
        if size < PATIENCE * searched_at.get(key, 0) or island.graph.condensed is not None:
            continue
        if not is_suspicious(island, final_cost(island)):
            continue
        searched_at[key] = size
        islands[key] = _search_island(island).best.island
    return replace(fold, islands=islands, searched_at=searched_at)
