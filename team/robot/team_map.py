"""The robot's map given the team's: kept between its poses, made anew with each prior."""

from collections.abc import Sequence

from team import translate
from team.estimation.conditioning import Shared, followed, pose_now
from team.estimation.gaussian import PoseGaussian
from team.estimation.submap import LocalMap
from team.estimation.whole_map import WholeMap
from team.wire import messages as m


class TeamMap:
    """A pure function of the last prior and the robot's submaps, computed as far as it is new."""

    def __init__(self) -> None:
        self._prior: m.Prior | None = None
        self._submaps = 0
        self._whole: WholeMap | None = None
        self._shared = Shared()

    def pose(
        self, prior: m.Prior, submaps: Sequence[LocalMap], window: LocalMap | None
    ) -> PoseGaussian:
        """The robot's pose in the team's frame; `window`: the one in progress, if it has begun."""
        whole = self.given(prior, submaps)
        return pose_now(whole, None if window is None else self._shared.taken(window))

    def given(self, prior: m.Prior, submaps: Sequence[LocalMap]) -> WholeMap:
        """The prior times those of the epoch's submaps that are not in it."""
        if self._whole is None or prior is not self._prior:
            told, first = translate.prior_of(prior), prior.sequence + 1
            self._prior, self._shared, self._whole = prior, told.shared, told.whole
            self._submaps = first
        pending = submaps[self._submaps :]
        self._whole = followed(self._whole, (self._shared.taken(each) for each in pending))
        self._submaps += len(pending)  # the prior may have more than a robot that has come back
        return self._whole
