"""Map joining as in Downs' thesis: each robot joins its own submaps, the maps are aligned by SVD.

Sections 4.1 and 4.3. The first robot's initial pose fixes the frame.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from teamslam.central.config import CentralConfig
from teamslam.central.fused_map import fused_message, version_entry
from teamslam.central.join_messages import Tail
from teamslam.central.node import CentralNode
from teamslam.central.submap_fold import RecordedFields, SubmapFold
from teamslam.sim.studies.estimators import svd_joining
from teamslam.sim.studies.estimators.svd_joining import (
    NO_PAIRS,
    PointPairs,
    SubmapJoining,
    TooFewPointsError,
    Weighting,
)
from teamslam.team import core, translate
from teamslam.team.estimation import dense
from teamslam.team.estimation.contribution import named
from teamslam.team.estimation.gaussian import NO_LANDMARKS, UNSOLVABLE, LandmarkGaussian
from teamslam.team.estimation.plausibility import start_beyond, submap_beyond
from teamslam.team.estimation.se2 import Pose
from teamslam.team.estimation.submap import LocalMap
from teamslam.team.store import Stream, SubmapStore
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.bus import Outgoing
from teamslam.team.wire.codec import encoded
from teamslam.team.wire.digest import digest_of

NO_SIGHTINGS: Mapping[tuple[Stream, Stream], PointPairs] = MappingProxyType({})


@dataclass(frozen=True)
class _Joined:
    """Submaps of a stream so far. refused: the submap that ended the chain, with the reason."""

    count: int
    state: SubmapJoining
    digest: bytes
    refused: str = ""


class SvdFold(SubmapFold):
    """`svd-join` with the submaps' covariances, `svd-join-spherical` with the identity."""

    def __init__(
        self,
        config: CentralConfig,
        digest: bytes,
        store: SubmapStore | None = None,
        *,
        convicts: bool = True,
    ) -> None:
        super().__init__(config, digest, store, convicts=convicts)
        self._weighting: Weighting = "full" if config.fusion == "svd-join" else "identity"
        self._joined: dict[Stream, _Joined] = {}

    def fold_until(self, closed_ns: float) -> None:
        """Do nothing: each map is made of the whole set."""

    def make_map(
        self,
        tail: Tail,
        closed_ns: float = math.inf,
        *,
        ahead: bool = True,
        recorded: RecordedFields | None = None,
    ) -> list[Outgoing]:
        """Make the map, a function of the stored set."""
        channel = ch.FINAL_MAP if tail == "final" else ch.FUSED_MAP
        return [Outgoing(channel, "", self._fused(final=tail == "final"))]

    def _fused(self, *, final: bool) -> m.FusedMap:
        chains = self.store.chains
        if not chains:
            return fused_message(
                self.config,
                self.config_digest,
                NO_LANDMARKS,
                (),
                stamp_ns=0,
                final=final,
                frame="",
            )
        initial = {stream: self._believed(self.store.start(stream)) for stream in chains}
        joined = {s: self._extended(s, chains[s], initial[s], final) for s in chains}
        states = {s: x.state for s, x in joined.items() if x.state.fold.contributions}
        first = min(states or chains, key=lambda s: (initial[s] is None, s))
        maps = {s: svd_joining.landmark_gaussian(state) for s, state in states.items()}
        with np.errstate(all="ignore"):
            fused, reasons = align_maps(first, maps, full=self._weighting == "full")
        refused = tuple(x.refused for _, x in sorted(joined.items()) if x.refused)
        self.landmarks = len(fused.ids)
        return fused_message(
            self.config,
            digest_of(self.config_digest, *(joined[s].digest for s in sorted(joined))),
            fused,
            tuple(version_entry(stream, joined[stream].count - 1) for stream in sorted(joined)),
            stamp_ns=max(chain[-1].stamp_ns for chain in chains.values()),
            final=final,
            frame=f"{first[0]}/{first[1]}",
            reasons=(*reasons, *refused),
        )

    def _believed(self, message: m.InitialPose) -> Pose | None:
        start = translate.start_of(message)
        if start is None or start_beyond(start, self.config.bounds) is not None:
            return None
        return start.pose

    def _extended(
        self, stream: Stream, chain: Sequence[m.Submap], initial_pose: Pose | None, final: bool
    ) -> _Joined:
        """Extend the map of a stream's chain from its longest stored part.

        Running maps continue from the last solution; the final one is solved to convergence, with
        a search for other minima.
        """
        begin = svd_joining.initial_state(
            {stream[0]: np.zeros(3) if initial_pose is None else initial_pose}, self._weighting
        )
        before = self._joined.get(stream)
        if before is None or before.count > len(chain):
            before = _Joined(0, begin, self.config_digest)
        state, digest, refused = before.state, before.digest, before.refused
        for submap in chain[before.count :]:
            digest = digest_of(digest, encoded(submap))
            if not refused:
                local = translate.local_map_of(submap).without_nodes.without_biases
                why = submap_beyond(local, self.config.bounds)
                after = _join_with(state, stream[0], local) if why is None else None
                if after is None:
                    words = why or "with it the map has no solution"
                    refused = f"submap {submap.sequence} of {named(stream)} refused: {words}"
                else:
                    state = after
        self._joined[stream] = _Joined(len(chain), state, digest, refused)
        solution = _solution(state) if final else state
        return _Joined(len(chain), solution, digest, refused)


class SvdCentre(CentralNode):
    """The centre of `SvdFold`."""

    fold_class = SvdFold


def _join_with(state: SubmapJoining, robot: str, local: LocalMap) -> SubmapJoining | None:
    try:
        with np.errstate(all="ignore"):
            after = svd_joining.filter_step(state, robot, local)
            landmarks = svd_joining.landmark_gaussian(after)
    except UNSOLVABLE:
        return None
    finite = np.isfinite(landmarks.means).all() and np.isfinite(landmarks.covariance).all()
    return after if finite else None


def _solution(state: SubmapJoining) -> SubmapJoining:
    try:
        with np.errstate(all="ignore"):
            return svd_joining.solve(state)
    except UNSOLVABLE:
        return state


def align_maps(
    first: Stream,
    maps: Mapping[Stream, LandmarkGaussian],
    *,
    full: bool,
    sightings: Mapping[tuple[Stream, Stream], PointPairs] = NO_SIGHTINGS,
) -> tuple[LandmarkGaussian, tuple[str, ...]]:
    """Align greedily the map with the most landmarks in common.

    sightings: positions, in both maps, of robots that measured each other, by two streams in order;
    not with `full`. A map with too few common points is left out, with the reason.
    """
    fused = maps.get(first, NO_LANDMARKS)
    frames = {first: np.zeros(3)}
    waiting = {stream: maps[stream] for stream in sorted(maps) if stream != first}
    unsolvable: list[Stream] = []
    while waiting:
        seen = {s: _shared_points(s, frames, sightings) for s in waiting}
        shared = {
            s: len(np.intersect1d(fused.ids, x.ids)) + len(seen[s].in_a) for s, x in waiting.items()
        }
        stream = max(waiting, key=lambda s: shared[s])
        try:
            exchange = (
                svd_joining.exchange_maps_fully(fused, waiting[stream])
                if full
                else svd_joining.exchange_maps(fused, waiting[stream], seen[stream])
            )
        except TooFewPointsError:
            break
        except UNSOLVABLE:
            unsolvable.append(stream)
            del waiting[stream]
            continue
        fused = exchange.landmarks
        frames[stream] = exchange.a_from_b.mean
        del waiting[stream]
    reasons = [
        f"{named(stream)} not joined: its common landmarks give no place" for stream in unsolvable
    ]
    for stream, alone in waiting.items():
        count = len(np.intersect1d(fused.ids, alone.ids))
        plural = "" if count == 1 else "s"
        needed = f"{count} shared landmark{plural}, {svd_joining.NEEDED} needed"
        reasons.append(f"{named(stream)} not joined: {needed}")
    return fused, tuple(reasons)


def _shared_points(
    stream: Stream,
    frames: Mapping[Stream, Pose],
    sightings: Mapping[tuple[Stream, Stream], PointPairs],
) -> PointPairs:
    found = [NO_PAIRS]
    for other, frame in frames.items():
        pairs = sightings.get((min(stream, other), max(stream, other)))
        if pairs is not None:
            theirs, own = pairs if other < stream else (pairs.in_b, pairs.in_a)
            s, c = core.sin_and_cos(frame[2])
            found.append(
                PointPairs(dense.product(theirs, np.array([[c, s], [-s, c]])) + frame[:2], own)
            )
    return PointPairs(*(np.concatenate(each) for each in zip(*found, strict=True)))
