"""The fold over the set of submaps in its canonical order, by ticks of team time.

Tick b has the submaps that end in (b·tick, (b + 1)·tick]. Behind the watermark every submap of a
tick has arrived, so the fold is final.

    add_submap, set_verdicts ──> FoldInputs ──tick──> fold_tick ──> Checkpoints
    (grow only)                    ^                      ^             │
                                   │ without the robot    └────fold─────┤
                                   └── Conviction <── agreement(fold) <─┘

A tick pushes a checkpoint; a late submap, a verdict or a withdrawal rolls back. A change of the
conviction, the robots that contradict the rest beyond chance (`teamslam.central.withdrawal`), folds
all ticks again. Agreement is tested after the first tick of each broadcast's time and after the
full solution. Running maps leave out (suspend) a robot with few submaps, until it has enough to be
withdrawn.

Old submaps are condensed before each tick (`condensing`), and restored by a tick that contradicts
them (`relinearising`) and by the full solution, which without landmark names folds the ticks again
with nothing condensed (but see FULL_UNNAMED).
"""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache

from teamslam.central import withdrawal
from teamslam.central.checkpoints import Checkpoints
from teamslam.central.config import CentralConfig
from teamslam.central.fold_inputs import FoldInputs
from teamslam.team.config import BIASES, MAP
from teamslam.team.estimation import contribution
from teamslam.team.estimation.association.landmark_sets import Verdict
from teamslam.team.estimation.map_joining import joining, marginals
from teamslam.team.estimation.map_joining.condensing import LIMITS, Limits
from teamslam.team.estimation.map_joining.continuity import Seam
from teamslam.team.estimation.map_joining.fold_association import recognise_moved
from teamslam.team.estimation.map_joining.gauss_newton import JoinSettings
from teamslam.team.estimation.map_joining.late_seams import find_late_seam
from teamslam.team.estimation.map_joining.marginals import Agreement
from teamslam.team.estimation.map_joining.relinearising import is_contradicted, is_due
from teamslam.team.estimation.map_joining.saved_maps import contradiction
from teamslam.team.estimation.map_joining.submap_graph import CommonBias
from teamslam.team.estimation.map_joining.tick import fold_tick
from teamslam.team.wire.messages import SightingFactor, Submap

COMMON: tuple[CommonBias, ...] = (*BIASES, "marker")
"""The biases that the whole team may have in common."""
GROWTH = 1.25  # growth of the set after which suspects are tested again
LATE_CUTS = 3  # most seams that the final map cuts beside those of running maps
FULL_UNNAMED = 1000
"""Most submaps without landmark names for which the full solution folds all ticks again, since the
ticks decide which observations are one landmark. With more, which would take hours, the full
solution starts from the running fold.
"""


def join_settings(config: CentralConfig) -> JoinSettings:
    """Return a centre's settings of the join."""
    return JoinSettings(
        iterations_per_tick=config.gauss_newton_per_tick,
        covariance_factor=config.covariance_factor,
        bias_sigma={bias: getattr(config.bias_sigma, bias) for bias in BIASES},
        common_bias_sigma={
            name: sigma
            for name in COMMON
            if (sigma := getattr(config.common_bias_sigma, name)) > 0.0
        },
        joined_ranges=config.joined_ranges,
        landmark_sigma=config.landmark_sigma,
        association=config.association,
    )


class TickFold:
    """Folds a set of submaps tick by tick.

    limits: for condensing; None: never. convicts: whether the fold withdraws robots. undecided:
    robots that contradict each other, in words.
    """

    def __init__(
        self,
        config: CentralConfig,
        limits: Limits | None = LIMITS,
        inputs: FoldInputs | None = None,
    ) -> None:
        self._config = config
        self._limits = limits
        self.inputs = FoldInputs(config) if inputs is None else inputs
        self._period = max(1, math.ceil(config.broadcast_s / config.tick_s))
        self.settings = join_settings(config)
        self.convicts = config.withdraw_above is not None
        self._tries = True
        self._ordered: frozenset[str] = frozenset()
        self.agreement = agreement = lru_cache(maxsize=1)(marginals.joint_cost)
        self.disagreement = lru_cache(maxsize=1)(
            lambda fold: withdrawal.disagreement(agreement(fold), least=1)
        )
        self._accused: Mapping[str, str] = {}
        self._others: dict[frozenset[str], TickFold] = {}
        self.undecided = ""
        self._restart(withdrawal.Conviction())

    def _restart(self, conviction: withdrawal.Conviction) -> None:
        self._conviction = conviction
        self._retried = 0.0
        self.checkpoints = Checkpoints()

    # Inputs.

    def add_start(self, start: contribution.InitialPoseFactor) -> None:
        """Add a stream's initial pose, before its submaps."""
        self.inputs.add_start(start)

    def add_submap(
        self,
        submap: Submap,
        digest: bytes,
        sightings: Sequence[SightingFactor] = (),
        own: contribution.OwnBiases = contribution.NO_OWN,
    ) -> None:
        """Add a submap with the inter-robot measurements from it; roll back to before its tick."""
        tick = self.inputs.add_submap(submap, digest, sightings, own)
        if submap.robot not in self._gone or tick <= self._conviction.at:
            self.roll_back(tick)
        else:
            self._roll_back_others(tick)

    def set_verdicts(self, verdicts: Collection[Verdict]) -> None:
        """Replace an operator's verdicts; fold the changed ticks again."""
        tick = self.inputs.set_verdicts(verdicts)
        if math.isfinite(tick):
            self._fold_again(tick)

    def withdraw_robot(self, robot: str) -> None:
        """Leave out a robot's submaps and the measurements of it, now and in future."""
        if robot not in self._ordered:
            self._fold_again(self.inputs.first_tick_of(robot), self._ordered | {robot})

    def _fold_again(self, tick: float, ordered: frozenset[str] | None = None) -> None:
        until_ns = self._until_ns
        if math.isfinite(tick):
            self.roll_back(tick)
        self._ordered = self._ordered if ordered is None else ordered
        self.fold_until(until_ns)

    def roll_back(self, tick: float) -> None:
        """Drop the ticks from this one on; all of them if a conviction is based on one."""
        if tick <= self._conviction.at:
            self._restart(withdrawal.Conviction())
        self.checkpoints.roll_back(tick)
        self._roll_back_others(tick)

    def _roll_back_others(self, tick: float) -> None:
        for other in self._others.values():
            other.roll_back(tick)

    # The fold of the closed ticks.

    @property
    def fold(self) -> joining.Fold:
        """The fold over all ticks so far."""
        return self.checkpoints.fold

    @property
    def convicted(self) -> Mapping[str, str]:
        """The robots withdrawn by the fold, with the reason."""
        return self._conviction.withdrawn

    @property
    def suspended(self) -> Mapping[str, str]:
        """Robots that running maps leave out, with the reason."""
        return {robot: each.reason for robot, each in self._conviction.suspended.items()}

    @property
    def _gone(self) -> frozenset[str]:
        return self._ordered.union(self._conviction.withdrawn, self._conviction.suspended)

    @property
    def withdrawn(self) -> tuple[str, ...]:
        """The withdrawn and suspended robots."""
        return tuple(sorted(self._gone))

    @property
    def _until_ns(self) -> float:
        return (self.checkpoints.tick + 1) * self.inputs.tick_ns

    def fold_until(self, watermark_ns: float) -> bool:
        """Fold every tick up to the watermark; return whether there was one."""
        folded = False
        while ticks := self._open_ticks(watermark_ns):
            folded = True
            for tick in ticks:
                if self._push_tick(tick):
                    break
        return folded

    def _open_ticks(self, watermark_ns: float = math.inf) -> list[int]:
        ticks = self.inputs.ticks_after(self.checkpoints.tick, self._gone)
        return [tick for tick in ticks if (tick + 1) * self.inputs.tick_ns <= watermark_ns]

    def _push_tick(self, tick: int) -> bool:
        before = self.checkpoints.tick
        fold = self._fold_tick(self.fold, tick)
        self.checkpoints.push(tick, fold)
        is_tested = math.isinf(before) or before // self._period < tick // self._period
        if not is_tested or tick < self._conviction.tested_from:
            return False
        if (robot := self._due_for_retrial(tick)) is not None:
            first = tick // self._period * self._period
            self._restart(self._conviction.acquit(robot, tick, first))
            return True
        return fold.size >= GROWTH * self.checkpoints.tested and self._convict(fold, tick)

    def _fold_tick(self, fold: joining.Fold, tick: int) -> joining.Fold:
        """Fold a tick, with condensed submaps restored if contradicted."""
        members = self.inputs.tick(tick, self._gone)
        size = fold.size
        if self._limits is None or size <= self._limits.begin:  # nothing is condensed yet
            return fold_tick(fold, members, self.settings)
        begin = self._limits.begin
        if fold.condensed_count and is_due(size, size + len(members.contributions), begin):
            fold = self.inputs.restore_submaps(fold, tick - 1, self._gone)
        fold = self.checkpoints.condense(fold, self._limits)
        after = fold_tick(fold, members, self.settings)
        if fold.condensed_count and is_contradicted(fold, after):
            raw = self.inputs.restore_submaps(fold, tick - 1, self._gone)
            after = after if raw.condensed_count else fold_tick(raw, members, self.settings)
        return after

    # The robot that contradicts the rest.

    def _due_for_retrial(self, tick: int) -> str | None:
        suspended = self._conviction.suspended
        if not suspended:
            return None
        size = self._size_until(tick)
        return next((r for r in sorted(suspended) if size >= suspended[r].retried), None)

    def _size_until(self, tick: float) -> int:
        gone = self._gone.difference(self._conviction.suspended)
        return len(self.inputs.keys(-math.inf, tick, gone))

    def _convict(self, fold: joining.Fold, at: float) -> bool:
        """Withdraw or suspend the robot that a trial finds; return whether there is one.

        at: the tick; infinity for the full solution, which suspends no robot. Only that reports a
        robot that contradicts a saved map, since landmarks may have moved.
        """
        self.undecided = ""
        if not self._tries and math.isfinite(at):
            return False
        wrong = contradiction(fold.main) if fold.contributions and fold.has_maps else None
        if wrong is not None and self.convicts:
            (author, _), reason = wrong
            self._restart(self._conviction.withdraw(author, reason, at))
            return True
        found = self._try_robots(fold, self._until_ns)
        if found is None:
            return False
        if fold is self.fold:
            self.checkpoints.note_tested(fold.size)
        has_map = any(each.startswith(MAP) for each in found.opposed)
        self.undecided = "" if has_map and math.isfinite(at) else found.undecided
        if found.robot is None or not self.convicts:
            return False
        own = sum(n + 1 for stream, n in self.members(fold).items() if stream[0] == found.robot)
        if math.isinf(at) or own >= withdrawal.LEAST_SUBMAPS:
            self._restart(self._conviction.withdraw(found.robot, found.reason, at))
        else:
            suspension = withdrawal.Suspension(found.reason, GROWTH * self._size_until(at))
            self._restart(self._conviction.suspend(found.robot, suspension, at))
        return True

    def _try_robots(self, fold: joining.Fold, until_ns: float) -> withdrawal.Trial | None:
        limit = self._config.withdraw_above
        if limit is None or not fold.contributions:
            return None
        if max(self.disagreement(fold).values(), default=0.0) <= limit:
            return None
        if not withdrawal.find_suspects(self.agreement(fold), limit):
            return None

        def without(robots: Collection[str]) -> Agreement | None:
            rest = self.leave_out(robots, until_ns).fold
            return self._agreement_at_rest(rest) if rest.home else None

        return withdrawal.hold_trial(self._agreement_at_rest(fold), limit, without)

    def _agreement_at_rest(self, fold: joining.Fold) -> Agreement:
        """Agreement of a raw fold's full solution, or of a condensed fold."""
        at_rest = fold if fold.condensed_count else joining.solve_fold(fold, self.settings)
        return marginals.joint_cost(at_rest)

    def leave_out(self, robots: Collection[str], until_ns: float) -> "TickFold":
        """Fold the same inputs without some robots; kept until no robot is suspected."""
        gone = self._gone.union(robots)
        other = self._others.get(gone)
        if other is None:
            other = self._others[gone] = self._fold_others(robots, -math.inf, self._limits)
        if math.isfinite(until_ns):
            other.checkpoints.roll_back(until_ns // self.inputs.tick_ns)
        other.fold_until(until_ns)
        return other

    def _fold_others(
        self,
        robots: Collection[str],
        until_ns: float,
        limits: Limits | None,
        cuts: tuple[Seam, ...] = (),
    ) -> "TickFold":
        other = TickFold(self._config, limits, self.inputs)
        other.checkpoints = Checkpoints(replace(joining.EMPTY_FOLD, cuts=cuts))
        other.convicts = other._tries = False
        other._ordered = self._gone.union(robots)
        other.fold_until(until_ns)
        return other

    def fold_apart(self, fold: joining.Fold, *, ahead: bool) -> Mapping[str, joining.Fold]:
        """Fold each robot's submaps by themselves where a robot's disagreement exceeds the limit
        times its disagreement alone (at least 1); a fold in another frame is empty.
        """
        limit = self._config.withdraw_above
        if limit is None or not fold.contributions:
            return {}
        together = self.disagreement(fold)
        if max(together.values(), default=0.0) <= limit:
            if not self.suspended:
                self._others.clear()
            return {}
        team = {robot for (robot, _), key in fold.home.items() if key == fold.main_key}
        folds: dict[str, joining.Fold] = {}
        alone: dict[str, float] = {}
        for robot in sorted(team):
            own = self.leave_out(self.inputs.robots - {robot}, self._until_ns)
            apart = own.fold_ahead() if ahead else own.fold
            if apart.contributions:
                alone.update(own.disagreement(apart))
            is_in_frame = apart.frame == fold.frame or apart.frame in fold.starts
            folds[robot] = apart if is_in_frame else joining.EMPTY_FOLD
        contradict = any(
            value > limit * max(1.0, alone.get(robot, 1.0)) for robot, value in together.items()
        )
        return folds if contradict and len(team) > 1 else {}

    # Solutions beyond the closed ticks.

    def fold_ahead(self) -> joining.Fold:
        """Return the fold of all inputs, provisional ones included."""
        fold = self.fold
        for tick in self._open_ticks():
            fold = self._fold_tick(fold, tick)
        return fold

    def accuse(self, provisional: joining.Fold) -> Mapping[str, str]:
        """Find the robot that contradicts the rest in a provisional fold, after each GROWTH."""
        if provisional is self.fold or not self.convicts:
            return {}
        if provisional.size >= self._retried:
            found = self._try_robots(provisional, math.inf)
            self._retried = 0.0 if found is None else GROWTH * provisional.size
            self._accused = (
                {} if found is None or found.robot is None else {found.robot: found.reason}
            )
        return {robot: why for robot, why in self._accused.items() if robot not in self._gone}

    def solve(self) -> joining.Fold:
        """Solve for all inputs in full, without the robots that are then withdrawn."""
        while True:
            self.fold_until(math.inf)
            if self.suspended:
                robot = min(self.suspended)
                self._restart(self._conviction.acquit(robot, math.inf, math.inf))
                self.fold_until(math.inf)
            fold = self._fold_raw()
            if not fold.contributions:
                return fold
            fold = self._solve_in_full(fold)
            if not self._convict(fold, math.inf) and not self.suspended:
                return self._cut_late(fold)

    def _solve_in_full(self, fold: joining.Fold) -> joining.Fold:
        """Solve in full, again with the unnamed landmarks that have moved since a saved map."""
        solved = joining.solve_fold(fold, self.settings)
        moved = recognise_moved(solved) if fold.has_unnamed and fold.has_maps else solved
        return solved if moved is solved else joining.solve_fold(moved, self.settings)

    def _cut_late(self, fold: joining.Fold) -> joining.Fold:
        """Fold again with the seams that only later submaps show (`late_seams`)."""
        for _ in range(LATE_CUTS):
            if not fold.has_unnamed or fold.condensed_count:
                break
            seam = find_late_seam(fold.main)
            if seam is None:
                break
            again = self._fold_others((), math.inf, None, (*fold.cuts, seam)).fold
            fold = self._solve_in_full(again)
        return fold

    def _fold_raw(self) -> joining.Fold:
        fold = self.fold
        if self._limits is None or fold.size <= self._limits.begin:
            return fold
        if not fold.has_unnamed or fold.size > FULL_UNNAMED:
            fold = self.inputs.restore_submaps(fold, math.inf, self._gone)
            if not fold.condensed_count:
                return fold
        return self._fold_others((), math.inf, None).fold

    def submaps_of_withdrawn(self) -> Mapping[str, Sequence[contribution.Contribution]]:
        """Return the submaps of each robot left out."""
        return {
            robot: [
                each for _, chain in sorted(self.inputs.chains(robot).items()) for each in chain
            ]
            for robot in self.withdrawn
        }

    def submaps_between_parts(
        self, fold: joining.Fold
    ) -> Mapping[Seam, Sequence[contribution.Contribution]]:
        """Return the submaps that each cut leaves out between the parts of its stream."""
        found = {}
        for cut in fold.cuts:
            if cut.after == cut.before + 1:
                continue
            stream = contribution.whole_of(cut.stream)
            chain = self.inputs.chains(stream[0]).get(stream, ())
            found[cut] = [each for each in chain if cut.before < each.sequence < cut.after]
        return found

    # The names of a fold.

    def digest(self, fold: joining.Fold, *more: bytes) -> bytes:
        """Digest the fold's set and `more`."""
        return self.inputs.digest(fold, more, self.checkpoints.tick, self._gone)

    def members(self, fold: joining.Fold) -> Mapping[contribution.Stream, int]:
        """Return the last sequence of each stream, folded or refused."""
        last: dict[contribution.Stream, int] = {}
        parts = [(stream, fold.next_sequence(stream) - 1) for stream in fold.home]
        parts += [(key[1:3], key[3]) for key in fold.refused]
        for part, sequence in parts:
            stream = contribution.whole_of(part)
            if not contribution.is_absolute(stream):
                last[stream] = max(last.get(stream, -1), sequence)
        return {stream: last[stream] for stream in sorted(last)}
