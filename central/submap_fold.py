"""The fold of the stored set, and the messages of a map: the map itself, priors and paths.

The map is a pure function of the set (law 2).
"""

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import NamedTuple

from teamslam.central import join_messages, localising, unnamed_landmarks
from teamslam.central.config import CentralConfig
from teamslam.central.diagnosis import describe, diagnose, mark_places, widening
from teamslam.central.fused_map import JOINT_LANDMARKS, receivable, version_entry
from teamslam.central.monitor import monitor_figures
from teamslam.central.saved_maps import (
    NothingToSaveError,
    describe_repetition,
    landmark_changes,
    save_map,
)
from teamslam.central.sent_priors import SentPriors
from teamslam.central.survey import datum_of
from teamslam.central.tick_fold import TickFold
from teamslam.team import translate
from teamslam.team.config import MAP
from teamslam.team.estimation.contribution import NO_OWN, is_map, whole_of
from teamslam.team.estimation.map_joining import marginals
from teamslam.team.estimation.map_joining.joining import Fold
from teamslam.team.store import Stream, SubmapStore
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.bus import Outgoing
from teamslam.team.wire.codec import encoded, find_error
from teamslam.team.wire.digest import digest_of


class RecordedFields(NamedTuple):
    """The fields of a recorded map and priors that do not follow from its set."""

    missing: tuple[m.VersionEntry, ...]
    arrived: int
    priors_of: Collection[Stream]


class SubmapFold:
    """Fold the stored set tick by tick and make the messages of its maps.

    convicts: False for a recorded set. landmarks, figures, diagnosis, reasons: of the newest map.
    not_folded: number of refused inputs.
    """

    def __init__(
        self,
        config: CentralConfig,
        digest: bytes,
        store: SubmapStore | None = None,
        *,
        convicts: bool = True,
    ) -> None:
        self.config = config
        self.config_digest = digest
        self.store = SubmapStore() if store is None else store
        self.warnings: list[str] = []
        self.landmarks = 0
        self.not_folded = 0
        self.figures: Mapping[str, float] = {}
        self.diagnosis: tuple[m.Diagnosis, ...] = ()
        self.reasons: tuple[str, ...] = ()
        self._ticks = TickFold(config)
        self._ticks.convicts = self._ticks.convicts and convicts
        self._filed: dict[Stream, int] = {}
        self._judged = 0
        self._accused: Mapping[str, str] = {}
        self._apart: Mapping[str, Fold] = {}
        self._sent_priors = SentPriors(join_messages.PRIOR_LANDMARKS)
        self._final: tuple[Fold, m.FusedMap] | None = None

    def fold_until(self, closed_ns: float) -> None:
        """Fold the ticks that end at this time or before."""
        self._file_members()
        self._ticks.fold_until(closed_ns)

    def make_map(
        self,
        tail: join_messages.Tail,
        closed_ns: float = math.inf,
        *,
        ahead: bool = True,
        recorded: RecordedFields | None = None,
    ) -> list[Outgoing]:
        """Make a map of the stored set and the messages that accompany it: the final one, or one of
        the ticks up to `closed_ns` and, with `ahead`, all later ones.
        """
        self._file_members()
        ticks, self._accused = self._ticks, {}
        if tail == "final":
            self._apart = {}
            return self._messages(ticks, ticks.solve(), tail, recorded)
        ticks.fold_until(closed_ns)
        fold = ticks.fold
        if ahead:
            fold = ticks.fold_ahead()
            self._accused = ticks.accuse(fold)
        if self._accused:
            ticks = ticks.leave_out(self._accused, math.inf)
            fold = ticks.fold
        self._apart = ticks.fold_apart(fold, ahead=ahead)
        return self._messages(ticks, fold, tail, recorded)

    def save_map(self, name: str) -> m.SavedMap:
        """Save the final map, the last one made; raises NothingToSaveError."""
        if self.config.localise:
            raise NothingToSaveError("a team that is localised in a saved map makes no map")
        if self._final is None or not self._final[0].contributions:
            raise NothingToSaveError("there is no final map with a landmark")
        before = {saved.author: saved for saved in self.store.maps.values()}
        fold, fused = self._final
        main = (stream for stream, key in fold.home.items() if key == fold.main_key)
        streams = sorted({whole_of(stream) for stream in main if not is_map(stream)})
        if not streams:
            raise NothingToSaveError("no robot has a submap in the final map")
        repetitions = [*self._repetitions()]
        if repetitions:
            raise NothingToSaveError("; ".join(repetitions))
        firsts = list(map(self._digest_first, streams))
        datum = datum_of(self.config, fused, before.values())
        return save_map(fold, fused, name, before, firsts, datum)

    def _digest_first(self, stream: Stream) -> bytes:
        return digest_of(encoded(self.store.chains[stream][0]))

    def _file_members(self) -> None:
        store, ticks = self.store, self._ticks
        for robot in sorted(store.withdrawals):
            ticks.withdraw_robot(robot)
        if store.judged != self._judged:
            self._judged = store.judged
            ticks.set_verdicts({unnamed_landmarks.verdict_of(each) for each in store.verdicts})
        chains = store.chains
        for stream in sorted(
            s for s, chain in chains.items() if len(chain) > self._filed.get(s, 0)
        ):
            filed, localises = self._filed.get(stream, 0), self.config.localise
            start, own = translate.start_of(store.start(stream)), NO_OWN
            saved = store.maps.get(stream[0].removeprefix(MAP)) if is_map(stream) else None
            if saved is not None:
                own = translate.own_biases_of(saved)
            if start is not None and not filed and not localises:
                ticks.add_start(start)
            for submap in chains[stream][filed:]:
                sightings = store.sightings(submap)
                named = (submap, saved) if own.errors and saved else (submap, *sightings)
                digest = digest_of(*map(encoded, named))
                taken = localising.restricted(submap, store.maps.values()) if localises else submap
                ticks.add_submap(taken, digest, sightings, own)
                self._filed[stream] = submap.sequence + 1

    @property
    def convicted(self) -> Mapping[str, str]:
        """The robots withdrawn by the fold, with the reason."""
        return self._ticks.convicted

    @property
    def suspended(self) -> Mapping[str, str]:
        """Robots left out of the newest map until tested again."""
        return {**self._ticks.suspended, **self._accused}

    @property
    def findings(self) -> tuple[str, ...]:
        """Causes of misfit, reasons and warnings about the map."""
        return (*map(describe, self.diagnosis), *self._warnings)

    @property
    def _warnings(self) -> tuple[str, ...]:
        suspended = (
            f"{robot} is left out of running maps: {why}"
            for robot, why in sorted(self.suspended.items())
        )
        least_m, least_rad = self.config.least_sigma
        raised = (
            f"{robot}: {count} submaps claim to be surer than {least_m:g} m and {least_rad:g} rad; "
            "taken as no surer than that"
            for robot, count in self._ticks.inputs.raised(self._ticks.withdrawn).items()
        )
        undecided = [self._ticks.undecided] if self._ticks.undecided else []
        if self._apart:
            undecided.append(
                f"{', '.join(self._apart)} contradict each other: until it is determined which of "
                "them is wrong, each one's prior is made of its own submaps"
            )
        return (*suspended, *undecided, *self._repetitions(), *raised, *self.reasons)

    def _repetitions(self) -> Iterator[str]:
        """Describe the robots whose measurements count twice, by a saved map."""
        gone, chains = self._ticks.withdrawn, self.store.chains
        maps = [saved for saved in self.store.maps.values() if saved.author not in gone]
        robots = [s for s in sorted(chains) if maps and not is_map(s) and s[0] not in gone]
        firsts = {stream: self._digest_first(stream) for stream in robots}
        for saved in maps:
            for robot in sorted({s[0] for s, first in firsts.items() if first in saved.sets}):
                yield describe_repetition(robot, saved)

    def _messages(
        self, ticks: TickFold, fold: Fold, tail: join_messages.Tail, recorded: RecordedFields | None
    ) -> list[Outgoing]:
        final = tail == "final"
        digest = ticks.digest(fold, self.config_digest, tail.encode())
        agreement = ticks.agreement(fold) if fold.contributions else None
        biases = marginals.bias_estimates(fold)
        judged = agreement
        if final and agreement is not None:
            judged = marginals.with_unbounded_costs(agreement, fold)
        figures = self.figures = monitor_figures(judged, biases, self.config.normal_scale)
        scale = max(figures.get(name, 1.0) for name in ("covariance_scale", "joint_cost_per_dof"))
        members = ticks.members(fold)
        if self.config.localise:
            fold = localising.in_saved_map(fold)
        shown = join_messages.shown_landmarks(fold, self.config, tail)
        withdrawn = ticks.submaps_of_withdrawn()
        self.diagnosis = diagnose(
            fold,
            biases,
            withdrawn,
            self.config.normal_scale,
            scale,
            final=final,
            spoilt=ticks.submaps_between_parts(fold),
            localise=self.config.localise,
        )
        self.reasons = join_messages.reasons(
            fold,
            shown,
            biases,
            self.config.landmark_submaps,
            is_explained=any(each.cause != "noise_overestimated" for each in self.diagnosis),
        )
        if final and not self.config.localise:
            fold = marginals.widen_covariances(fold, widening(self.diagnosis))
            biases = marginals.bias_estimates(fold)
        self.diagnosis = mark_places(self.diagnosis, fold)
        joint = final and len(shown.ids) <= JOINT_LANDMARKS and bool(fold.contributions)
        ids, means, covariance = join_messages.encoded_landmarks(fold, shown.ids, joint=joint)
        store, left_out = self.store, [x for each in withdrawn.values() for x in each]
        last_of = {x.stream: x.sequence for x in left_out}
        fused = m.FusedMap(
            stamp_ns=fold.contributions[-1].end_ns if fold.contributions else 0,
            rule="join",
            digest=digest,
            frame="" if fold.frame is None else translate.frame_name(*fold.frame),
            final=final,
            provisional=tail == "provisional",
            exchange=0,
            members=tuple(version_entry(*each) for each in members.items()),
            missing=store.missing() if recorded is None else recorded.missing,
            joint=joint,
            ids=ids,
            means=means,
            covariance=covariance,
            chi2=0.0 if agreement is None else agreement.chi2,
            dof=0 if agreement is None else round(agreement.dof),
            reasons=self._warnings if final else self.reasons,
            diagnosis=self.diagnosis,
            left_out=tuple(version_entry(*each) for each in last_of.items()),
            biases=tuple(
                m.BiasEstimate(
                    robot=b.stream[0],
                    incarnation=whole_of(b.stream)[1],
                    bias=b.bias,
                    value=b.value,
                    sigma=b.sigma,
                )
                for b in biases
                if b.stream == fold.latest_part(whole_of(b.stream))
            ),
            joined=tuple(fold.joined[k] for k in sorted(fold.joined)),
            withdrawn=ticks.withdrawn,
            covariance_scale=figures.get("covariance_scale", 0.0),
            heard=store.arrived if recorded is None else recorded.arrived,
            memberships=unnamed_landmarks.memberships_of(fold.landmarks, final)
            if fold.has_unnamed
            else (),
            decisions=unnamed_landmarks.decisions_of(fold.landmarks) if fold.has_unnamed else (),
            verdicts=tuple(map(unnamed_landmarks.judgement_of, fold.landmarks.verdicts)),
            changes=landmark_changes(fold, shown.ids) if final else (),
        )
        if self.config.localise and (saved := min(store.maps.items(), default=None)) is not None:
            fused = localising.saved_landmarks(fused, saved[1])
        self._final = (fold, fused) if final else None
        self.landmarks = len(shown.ids)
        self.not_folded = len(fold.refused) + len(fold.set_aside)
        of_robots = self._receivable(self._priors(fold, fused, shown.ids, recorded))
        if final:
            paths = self._receivable(join_messages.trajectories(fold, digest, store.chains))
            return [*of_robots, *paths, Outgoing(ch.FINAL_MAP, "", receivable(fused))]
        return [Outgoing(ch.FUSED_MAP, "", receivable(fused)), *of_robots]

    def _priors(
        self,
        fold: Fold,
        fused: m.FusedMap,
        shown: Sequence[int],
        recorded: RecordedFields | None,
    ) -> list[Outgoing]:
        """Make the priors with news, or the recorded ones; while robots contradict each other, of
        their own fold.
        """
        streams = self._latest_streams(fused) if recorded is None else sorted(recorded.priors_of)
        together = [each for each in streams if each[0] not in self._apart]
        seekers = [s for s in together if fold.has_maps and localising.seeks_saved_map(fold, s)]
        parts = [(fold, shown, [each for each in together if each not in seekers])]
        others = [
            (own, [s for s in streams if s[0] == robot]) for robot, own in self._apart.items()
        ]
        if seekers:
            others.append((localising.in_saved_map(fold), seekers))
        for of, requested in others:
            ids = join_messages.shown_landmarks(of, self.config, "closed").ids
            parts.append((of, ids, requested))
        out = []
        for of, ids, requested in parts:
            if recorded is None:
                requested = self._select_with_news(of, ids, fused, requested)
            out += join_messages.priors(of, ids, fused, requested)
        return out

    def _select_with_news(
        self, fold: Fold, shown: Sequence[int], fused: m.FusedMap, streams: Sequence[Stream]
    ) -> list[Stream]:
        if fused.final:
            return self._sent_priors.select_void(fold, streams)
        alone = [s for s in streams if join_messages.gets_landmarks_alone(fold, shown, fused, s)]
        return self._sent_priors.select_worth(fold, streams, shown, alone)

    def _latest_streams(self, fused: m.FusedMap) -> list[Stream]:
        withdrawn = {stream for stream in self.store.chains if stream[0] in fused.withdrawn}
        latest: dict[str, int] = {}
        joined = {(x.robot, x.incarnation) for x in fused.members}
        for robot, incarnation in joined | withdrawn | self.store.newcomers:
            if is_map((robot, incarnation)):
                continue
            latest[robot] = max(latest.get(robot, 0), incarnation)
        return sorted(latest.items())

    def _receivable(self, out: Sequence[Outgoing]) -> list[Outgoing]:
        """Withhold messages that some receiver would refuse, with a warning."""
        accepted = []
        for each in out:
            why = find_error(each.message)
            if why is None:
                accepted.append(each)
            else:
                self.warnings.append(f"withheld: {each.key}, {why}")
        return accepted
