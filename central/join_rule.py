"""The rule `join`: the team's map is a pure function of the set of submaps."""

import math
from collections.abc import Collection, Mapping, Sequence

from central.config import CentralConfig
from central.fused import receivable
from central.join_messages import (
    PRIOR_LANDMARKS,
    priors,
    reasons,
    shown_landmarks,
    team_map,
    trajectories,
)
from central.monitor import NOTHING, finding
from central.rule import FusionRule, Tail
from central.sent_priors import SentPriors
from central.submap_intake import SubmapInputs, SubmapIntake
from central.tick_fold import TickFold
from team import translate
from team.estimation.contribution import Stream
from team.estimation.map_joining import marginals
from team.estimation.map_joining.joining import Fold
from team.wire import channels as ch
from team.wire import messages as m
from team.wire.bus import Outgoing
from team.wire.codec import encoded, unsound
from team.wire.digest import digest_of


class JoinRule(FusionRule[SubmapInputs]):
    """Keeps the fold of a growing set; a set that lacks folded submaps is folded anew.

    finding: of the monitor, on the newest map. reasons: why robots are not joined, and warnings
    about the map.
    """

    intake = SubmapIntake

    def __init__(self, config: CentralConfig, digest: bytes, robots: Sequence[str] = ()) -> None:
        super().__init__(config, digest, robots)
        self._sent_priors = SentPriors(PRIOR_LANDMARKS)
        self.finding = NOTHING
        self.reasons: tuple[str, ...] = ()
        self._begin()

    def _begin(self) -> None:
        self._ticks = TickFold(self.config)
        self._filed: dict[Stream, int] = {}
        self._source: Mapping[Stream, object] | None = None
        self._seen = 0
        self._gone: set[str] = set()
        self._accused: Mapping[str, str] = {}

    def take(self, inputs: SubmapInputs) -> list[Outgoing]:
        """Fold the ticks that are closed."""
        self._file(inputs)
        self._ticks.fold_until(inputs.closed_ns)
        return []

    def fuse(self, inputs: SubmapInputs, tail: Tail) -> list[Outgoing]:
        """The map of a set of submaps: law 2. The final one is solved until it stands still."""
        self._file(inputs)
        ticks, self._accused = self._ticks, {}
        if tail == "final":
            return self._messages(inputs, ticks, ticks.solve(), tail)
        ticks.fold_until(inputs.closed_ns)
        fold = ticks.fold
        if inputs.ahead:
            fold = ticks.fold_ahead()
            self._accused = ticks.accuse(fold)
        if self._accused:
            ticks = ticks.leave_out(self._accused, math.inf)
            fold = ticks.fold
        return self._messages(inputs, ticks, fold, tail)

    def _file(self, inputs: SubmapInputs) -> None:
        """File the new submaps by tick; ticks that were folded already are folded again with
        them.
        """
        submaps, ticks = inputs.submaps, self._ticks
        known = submaps is self._source  # it has only grown
        if not self._gone.issubset(inputs.withdrawn) or (
            not known
            and any(len(submaps.get(stream, ())) < filed for stream, filed in self._filed.items())
        ):
            self._begin()
            ticks, known = self._ticks, False
        reached = inputs.reached[self._seen :] if known else submaps
        ticks.convicts = ticks.convicts and not inputs.recorded
        for robot in sorted({*inputs.withdrawn} - self._gone):
            ticks.withdraw_robot(robot)
            self._gone.add(robot)
        ticks.set_verdicts(inputs.verdicts)
        for stream in sorted(set(reached)):
            chain = submaps[stream]
            filed = self._filed.get(stream, 0)
            if not filed and chain:
                start = translate.start_of(inputs.starts[stream])
                if start is not None:
                    ticks.add_start(start)
            for submap in chain[filed:]:
                sightings = inputs.sightings(submap)
                messages = (submap, *sightings)
                ticks.add_submap(submap, digest_of(*map(encoded, messages)), sightings)
                self._filed[stream] = submap.sequence + 1
        if inputs.reached:
            self._source, self._seen = submaps, len(inputs.reached)

    @property
    def convicted(self) -> Mapping[str, str]:
        """The robots that the fold has withdrawn."""
        return self._ticks.convicted

    @property
    def suspended(self) -> Mapping[str, str]:
        """The robots that the newest map leaves out until they are tested again."""
        return {**self._ticks.suspended, **self._accused}

    @property
    def figures(self) -> Mapping[str, float]:
        """The monitor's figures."""
        return self.finding.figures

    @property
    def findings(self) -> tuple[str, ...]:
        """The monitor's warnings, why robots are not joined, and warnings about the map, in
        words.
        """
        apart = (
            f"{robot} is left out of running maps: {why}"
            for robot, why in sorted(self.suspended.items())
        )
        least_m, least_rad = self.config.least_sigma
        raised = (
            f"{robot}: {count} submaps claim to be surer than {least_m:g} m and {least_rad:g} rad; "
            "taken as no surer than that"
            for robot, count in self._ticks.raised.items()
        )
        undecided = (self._ticks.undecided,) if self._ticks.undecided else ()
        return (*self.finding.warnings, *apart, *undecided, *raised, *self.reasons)

    def _messages(
        self, inputs: SubmapInputs, ticks: TickFold, fold: Fold, tail: Tail
    ) -> list[Outgoing]:
        """The messages of a fold: the map, with priors or, at the end, the whole paths."""
        final = tail == "final"
        digest = ticks.digest(fold, self.config_digest, tail.encode())
        agreement = ticks.agreement(fold) if fold.contributions else None
        biases = marginals.bias_estimates(fold)
        found = (
            NOTHING
            if agreement is None
            else finding(agreement, self.config.normal_scale, final=final)
        )
        self.finding = found.with_biases(biases)
        shown = shown_landmarks(fold, self.config, tail)
        self.reasons = (
            *(map(str, ticks.find_carried_off(fold)) if final else ()),
            *reasons(fold, shown, biases, self.config.landmark_submaps, final=final),
        )
        fused = team_map(
            fold,
            tail,
            shown.ids,
            digest=digest,
            members=ticks.members(fold),
            withdrawn=ticks.withdrawn,
            missing=inputs.missing,
            arrived=inputs.arrived,
            cost=(0.0, 0.0) if agreement is None else (agreement.chi2, agreement.dof),
            covariance_scale=self.finding.figures.get("covariance_scale", 0.0),
            biases=biases,
            reasons=self.findings if final else self.reasons,
        )
        self.landmarks = len(shown.ids)
        self.not_folded = len(fold.refused) + len(fold.set_aside)
        requested = self._requested(inputs, fold, fused, shown.ids)
        of_robots = self._sound(priors(fold, shown.ids, fused, requested))
        if final:
            paths = self._sound(trajectories(fold, digest, inputs.submaps))
            return [*of_robots, *paths, Outgoing(ch.FINAL_MAP, "", receivable(fused))]
        return [Outgoing(ch.FUSED_MAP, "", receivable(fused)), *of_robots]

    def _requested(
        self, inputs: SubmapInputs, fold: Fold, fused: m.FusedMap, shown: Sequence[int]
    ) -> Collection[Stream]:
        """The streams whose priors go out with a map: of each robot the latest one, if there is
        news for it.
        """
        if inputs.recorded:
            return inputs.priors_of
        gone = {s for s, chain in inputs.submaps.items() if chain and s[0] in fused.withdrawn}
        latest: dict[str, int] = {}
        for robot, incarnation in {(x.robot, x.incarnation) for x in fused.members} | gone:
            latest[robot] = max(latest.get(robot, 0), incarnation)
        streams = sorted(latest.items())
        if fused.final:
            return self._sent_priors.void(fold, streams)
        return self._sent_priors.worth(fold, streams, shown)

    def _sound(self, out: Sequence[Outgoing]) -> list[Outgoing]:
        """The messages that every receiver accepts; others are withheld and named."""
        sound = []
        for each in out:
            why = unsound(each.message)
            if why is None:
                sound.append(each)
            else:
                self.warnings.append(f"withheld: {each.key}, {why}")
        return sound
