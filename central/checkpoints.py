"""The folds after the ticks that have been taken: few enough to keep, near enough to go back to."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

from team.estimation.map_joining.joining import EMPTY_FOLD, Fold, compacted

NEWEST = 4
"""Number of newest ticks whose checkpoints are all kept; of older ones as many for each doubling
of the age."""
NEAR = 4
"""Number of newest checkpoints that keep what their next tick is added to."""


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """The fold after a tick; tested: its number of submaps when suspects were last tested.

    number: of the ticks that were taken, this one included. raw: nothing was condensed in any of
    them. ahead: the same fold condensed, once it was asked for: a tick that is taken again, since
    more of it has come, is added to the same.
    """

    tick: int
    fold: Fold
    tested: int
    number: int
    raw: bool
    ahead: Fold | None = None


class Checkpoints:
    """A stack of checkpoints by tick: a tick is pushed, a late input pops those it is missing in.

    taken: the checkpoints, in the order of their ticks.
    """

    def __init__(self, taken: tuple[Checkpoint, ...] = ()) -> None:
        self.taken = taken

    @property
    def fold(self) -> Fold:
        """The fold over the ticks that have been taken."""
        return self.taken[-1].fold if self.taken else EMPTY_FOLD

    @property
    def tick(self) -> float:
        """The last tick that was taken; minus infinity if none was."""
        return self.taken[-1].tick if self.taken else -math.inf

    @property
    def tested(self) -> int:
        """Number of submaps in the fold when suspects were last tested; 0 if they never were."""
        return self.taken[-1].tested if self.taken else 0

    def push(self, tick: int, fold: Fold, *, is_raw: bool) -> None:
        """Add the fold after one more tick; older ones are compacted, and thinned by their age.

        is_raw: nothing was condensed for this tick.
        """
        *before, last = self.taken or (None,)
        number = 1 if last is None else last.number + 1
        new = Checkpoint(tick, fold, self.tested, number, self.is_raw and is_raw)
        older = () if last is None else (*before, _compacted(last))
        keep = thinned((*older, new))
        self.taken = (*(replace(each, ahead=None) for each in keep[:-NEAR]), *keep[-NEAR:])

    def ahead(self, fold: Fold, condense: Callable[[Fold], Fold]) -> Fold:
        """The condensed fold; that of a newest checkpoint is computed once."""
        *before, last = self.taken or (None,)
        if last is None or last.fold is not fold:
            return condense(fold)
        if last.ahead is not None:
            return last.ahead
        ahead = condense(fold)
        if ahead is not fold:
            self.taken = (*before, replace(last, ahead=ahead))
        return ahead

    def note_tested(self, size: int) -> None:
        """Note that suspects were tested in the last fold, which has this number of submaps."""
        self.taken = (*self.taken[:-1], replace(self.taken[-1], tested=size))

    def back_to(self, tick: float) -> None:
        """Drop the checkpoints from a tick on."""
        self.taken = tuple(each for each in self.taken if each.tick < tick)

    def raw(self) -> "Checkpoints":
        """The checkpoints before anything was condensed."""
        return Checkpoints(tuple(each for each in self.taken if each.raw))

    @property
    def is_raw(self) -> bool:
        """Whether nothing has been condensed yet."""
        return not self.taken or self.taken[-1].raw


def _compacted(checkpoint: Checkpoint) -> Checkpoint:
    ahead = None if checkpoint.ahead is None else compacted(checkpoint.ahead)
    return replace(checkpoint, fold=compacted(checkpoint.fold), ahead=ahead)


def thinned(taken: tuple[Checkpoint, ...]) -> tuple[Checkpoint, ...]:
    """The checkpoints to keep: the newest, then ever fewer, and the last one of a raw fold.

    Of those that are n to 2n ticks old two to four are kept: a late submap is folded from a
    checkpoint that is at most twice as old as it, and there are about twenty in all.
    """
    last = taken[-1].number
    raw = max((each.number for each in taken if each.raw), default=0)
    return tuple(
        each
        for each in taken
        if each.number == raw or each.number % _spacing(last - each.number) == 0
    )


def _spacing(age: int) -> int:
    return 1 << max(0, (age // NEWEST).bit_length())
