"""The rule `join`: the team's map is a pure function of the set of submaps."""

from collections.abc import Mapping, Sequence

import msgspec
import numpy as np

from central.attendance import TeamAttendance
from central.fused import JOINT_LANDMARKS, receivable, version_entry
from central.monitor import NOTHING, finding, miscalibrations
from central.rule import Inputs, Stream, Tail
from central.sent_priors import SentPriors
from central.submap_rule import SubmapRule
from central.tick_fold import TickFold
from team import translate
from team.estimation.map_joining import marginals
from team.estimation.map_joining.association.landmarks import Decision
from team.estimation.map_joining.joining import Fold
from team.estimation.map_joining.refusal import refusals
from team.wire import channels as ch
from team.wire import messages as m
from team.wire.arrays import from_floats, from_ids
from team.wire.bus import Outgoing
from team.wire.codec import encoded, unsound

PRIOR_LANDMARKS = 30
"""Landmarks in a robot's prior at the most: the nearest ones."""

NAMED = 10
"""Landmarks that are left out of the map, and refusals, are named up to so many."""


class JoinRule(SubmapRule):
    """Keeps the fold of its set; gives the messages of a broadcast and of the end."""

    unnamed = ("missing", "heard")

    def reset(self) -> None:
        """Nothing is here."""
        super().reset()
        self._ticks = TickFold(self.config)
        self._quiet_ns: int | None = None
        self._sent_priors: SentPriors | None = SentPriors(PRIOR_LANDMARKS)
        self._published: Mapping[Stream, int] = {}
        self.finding = NOTHING
        self._announced: dict[str, str] = {}
        self.reasons: tuple[str, ...] = ()
        self.not_folded = 0

    def fuse(self, inputs: Inputs, tail: Tail) -> list[Outgoing]:
        """The map of a set of submaps: law 2; a set that grows keeps the fold that there is.

        Who was withdrawn is an input: nobody is judged again by a part of the set.
        """
        shrunk = any(len(inputs.submaps.get(s, ())) < n for s, n in self.entered.items())
        verdicts = {translate.verdict_of(each) for each in inputs.verdicts}
        if (
            shrunk
            or not self.orders <= inputs.withdrawals.keys()
            or not self._ticks.verdicts <= verdicts
        ):
            self.reset()
        self._ticks.convicts = False
        self._sent_priors = None  # every prior that a map may have brought
        for order in inputs.withdrawals.values():
            self.take_withdrawal(order)
        for verdict in sorted(verdicts):
            self._ticks.judge(verdict)
        for stream, submaps in sorted(inputs.submaps.items()):
            if stream in inputs.starts:
                self.take_start(inputs.starts[stream])
            for submap in submaps[self.entered.get(stream, 0) :]:
                for sighting in inputs.sightings.get((*stream, submap.sequence), ()):
                    self.take_sighting(sighting)
                self.take_submap(submap)
        if tail == "final":
            return self._broadcast(self._ticks.solved(), tail, 0)
        self._ticks.take_until(float("inf"))
        return self._broadcast(self._ticks.fold, tail, 0)

    def _began(self, start: m.InitialPose) -> None:
        value = translate.start_of(start)
        if value is not None:
            self._ticks.know_start(value)

    def _enters(self, submap: m.Submap, sightings: Sequence[m.SightingFactor]) -> None:
        named = translate.digest_of(encoded(submap), *(encoded(each) for each in sightings))
        self._ticks.add(submap, named, sightings)

    def _judges(self, verdict: m.Verdict) -> None:
        self._ticks.judge(translate.verdict_of(verdict.judgement), verdict.withdrawn)

    def _goes(self, robot: str) -> None:
        self._ticks.withdraw(robot)

    @property
    def withdrawn(self) -> tuple[str, ...]:
        """The robots that the team goes on without, by an order or by what the fold found."""
        return self._ticks.withdrawn

    @property
    def figures(self) -> Mapping[str, float]:
        """Refused submaps, and what the monitor has found."""
        return {"refused": float(self.refused + self.not_folded)} | self.finding.figures

    @property
    def findings(self) -> tuple[str, ...]:
        """The monitor's, and why robots are not joined or the map is to be doubted, in words."""
        unconfirmed = self.withdrawal_witnesses.unconfirmed(self.withdrawn)
        return (*self.finding.warnings, *self.reasons, *unconfirmed)

    def advance(self, attendance: TeamAttendance) -> list[Outgoing]:
        """A broadcast, when one is due."""
        watermark_ns = attendance.watermark_ns(self.dealt, self.count)
        return self.broadcasts(watermark_ns, attendance.now_ns)

    def refresh(self, attendance: TeamAttendance) -> list[Outgoing]:
        """A map with every submap that is here, if the last one lacks any.

        It waits for no tick's end and no teammate: what lies ahead of the watermark is provisional.
        """
        if not self._lacks(self._published, float("inf")):
            return []
        watermark_ns = attendance.watermark_ns(self.dealt, self.count)
        self._ticks.take_until(watermark_ns)
        fold = self._ticks.provisional()
        ahead = any(each.end_ns > watermark_ns for each in fold.contributions[-1:])
        tail: Tail = "provisional" if ahead else "closed"
        return [
            *self._withdrawals(attendance.now_ns),
            *self._broadcast(fold, tail, attendance.now_ns),
        ]

    def broadcasts(self, watermark_ns: float, newest_ns: int) -> list[Outgoing]:
        """Fold what the watermark allows; a broadcast when one is due."""
        self._ticks.take_until(watermark_ns)
        said = self._withdrawals(newest_ns)
        if said or (self.is_due(newest_ns) and self._lacks(self._published, watermark_ns)):
            return [*said, *self._broadcast(*self._newest(watermark_ns), newest_ns)]
        if not any(self.entered.values()):
            return []
        if self._quiet_ns is None:
            self._quiet_ns = newest_ns
        patience_s = 3.0 * max(self.config.broadcast_s, self.config.tick_s)
        if newest_ns - self._quiet_ns >= patience_s * 1e9:
            return self._broadcast(self._ticks.provisional(), "provisional", newest_ns)
        return []

    @property
    def _heard(self) -> int:
        """Submaps in the fold's reach, robots that were withdrawn by an order, and verdicts."""
        return sum(self.entered.values()) + len(self.orders) + self._ticks.judged

    def _lacks(self, members: Mapping[Stream, int], watermark_ns: float) -> bool:
        """Whether the watermark has passed a submap that is in reach and not among these."""
        gone = self._ticks.withdrawn
        following = ((s, members.get(s, -1) + 1) for s in self.entered if s[0] not in gone)
        return any(
            k < self.entered[s] and self.members.streams[s][k].stamp_ns <= watermark_ns
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
            Outgoing(
                ch.WITHDRAWAL,
                robot,
                m.Withdrawal(stamp_ns=now_ns, robot=robot, by="central", reason=found[robot]),
            )
            for robot in new
        ]

    def _broadcast(self, fold: Fold, tail: Tail, now_ns: int) -> list[Outgoing]:
        self.broadcast_ns = self._quiet_ns = now_ns
        digest = self._ticks.digest(fold, self.config_digest, tail.encode())
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
            self.finding = finding(agreement, self.config.normal_scale)
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
            *fold.warnings,
            *_worded([_awaited(each) for each in _waiting(fold)]),
            *self._unconfirmed(fold, shown),
            *miscalibrations(biases),
        )
        frame = fold.frame
        last_ns = fold.contributions[-1].end_ns if fold.contributions else 0
        return m.FusedMap(
            stamp_ns=last_ns,
            rule="join",
            digest=digest,
            frame="" if frame is None else f"{frame[0]}/{frame[1]}",
            final=tail == "final",
            provisional=tail == "provisional",
            exchange=0,
            members=tuple(version_entry(*each) for each in self._ticks.members(fold).items()),
            missing=self.members.missing(),
            joint=joint,
            ids=from_ids(ids),
            means=from_floats(means),
            covariance=covariance,
            chi2=chi2,
            dof=round(dof),
            reasons=self.reasons,
            biases=tuple(
                m.BiasEstimate(
                    robot=b.stream[0],
                    incarnation=b.stream[1],
                    bias=b.bias,
                    value=b.value,
                    sigma=b.sigma,
                )
                for b in biases
            ),
            joined=tuple(fold.joined[k] for k in sorted(fold.joined)),
            withdrawn=self._ticks.withdrawn,
            covariance_scale=self.finding.figures.get("covariance_scale", 0.0),
            heard=self._heard,
            memberships=translate.memberships_of(fold.landmarks),
            decisions=translate.decisions_of(fold.landmarks),
            verdicts=tuple(translate.judgement_of(v) for v in fold.landmarks.verdicts),
        )

    def _shown(self, fold: Fold) -> list[int]:
        """The landmarks that the map has, by ascending id."""
        if not fold.contributions:
            return []
        return marginals.confirmed(fold, self.config.landmark_submaps)

    def _unconfirmed(self, fold: Fold, shown: Sequence[int]) -> tuple[str, ...]:
        """What is left out of the map, in words."""
        known = fold.main.graph.landmarks.keys() if fold.contributions else set[int]()
        out = sorted(known - set(shown))
        if not out:
            return ()
        named = ", ".join(str(id_) for id_ in out[:NAMED]) + (", …" if len(out) > NAMED else "")
        return (
            f"left out, {self.config.landmark_submaps} submaps that agree needed: "
            f"{len(out)} of {len(known)} landmarks ({named})",
        )

    def _priors(self, fold: Fold, digest: bytes, fused: m.FusedMap) -> list[Outgoing]:
        """For the latest stream of every robot that is in the team's frame, if it has news."""
        if not fold.contributions:
            return []
        latest: dict[str, int] = {}
        for robot, incarnation in fold.home:
            latest[robot] = max(latest.get(robot, 0), incarnation)
        streams = [s for s in sorted(fold.main.graph.streams) if s[1] == latest[s[0]]]
        shown = self._shown(fold)
        if self._sent_priors is not None:
            blocks = marginals.landmark_blocks(fold, shown)
            poses = ((each, marginals.last_pose(fold, each)) for each in streams)
            streams = [
                each for each, pose in poses if self._sent_priors.is_worth(each, pose, blocks)
            ]
        if not streams:
            return []
        priors = marginals.main_priors(fold, streams, PRIOR_LANDMARKS, shown)
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
        for robot, incarnation in sorted(fold.home):
            if fold.home[(robot, incarnation)] != fold.main_key:
                continue
            found = marginals.trajectory(fold, robot, incarnation)
            poses, covariances = found.poses, found.covariances
            ends = [s.stamp_ns for s in self.members.chain((robot, incarnation))][: len(poses)]
            message = translate.trajectory_message(
                ends[-1], robot, incarnation, digest, ends, poses, covariances
            )
            with_start = msgspec.structs.replace(
                message,
                start=from_floats(found.start),
                start_covariance=from_floats(found.start_covariance),
                crosses=from_floats(found.crosses),
            )
            paths.append(((robot, incarnation), with_start))
        return paths


def _waiting(fold: Fold) -> list[Decision]:
    """Merges of robots by their maps that wait, by whom they are about."""
    waits = fold.landmarks.waits
    return [waits[of] for of in sorted(waits) if of[1] in fold.islands and of[0] != of[1]]


def _awaited(decision: Decision) -> str:
    return f"{decision.about} not joined by their maps: {decision.why}"


def _worded(words: Sequence[str]) -> tuple[str, ...]:
    """So many of them, and how many more there are."""
    more = len(words) - NAMED
    return (*words[:NAMED], *([f"{more} more refusals"] if more > 0 else []))
