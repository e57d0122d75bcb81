"""A robot's pose in the team's map: the broadcast prior times the robot's own later submaps.

The prior (the joint marginal of the robot's last joined end pose and the landmarks) and the submaps
that are not in it are independent, so their product is exact, up to linearisation; what the centre
knows of the errors that all of a robot's submaps share is applied to them first. A landmark that
a submap sees where everything before contradicts it (a misread barcode) is left out of that submap,
for this pose only: nothing outlives the next prior, so nobody is locked out. The result is for
display and control; it never enters anything that the robot sends for fusion.
"""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, UInt32
from scipy.stats import chi2

from team.config import Bias
from team.estimation.gaussian import PoseGaussian
from team.estimation.submap import LocalMap
from team.estimation.whole_map import WholeMap, end_pose, joined

GATE = float(chi2.ppf(0.9999, 2))
"""χ² beyond which what a submap says of a landmark is taken for another landmark's: some twenty are
tested for each pose, and a good one that is left out costs little."""


class Shared(NamedTuple):
    """How the centre takes a robot's submaps: their covariances times a factor f, their biases.

    biases: of each error b that they share its name, the centre's estimate and its sigma.
    """

    covariance_factor: float = 1.0
    biases: tuple[tuple[Bias, float, float], ...] = ()

    def taken(self, local: LocalMap) -> LocalMap:
        """N(mean + Sᵀ b, f P + Sᵀ diag(σ²) S): a submap as the centre takes it, S its sensitivity.

        What is not known of b is taken as independent of the map; the map is correlated with it
        such that this is rather too much than too little. A bias that is not named is zero.
        """
        mean, covariance = local.mean, self.covariance_factor * local.covariance
        for name, value, sigma in self.biases:
            if name in local.biases:
                column = local.sensitivity[local.biases.index(name)]
                mean = mean + value * column
                covariance += sigma * sigma * np.outer(column, column)
        return LocalMap(local.ids, mean, covariance, local.node_stamps)


class RobotPrior(NamedTuple):
    """A robot's last joined end pose and landmarks: joint covariance of (x, y, θ, x₁, y₁, …).

    In the frame of the robot's island [m, rad]; ids ascending. A row of zeros is a known constant.
    shared: how the submaps that are in it were taken, and those that are not are to be.
    """

    pose: Float[np.ndarray, "3"]
    ids: UInt32[np.ndarray, " L"]
    means: Float[np.ndarray, "L 2"]
    covariance: Float[np.ndarray, "n n"]
    shared: Shared = Shared()

    @property
    def whole(self) -> WholeMap:
        """The same as a map."""
        return WholeMap(self.ids, np.concatenate([self.pose, self.means.ravel()]), self.covariance)


def followed(whole: WholeMap, pending: Iterable[LocalMap]) -> WholeMap:
    """A robot's map times its submaps behind the map's pose, in order.

    Of the team's prior and the submaps that are not in it: the robot's team map.
    """
    for local in pending:
        whole = joined(whole, local, GATE)
    return whole


def pose_now(whole: WholeMap, open_window: LocalMap | None) -> PoseGaussian:
    """N(pose, covariance) of the robot: a map's pose times the window in progress.

    Of the map only the marginal of the landmarks that the window sees is used, which is exact.
    """
    if open_window is None:
        return PoseGaussian(whole.mean[:3], whole.covariance[:3, :3])
    return end_pose(whole, open_window, GATE)
