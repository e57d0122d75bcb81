"""The folds after single ticks: few enough to keep, near enough to go back to."""

import math
from dataclasses import dataclass, replace

from team.estimation.map_joining.condensing import Limits, condense_submaps
from team.estimation.map_joining.joining import EMPTY_FOLD, Fold, compacted

NEWEST = 4
"""Number of newest ticks whose checkpoints are all kept; of older ones as many for each doubling
of the age."""
NEAR = 4
"""Number of newest checkpoints that keep what their next tick is added to."""


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """The fold after a tick.

    tested: its number of submaps when suspects were last tested. number: of the ticks that were
    folded, this one included. ahead: the same fold condensed, once it was asked for: if more of the
    next tick arrives, that tick is folded again from the same.
    """

    tick: int
    fold: Fold
    tested: int
    number: int
    ahead: Fold | None = None


class Checkpoints:
    """A stack of checkpoints by tick: a tick is pushed, a late input pops those that lack it.

    kept: the checkpoints, in the order of their ticks.
    """

    def __init__(self) -> None:
        self.kept: tuple[Checkpoint, ...] = ()

    @property
    def fold(self) -> Fold:
        """The fold over all ticks so far."""
        return self.kept[-1].fold if self.kept else EMPTY_FOLD

    @property
    def tick(self) -> float:
        """The last tick that was folded; minus infinity if none was."""
        return self.kept[-1].tick if self.kept else -math.inf

    @property
    def tested(self) -> int:
        """Number of submaps in the fold when suspects were last tested; 0 if they never were."""
        return self.kept[-1].tested if self.kept else 0

    def push(self, tick: int, fold: Fold) -> None:
        """Add the fold after one more tick; older ones are compacted, and thinned by their age."""
        *before, last = self.kept or (None,)
        number = 1 if last is None else last.number + 1
        older = () if last is None else (*before, _compacted(last))
        keep = thinned((*older, Checkpoint(tick, fold, self.tested, number)))
        self.kept = (*(replace(each, ahead=None) for each in keep[:-NEAR]), *keep[-NEAR:])

    def condense(self, fold: Fold, limits: Limits) -> Fold:
        """Condense a fold; that of the newest checkpoint is condensed once."""
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
        """Note that suspects were tested in the last fold, which has this number of submaps."""
        self.kept = (*self.kept[:-1], replace(self.kept[-1], tested=size))

    def roll_back(self, tick: float) -> None:
        """Drop the checkpoints from a tick on."""
        self.kept = tuple(each for each in self.kept if each.tick < tick)


def _compacted(checkpoint: Checkpoint) -> Checkpoint:
    ahead = None if checkpoint.ahead is None else compacted(checkpoint.ahead)
    return replace(checkpoint, fold=compacted(checkpoint.fold), ahead=ahead)


def thinned(kept: tuple[Checkpoint, ...]) -> tuple[Checkpoint, ...]:
    """Return the checkpoints to keep: the newest, then ever fewer.

    Of those that are n to 2n ticks old two to four are kept: a late submap is folded from a
    checkpoint that is at most twice as old as it, and there are about twenty in all.
    """
    last = kept[-1].number
    return tuple(each for each in kept if each.number % _spacing(last - each.number) == 0)


def _spacing(age: int) -> int:
    return 1 << max(0, (age // NEWEST).bit_length())
