"""The robot's maps: its own, joined submap by submap (Brooks and Bailey's back end), and the
team's, computed anew with each prior.

No submap depends on the own map, which omits landmarks without identities: only the team's fold
associates them across submaps.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from teamslam.team import core, translate
from teamslam.team.core import WholeMap
from teamslam.team.estimation import se2
from teamslam.team.estimation.gaussian import (
    UNSOLVABLE,
    LandmarkGaussian,
    Matrix,
    NotACovarianceError,
    PoseGaussian,
    curved,
)
from teamslam.team.estimation.hybrid_slam.fastslam import Particles
from teamslam.team.estimation.hybrid_slam.window import RunningWindow
from teamslam.team.estimation.map_joining.conditioning import (
    Followed,
    Posed,
    RobotPrior,
    SubmapCorrection,
    compose_pose,
    initial_map,
    is_majority,
    join_pending,
    join_submap,
)
from teamslam.team.estimation.submap import LocalMap
from teamslam.team.shapes import Float
from teamslam.team.wire import messages as m

CLOUD_PARTICLES = 32  # particles in a cloud for viewers


class InitialPose(NamedTuple):
    """A stream's first pose (None: unknown) and its covariance (None: exact)."""

    pose: Float[np.ndarray, "3"] | None
    covariance: Matrix | None


AT_ORIGIN = InitialPose(np.zeros(3), None)


class Cloud(NamedTuple):
    """Thinned particles in the own map's frame: P poses and their normalised weights."""

    poses: Float[np.ndarray, "P 3"]
    weights: Float[np.ndarray, " P"]


def thin_out(particles: Particles, origin: Float[np.ndarray, "3"]) -> Cloud:
    """Thin out the particles evenly; origin: their frame's pose in the own map."""
    every = max(1, -(-len(particles.poses) // CLOUD_PARTICLES))
    logs = particles.log_weights[::every]
    weights = core.exp(logs - logs.max())
    poses = np.ascontiguousarray(particles.poses[::every])
    return Cloud(se2.compose(origin, poses), weights / weights.sum())


class OwnMap:
    """The join of a robot's submaps so far, from its initial pose.

    origin: pose at which the last joined submap begins.
    """

    def __init__(self, initial: InitialPose = AT_ORIGIN) -> None:
        self.origin = np.zeros(3) if initial.pose is None else initial.pose
        self.whole: WholeMap = initial_map(self.origin, initial.covariance)

    def join(self, local: LocalMap) -> None:
        """Join the next submap, or its motion alone if it contradicts the map numerically."""
        self.origin, _ = self.whole.pose()
        named = local.named
        try:
            after = join_submap(self.whole, named)
        except NotACovarianceError:
            after = None
        if after is None or not after.has_sound_landmarks:
            after = join_submap(self.whole, named.motion)
        self.whole = after

    def pose(self, window: RunningWindow | None) -> PoseGaussian:
        """Estimate the pose after the open window, or after its motion alone if contradictory."""
        try:
            return compose_pose(self.whole, None if window is None else window.map).pose
        except UNSOLVABLE:
            return compose_pose(self.whole, None if window is None else window.motion).pose

    @property
    def landmarks(self) -> LandmarkGaussian:
        """Landmarks of the map."""
        whole = self.whole
        return LandmarkGaussian(whole.ids, whole.mean[3:].reshape(-1, 2), whole.covariance[3:, 3:])


CONDENSED = 16
"""Number of submaps that are condensed into the map before them once as many follow them."""


class TeamMap:
    """Joint map of the last prior and the robot's later submaps.

    Without new priors the oldest submaps are condensed, CONDENSED at a time, which bounds the cost
    of a pose. known, refused: landmarks of the newest submap and the open window that the rest of
    the map contains, and contradicts. doubt: a warning about the last pose.
    """

    def __init__(self) -> None:
        self._prior: m.Prior | None = None
        self._submaps = 0
        self._shared = SubmapCorrection()
        self._whole = initial_map(np.zeros(3), None)
        self._decoded: tuple[m.Prior, RobotPrior] | None = None
        self._pending: list[LocalMap] = []
        self._followed: Followed | Exception | None = None
        self.known = 0
        self.refused = 0
        self.doubt = ""

    def pose(
        self, prior: m.Prior, submaps: Sequence[LocalMap], window: RunningWindow | None
    ) -> Posed:
        """Estimate the robot's pose in the team's frame after the open window.

        A badly known heading gives the covariance of its arc.
        """
        given = self.join(prior, submaps)
        open_window = None if window is None else window.corrected(*self._shared)
        posed = compose_pose(given.whole, open_window)
        self.known = posed.known + sum(given.known[-1:])
        self.refused = posed.refused + sum(given.refused[-1:])
        self.doubt = self._warning(given)
        return Posed(curved(posed.pose), posed.known, posed.refused)

    def place(
        self, prior: m.Prior, own: OwnMap, window: RunningWindow | None
    ) -> PoseGaussian | None:
        """Estimate the pose in the team's frame by a prior of landmarks alone; None if
        undetermined.
        """
        from teamslam.team.estimation.map_joining.localising import locate_robot  # rarely needed

        given, self.doubt = self.decode(prior), ""
        team = LandmarkGaussian(given.ids, given.means, given.covariance[3:, 3:])
        local = None
        if window is not None:
            local = LocalMap(window.map.ids, window.map.mean, window.map.covariance)
        posed = locate_robot(team, own.whole, local, given.shared.covariance_factor)
        if isinstance(posed, str):
            return None
        self.known, self.refused = posed.known, posed.refused
        return curved(posed.pose)

    def decode(self, prior: m.Prior) -> RobotPrior:
        """Return the estimate in a prior; the last one is cached."""
        if self._decoded is None or self._decoded[0] is not prior:
            self._decoded = prior, translate.prior_of(prior)
        return self._decoded[1]

    def _warning(self, given: Followed) -> str:
        if is_majority(self.refused, self.known):
            return (
                f"the pose in the team's map is in doubt: {self.refused} of {self.known} landmarks "
                "that are seen contradict the rest"
            )
        if given.disputed:
            return (
                "the pose in the team's map is in doubt: the map and the robot's later submaps "
                f"contradict each other, χ² {given.cost:.0f} in {given.dof} degrees of freedom"
            )
        return ""

    def join(self, prior: m.Prior, submaps: Sequence[LocalMap]) -> Followed:
        """Join the prior with the incarnation's submaps that it does not contain.

        A restarted robot may have fewer submaps than the prior. Without a joint solution the cached
        error is raised at every keyframe.
        """
        if self._followed is None or prior is not self._prior or len(submaps) != self._submaps:
            if prior is not self._prior or len(submaps) < self._submaps:
                self._prior, self._submaps, self._pending = prior, 0, []
                decoded = self.decode(prior)
                self._whole, self._shared = decoded.whole, decoded.shared
            later = submaps[max(self._submaps, prior.sequence + 1) :]
            self._pending += [self._shared.taken(each.named) for each in later]
            self._submaps = len(submaps)
            try:
                while len(self._pending) >= 2 * CONDENSED:
                    self._whole = join_pending(self._whole, self._pending[:CONDENSED]).whole
                    del self._pending[:CONDENSED]
                self._followed = join_pending(self._whole, self._pending)
            except UNSOLVABLE as error:
                self._followed = error
        if isinstance(self._followed, Exception):
            raise self._followed.with_traceback(None)
        return self._followed
