"""The rule `join`: the team's map is a pure function of the set of submaps."""

from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np

from central.config import CentralConfig
from central.fused import JOINT_LANDMARKS, receivable
from central.monitor import NOTHING, finding, miscalibrations
from central.submap_set import Stream, SubmapSet
from central.tick_fold import TickFold
from team import translate
from team.estimation.map_joining import marginals
from team.estimation.map_joining.joining import Fold
from team.estimation.map_joining.refusal import refusals
from team.wire import channels as ch
from team.wire import messages as m
from team.wire.arrays import from_floats, from_ids
from team.wire.bus import Outgoing
from team.wire.codec import encoded, unsound

Tail = Literal["final", "closed", "provisional"]

PRIOR_LANDMARKS = 100
"""Landmarks in a robot's prior at the most: the nearest ones."""

NAMED = 10
"""Landmarks that are left out of the map, and refusals, are named up to so many."""


class JoinRule:
    """Keeps the set and its fold; gives the messages of a broadcast and of the end."""

    def __init__(self, config: CentralConfig, digest: bytes) -> None:
        self._config = config
        self._digest = digest
        self._set = SubmapSet()
        self._ticks = TickFold(config)
        self._starts: dict[Stream, m.Start] = {}
        self._entered: dict[Stream, int] = {}
        self._refusals: dict[Stream, set[int]] = {}
        self._broadcast_ns: int | None = None
        self._quiet_ns: int | None = None
        self._published: Mapping[Stream, int] = {}
        self._orders: set[str] = set()
        self.finding = NOTHING
        self.landmarks = 0
        self._announced: dict[str, str] = {}
        self.warnings: list[str] = []
        self.reasons: tuple[str, ...] = ()
        self.refused = 0
        self.not_folded = 0

    def take_start(self, start: m.Start) -> None:
        """A stream begins; its submaps wait for this."""
        if (start.robot, start.epoch) not in self._starts:
            self._starts[(start.robot, start.epoch)] = start
            value = translate.start_of(start)
            if value is not None:
                self._ticks.know_start(value)
            self._enter((start.robot, start.epoch))

    def take_submap(self, submap: m.Submap) -> int:
        """Admit a submap; how many of its stream have been dealt with."""
        stream = (submap.robot, submap.epoch)
        self._judge(submap, self._set.admit(submap))
        self._enter(stream)
        return self._dealt_with(stream, self._set.count(stream))

    def take_sighting(self, sighting: m.SightingFactor) -> int:
        """Admit a sighting; how many submaps of its stream have been dealt with."""
        stream = (sighting.robot, sighting.epoch)
        self._judge(sighting, self._set.admit_sighting(sighting))
        self._enter(stream)
        return self._dealt_with(stream, self._set.count(stream))

    def take_withdrawal(self, withdrawal: m.Withdrawal) -> None:
        """The team goes on without a robot; its submaps are still admitted, for whoever asks."""
        robot, known = withdrawal.robot, self.withdrawn
        self._ticks.withdraw(robot)
        self._orders.add(robot)
        if robot not in known:
            said = f"{robot} withdrawn by {withdrawal.by}: {withdrawal.reason}"
            self.warnings.append(said)

    @property
    def withdrawn(self) -> tuple[str, ...]:
        """The robots that the team goes on without, ascending."""
        return self._ticks.withdrawn

    def refuse(self, of: m.Submap | m.SightingFactor, why: str) -> int:
        """What raised is not in the map; how many of its stream have been dealt with."""
        self._judge(of, why)
        return self.count((of.robot, of.epoch))

    def _judge(self, of: m.Submap | m.SightingFactor, reason: str | None) -> None:
        """A refused submap, or one with a refused sighting, may never be in the map."""
        if reason is not None:
            self.refused += 1
            self.warnings.append(f"refused: {reason}")
            self._refusals.setdefault((of.robot, of.epoch), set()).add(of.sequence)

    def _dealt_with(self, stream: Stream, count: int) -> int:
        """`count`, unless the next one was refused: then nobody need wait for it.

        What follows the refused one can not enter the map; it counts as far as it has come.
        """
        refused = self._refusals.get(stream, set())
        if count not in refused:
            return count
        return max(*refused, *self._set.streams.get(stream, {}), count) + 1

    def _enter(self, stream: Stream) -> None:
        """Hand the fold what now is there without a gap."""
        if stream not in self._starts:
            return
        chain = self._set.chain(stream)
        for submap in chain[self._entered.get(stream, 0) :]:
            sightings = self._set.sightings(submap)
            named = translate.digest_of(encoded(submap), *(encoded(each) for each in sightings))
            self._ticks.add(submap, named, sightings)
        self._entered[stream] = len(chain)

    @property
    def streams(self) -> list[Stream]:
        """The streams that the set has submaps of."""
        return sorted(self._set.streams)

    def count(self, stream: Stream) -> int:
        """How many submaps of a stream are in the fold's reach, or will never be."""
        return self._dealt_with(stream, self._entered.get(stream, 0))

    def kept(self, robot: str) -> list[m.Message]:
        """Of each epoch of one robot, the latest first: start, submaps without a gap, sightings."""
        found: list[m.Message] = []
        for stream in sorted((s for s in self._set.streams if s[0] == robot), reverse=True):
            chain, start = self._set.chain(stream), self._starts.get(stream)
            if chain and start is not None:
                found += [start, *chain]
                found += [each for submap in chain for each in self._set.sightings(submap)]
        return found

    def advance(self, watermark_ns: float, newest_ns: int) -> list[Outgoing]:
        """Fold what the watermark allows; a broadcast when one is due."""
        self._ticks.take_until(watermark_ns)
        said = self._withdrawals(newest_ns)
        since = None if self._broadcast_ns is None else newest_ns - self._broadcast_ns
        due = since is None or since >= self._config.broadcast_s * 1e9
        if said or (due and self._lacks(self._published, watermark_ns)):
            return [*said, *self._broadcast(*self._newest(watermark_ns), newest_ns)]
        if not any(self._entered.values()):
            return []
        if self._quiet_ns is None:
            self._quiet_ns = newest_ns
        patience_s = 3.0 * max(self._config.broadcast_s, self._config.tick_s)
        if newest_ns - self._quiet_ns >= patience_s * 1e9:
            return self._broadcast(self._ticks.provisional(), "provisional", newest_ns)
        return []

    @property
    def _heard(self) -> int:
        """Submaps that are in the fold's reach, and robots that were withdrawn by an order."""
        return sum(self._entered.values()) + len(self._orders)

    def _lacks(self, members: Mapping[Stream, int], watermark_ns: float) -> bool:
        """Whether the watermark has passed a submap that is in reach and not among these."""
        gone = self._ticks.withdrawn
        following = ((s, members.get(s, -1) + 1) for s in self._entered if s[0] not in gone)
        return any(
            k < self._entered[s] and self._set.streams[s][k].stamp_ns <= watermark_ns
            for s, k in following
        )

    def _newest(self, watermark_ns: float) -> tuple[Fold, Tail]:
        """The fold over all that the watermark has passed; over all that is here if that is more.

        What a teammate has just closed is worth most to who sees the same landmarks, so it does not
        wait for the end of its tick.
        """
        closed = self._ticks.fold
        lacks = self._lacks(self._ticks.members(closed), watermark_ns)
        if self._has_all_that_was_published(closed) and not lacks:
            return closed, "closed"
        fold = self._ticks.provisional()
        ahead = any(each.end_ns > watermark_ns for each in fold.contributions[-1:])
        return fold, "provisional" if ahead else "closed"

    def _has_all_that_was_published(self, fold: Fold) -> bool:
        """Whether a map of this fold holds every submap of the last one: none steps back.

        What lies ahead of the watermark is in a provisional map and not yet in a closed one. A
        robot that was withdrawn since is in neither.
        """
        members = self._ticks.members(fold)
        return all(
            members.get(stream, -1) >= sequence
            for stream, sequence in self._published.items()
            if stream[0] not in self._ticks.withdrawn
        )

    def conclude(self, newest_ns: int) -> list[Outgoing]:
        """The final map: everything folded, solved until it stands still, with what it says."""
        fold = self._ticks.solved()
        return [*self._withdrawals(newest_ns), *self._broadcast(fold, "final", newest_ns)]

    def _withdrawals(self, now_ns: int) -> list[Outgoing]:
        """Whom the fold has convicted since this was asked last; what came late may acquit."""
        found = self._ticks.convicted
        for robot in sorted(self._announced.keys() - found.keys()):
            del self._announced[robot]
            self.warnings.append(f"{robot} is withdrawn no more: what came late speaks for it")
        new = [robot for robot in found if robot not in self._announced]
        self._announced |= found
        self.warnings += [f"{robot} withdrawn by central: {found[robot]}" for robot in new]
        return [
            Outgoing(ch.WITHDRAWAL, robot, m.Withdrawal(now_ns, robot, "central", found[robot]))
            for robot in new
        ]

    def retold(self, tail: Tail) -> list[Outgoing]:
        """What a map of everything that is here says, whatever the watermark: law 2, for reruns."""
        if tail == "final":
            return self._broadcast(self._ticks.solved(), tail, 0)
        self._ticks.take_until(float("inf"))
        return self._broadcast(self._ticks.fold, tail, 0)

    def _broadcast(self, fold: Fold, tail: Tail, now_ns: int) -> list[Outgoing]:
        self._broadcast_ns = self._quiet_ns = now_ns
        digest = self._ticks.digest(fold, self._digest, tail.encode())
        fused = self._fused(fold, tail, digest)
        self._published = self._ticks.members(fold)
        if tail == "final":
            out = [Outgoing(ch.TRAJECTORY, stream[0], t) for stream, t in self._paths(fold, digest)]
            return [*self._sound(out), Outgoing(ch.FINAL_MAP, "", receivable(fused))]
        out = self._priors(fold, digest, fused)
        return [Outgoing(ch.FUSED_MAP, "", receivable(fused)), *self._sound(out)]

    def _sound(self, out: Sequence[Outgoing]) -> list[Outgoing]:
        """What every receiver takes; the rest is withheld and named."""
        sound = []
        for each in out:
            why = unsound(each.message)
            if why is None:
                sound.append(each)
            else:
                self.warnings.append(f"withheld: {each.key}, {why}")
        return sound

    def _fused(self, fold: Fold, tail: Tail, digest: bytes) -> m.FusedMap:
        chi2 = dof = 0.0
        self.finding = NOTHING
        if fold.contributions:
            agreement = self._ticks.agreement(fold)
            chi2, dof = agreement.chi2, agreement.dof
            self.finding = finding(agreement, self._config.normal_scale)
        joint = False
        shown = self._shown(fold)
        if not fold.contributions:
            ids, means, covariance = np.empty(0, np.uint32), np.empty((0, 2)), b""
        elif tail == "final" and len(shown) <= JOINT_LANDMARKS:
            joint = True
            ids, means, matrix = marginals.landmark_map(fold, shown)
            covariance = translate.joint_bytes(matrix)
        else:
            ids, means, blocks = marginals.landmark_blocks(fold, shown)
            covariance = translate.block_bytes(blocks)
        self.landmarks = len(ids)
        self.not_folded = len(fold.refused) + len(fold.set_aside)
        biases = marginals.bias_estimates(fold)
        self.finding = self.finding.with_biases(biases)
        self.reasons = (
            *(fold.reasons[k] for k in sorted(fold.reasons)),
            *_worded(refusals(fold)),
            *fold.doubts,
            *self._unconfirmed(fold, shown),
            *miscalibrations(biases),
        )
        frame = fold.frame
        last_ns = fold.contributions[-1].end_ns if fold.contributions else 0
        return m.FusedMap(
            last_ns,
            "join",
            digest,
            "" if frame is None else f"{frame[0]}/{frame[1]}",
            tail == "final",
            tail == "provisional",
            0,
            tuple(m.Member(*s, n) for s, n in self._ticks.members(fold).items()),
            self._set.missing(),
            joint,
            from_ids(ids),
            from_floats(means),
            covariance,
            chi2,
            round(dof),
            self.reasons,
            tuple(m.BiasEstimate(*b.stream, b.bias, b.value, b.sigma) for b in biases),
            tuple(fold.joined[k] for k in sorted(fold.joined)),
            self._ticks.withdrawn,
            self.finding.figures.get("covariance_scale", 0.0),
            heard=self._heard,
        )

    def _shown(self, fold: Fold) -> list[int]:
        """The landmarks that the map has, by ascending id."""
        if not fold.contributions:
            return []
        return marginals.confirmed(fold, self._config.landmark_submaps)

    def _unconfirmed(self, fold: Fold, shown: Sequence[int]) -> tuple[str, ...]:
        """What is left out of the map, in words."""
        known = fold.main.graph.landmarks.keys() if fold.contributions else set[int]()
        out = sorted(known - set(shown))
        if not out:
            return ()
        named = ", ".join(str(id_) for id_ in out[:NAMED]) + (", …" if len(out) > NAMED else "")
        return (
            f"left out, {self._config.landmark_submaps} submaps that agree needed: "
            f"{len(out)} of {len(known)} landmarks ({named})",
        )

    def _priors(self, fold: Fold, digest: bytes, fused: m.FusedMap) -> list[Outgoing]:
        """For the latest stream of every robot that is in the team's frame."""
        if not fold.contributions:
            return []
        latest: dict[str, int] = {}
        for robot, epoch in fold.home:
            latest[robot] = max(latest.get(robot, 0), epoch)
        streams = [s for s in sorted(fold.main.graph.streams) if s[1] == latest[s[0]]]
        priors = marginals.main_priors(fold, streams, PRIOR_LANDMARKS, self._shown(fold))
        stamp_ns = fold.contributions[-1].end_ns
        out = []
        for stream, prior in priors.items():
            sequence = fold.next_sequence(stream) - 1
            message = translate.prior_message(
                stamp_ns, *stream, sequence, digest, prior, fused.members, fused.heard
            )
            out.append(Outgoing(ch.PRIOR, stream[0], message))
        return out

    def _paths(self, fold: Fold, digest: bytes) -> list[tuple[Stream, m.Trajectory]]:
        paths = []
        for robot, epoch in sorted(fold.home):
            if fold.home[(robot, epoch)] != fold.main_key:
                continue
            poses, covariances = marginals.trajectory(fold, robot, epoch)
            ends = [s.stamp_ns for s in self._set.chain((robot, epoch))][: len(poses)]
            message = translate.trajectory_message(
                ends[-1], robot, epoch, digest, ends, poses, covariances
            )
            paths.append(((robot, epoch), message))
        return paths


def _worded(words: Sequence[str]) -> tuple[str, ...]:
    """So many of them, and how many more there are."""
    more = len(words) - NAMED
    return (*words[:NAMED], *([f"{more} more refusals"] if more > 0 else []))
