"""Checkpoints of the fold after single ticks, thinned by age."""

import math
from dataclasses import dataclass, replace

from teamslam.team.estimation.map_joining.condensing import Limits, condense_submaps
from teamslam.team.estimation.map_joining.joining import EMPTY_FOLD, Fold, compact_fold

NEWEST = 4
"""Number of newest ticks whose checkpoints are all kept; of older ones as many per doubling of
age."""
NEAR = 2
"""Number of newest checkpoints that keep their condensed fold, and all that they have computed."""


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """The fold after a tick.

    tested: number of submaps at the last test of suspects. number: of folded ticks. ahead: the same
    fold condensed, for the next tick.
    """

    tick: int
    fold: Fold
    tested: int
    number: int
    ahead: Fold | None = None


class Checkpoints:
    """A stack of checkpoints by tick; empty: the fold before all, which may have cuts."""

    def __init__(self, empty: Fold = EMPTY_FOLD) -> None:
        self.kept: tuple[Checkpoint, ...] = ()
        self._empty = empty

    @property
    def fold(self) -> Fold:
        """The fold over all ticks so far."""
        return self.kept[-1].fold if self.kept else self._empty

    @property
    def tick(self) -> float:
        """The last folded tick; minus infinity if none."""
        return self.kept[-1].tick if self.kept else -math.inf

    @property
    def tested(self) -> int:
        """Number of submaps when suspects were last tested; 0 if never."""
        return self.kept[-1].tested if self.kept else 0

    def push(self, tick: int, fold: Fold) -> None:
        """Push the fold after a tick; compact older ones and thin them by age."""
        number = self.kept[-1].number + 1 if self.kept else 1
        keep = (*self.kept, Checkpoint(tick, fold, self.tested, number))
        gone_by = map(_compacted, keep[-NEAR - 1 : -NEAR])
        self.kept = thinned((*keep[: -NEAR - 1], *gone_by, *keep[-NEAR:]))

    def condense(self, fold: Fold, limits: Limits) -> Fold:
        """Condense a fold, the newest checkpoint's once."""
        *before, last = self.kept or (None,)
        if last is None or last.fold is not fold:
            return condense_submaps(fold, limits)
        if last.ahead is not None:
            return last.ahead
        ahead = condense_submaps(fold, limits)
        if ahead is not fold:
            self.kept = (*before, replace(last, ahead=ahead))
        return ahead

    def note_tested(self, size: int) -> None:
        """Note that suspects were tested in the last fold."""
        self.kept = (*self.kept[:-1], replace(self.kept[-1], tested=size))

    def roll_back(self, tick: float) -> None:
        """Drop the checkpoints from a tick on."""
        self.kept = tuple(each for each in self.kept if each.tick < tick)


def _compacted(checkpoint: Checkpoint) -> Checkpoint:
    return replace(checkpoint, fold=compact_fold(checkpoint.fold), ahead=None)


def thinned(kept: tuple[Checkpoint, ...]) -> tuple[Checkpoint, ...]:
    """Select two to four of the checkpoints that are n to 2n ticks old: about twenty."""
    last = kept[-1].number
    return tuple(each for each in kept if each.number % _spacing(last - each.number) == 0)


def _spacing(age: int) -> int:
    return 1 << max(0, (age // NEWEST).bit_length())
