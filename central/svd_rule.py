"""Map joining as in Downs' thesis: each robot joins its own submaps, the maps are tied by SVD.

Every robot's submaps make one map by least squares in the frame of its own start (section 4.1). A
robot's map is then turned into the frame of the others' by a singular value decomposition over the
landmarks that both have, and the landmarks are joined (section 4.3). The start pose of the first
robot fixes the frame; what the others are told of theirs has no influence.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from central.config import CentralConfig
from central.fused import fused_message
from central.join_rule import JoinRule
from central.rules import NOTHING, MapEstimate
from central.submap_set import Stream
from team import translate
from team.estimation import svd_joining
from team.estimation.gaussian import LandmarkGaussian
from team.estimation.geometry import Pose
from team.estimation.svd_joining import (
    NO_PAIRS,
    PointPairs,
    SubmapJoining,
    TooFewPointsError,
    Weighting,
)
from team.wire import channels as ch
from team.wire import messages as m
from team.wire.bus import Outgoing
from team.wire.codec import encoded

NO_SIGHTINGS: Mapping[tuple[Stream, Stream], PointPairs] = MappingProxyType({})


@dataclass(frozen=True)
class _Joined:
    """The submaps of a stream so far: how many, their map, and the digest of what is in it."""

    count: int
    state: SubmapJoining
    digest: bytes


class SvdJoinRule(JoinRule):
    """The set of `join`, another map of it: `svd-join` with the submaps' covariances, and
    `svd-join-spherical` with Downs' identity instead of them.

    A later epoch of a robot is a stream of its own, in a frame of its own.
    """

    def __init__(self, config: CentralConfig, digest: bytes) -> None:
        super().__init__(config, digest)
        self._weighting: Weighting = "full" if config.fusion == "svd-join" else "identity"
        self._joined: dict[Stream, _Joined] = {}
        self._said_ns: int | None = None

    def advance(self, watermark_ns: float, newest_ns: int) -> list[Outgoing]:
        """A broadcast of what is here, when one is due; a later one may put any of it elsewhere."""
        since = None if self._said_ns is None else newest_ns - self._said_ns
        if since is not None and since < self._config.broadcast_s * 1e9:
            return []
        chains = self._chains()
        if not chains:
            return []
        self._said_ns = newest_ns
        return [Outgoing(ch.FUSED_MAP, "", self.retold_map(chains, final=False))]

    def conclude(self, newest_ns: int) -> list[Outgoing]:
        """The map of all submaps."""
        return [Outgoing(ch.FINAL_MAP, "", self.retold_map(self._chains(), final=True))]

    def _chains(self) -> dict[Stream, list[m.Submap]]:
        found = {s: self._set.chain(s) for s in self.streams if s in self._starts}
        return {stream: chain for stream, chain in found.items() if chain}

    def retold_map(self, chains: Mapping[Stream, Sequence[m.Submap]], *, final: bool) -> m.FusedMap:
        """The map of these submaps: a function of them and of the starts alone."""
        if not chains:
            return fused_message(
                self._config, self._digest, NOTHING, (), stamp_ns=0, final=final, frame=""
            )
        placed = [stream for stream in sorted(chains) if self._starts[stream].pose]
        first = placed[0] if placed else min(chains)
        joined = {stream: self._extended(stream, chains[stream], final) for stream in chains}
        maps = {s: svd_joining.landmark_gaussian(x.state) for s, x in joined.items()}
        fused, reasons = tied(first, maps, full=self._weighting == "full")
        self.landmarks = len(fused.ids)
        return fused_message(
            self._config,
            translate.digest_of(self._digest, *(joined[s].digest for s in sorted(joined))),
            MapEstimate(*fused),
            tuple(m.Member(*stream, joined[stream].count - 1) for stream in sorted(joined)),
            stamp_ns=max(chain[-1].stamp_ns for chain in chains.values()),
            final=final,
            frame=f"{first[0]}/{first[1]}",
            reasons=reasons,
        )

    def _extended(self, stream: Stream, chain: Sequence[m.Submap], final: bool) -> _Joined:
        """The map of a stream's chain, from the longest one that was made before.

        Running maps have the solution that each submap has moved on; the final one is solved to the
        end, wrong minima looked for.
        """
        told = translate.pose_of(self._starts[stream])[0]
        begin = svd_joining.begun(
            {stream[0]: np.zeros(3) if told is None else told}, self._weighting
        )
        before = self._joined.get(stream)
        if before is None or before.count > len(chain):
            before = _Joined(0, begin, self._digest)
        state, digest = before.state, before.digest
        for submap in chain[before.count :]:
            local = translate.local_map_of(submap).without_nodes
            state = svd_joining.stepped(state, stream[0], local)
            digest = translate.digest_of(digest, encoded(submap))
        self._joined[stream] = _Joined(len(chain), state, digest)
        return _Joined(len(chain), svd_joining.solved(state) if final else state, digest)


def tied(
    first: Stream,
    maps: Mapping[Stream, LandmarkGaussian],
    *,
    full: bool,
    sightings: Mapping[tuple[Stream, Stream], PointPairs] = NO_SIGHTINGS,
) -> tuple[LandmarkGaussian, tuple[str, ...]]:
    """The maps in the frame of the first, one by one: next who shares most with those that are in.

    sightings: by two streams in their order, the robots' own places in both maps where they saw
    each other (`mutual_sighting`); they tie beside the common landmarks, not with `full`. Who
    shares too few points stays out, with the reason.
    """
    fused = maps[first]
    frames = {first: np.zeros(3)}
    waiting = {stream: maps[stream] for stream in sorted(maps) if stream != first}
    while waiting:
        seen = {s: _seen(s, frames, sightings) for s in waiting}
        shared = {
            s: len(np.intersect1d(fused.ids, x.ids)) + len(seen[s].in_a) for s, x in waiting.items()
        }
        stream = max(waiting, key=lambda s: shared[s])
        try:
            exchange = (
                svd_joining.exchanged_fully(fused, waiting[stream])
                if full
                else svd_joining.exchanged(fused, waiting[stream], seen[stream])
            )
        except TooFewPointsError:
            break
        fused = exchange.landmarks
        frames[stream] = exchange.a_from_b.mean
        del waiting[stream]
    reasons = []
    for (robot, epoch), alone in waiting.items():
        count = len(np.intersect1d(fused.ids, alone.ids))
        plural = "" if count == 1 else "s"
        needed = f"{count} shared landmark{plural}, {svd_joining.NEEDED} needed"
        reasons.append(f"{robot}, epoch {epoch}, not joined: {needed}")
    return fused, tuple(reasons)


def _seen(
    stream: Stream,
    frames: Mapping[Stream, Pose],
    sightings: Mapping[tuple[Stream, Stream], PointPairs],
) -> PointPairs:
    """The points of a stream with all those in the map, in the map's frame and in its own."""
    found = [NO_PAIRS]
    for other, frame in frames.items():
        pairs = sightings.get((min(stream, other), max(stream, other)))
        if pairs is not None:
            theirs, own = pairs if other < stream else (pairs.in_b, pairs.in_a)
            c, s = np.cos(frame[2]), np.sin(frame[2])
            found.append(PointPairs(theirs @ np.array([[c, s], [-s, c]]) + frame[:2], own))
    return PointPairs(*(np.concatenate(each) for each in zip(*found, strict=True)))
