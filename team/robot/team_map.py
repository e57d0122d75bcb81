"""The robot's map given the team's: kept between its poses, made anew with each prior."""

from collections.abc import Sequence

from team import translate
from team.estimation.conditioning import followed
from team.estimation.submap import LocalMap
from team.estimation.whole_map import WholeMap
from team.wire import messages as m


class TeamMap:
    """A pure function of the last prior and the robot's submaps, computed as far as it is new."""

    def __init__(self) -> None:
        self._prior: m.Prior | None = None
        self._submaps = 0
        self._whole: WholeMap | None = None

    def given(self, prior: m.Prior, submaps: Sequence[LocalMap]) -> WholeMap:
        """The prior times those of the epoch's submaps that are not in it."""
        if self._whole is None or prior is not self._prior:
            first = prior.sequence + 1
            self._whole = followed(translate.prior_of(prior).whole, submaps[first:])
            self._prior = prior
        else:
            self._whole = followed(self._whole, submaps[self._submaps :])
        self._submaps = len(submaps)
        return self._whole
