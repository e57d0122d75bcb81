"""What a robot estimates by itself, for viewers and for rules on whole maps, and its last words."""

from typing import Annotated

import msgspec
from msgspec import Meta

from team.wire.arrays import Floats, Ids, check_finite, check_pose_covariance, floats
from team.wire.messages.base import Count, Digest, Message, Name, Text, check_landmarks


class MapEstimate(Message, frozen=True, kw_only=True, tag="map/1"):
    """A robot's own running map in the team's frame: landmark means and covariances.

    exchange: counts the maps that a rule with feedback exchanged (lockstep), 0 under `join`.
    means: L × 2 floats. covariance: packed upper triangle of the 2L × 2L joint if `joint`, else the
    L packed 2 × 2 blocks (3 floats each).
    """

    robot: Name
    incarnation: Count
    sequence: Count
    exchange: Count
    joint: bool
    ids: Ids
    means: Floats
    covariance: Floats

    def check(self) -> None:  # noqa: D102
        check_landmarks(self.ids, self.means, self.covariance, joint=self.joint)


class PoseEstimate(Message, frozen=True, kw_only=True, tag="pose/1"):
    """A robot's pose at stamp_ns, with its 3 × 3 covariance, in the frame that it names.

    `map_digest` names the fused map that went into it (8 zero bytes: none), `sequence` the submap
    in progress. frame: in the notation of `FusedMap.frame`; empty in logs of earlier versions.
    in_team_frame: this is the team's frame. On team/pose it is that of the named map, on own/pose
    the initial pose is known. A pose on team/pose that is not in the team's frame is the own pose:
    it withdraws the poses before it.
    """

    robot: Name
    incarnation: Count
    sequence: Count
    map_digest: Digest
    pose: Floats
    covariance: Floats
    frame: Text = ""
    in_team_frame: bool = True

    def check(self) -> None:  # noqa: D102
        check_finite(self.pose, "pose", 3)
        check_pose_covariance(self.covariance, "covariance")


class ParticleCloud(Message, frozen=True, kw_only=True, tag="particles/1"):
    """A thinned particle cloud, for viewers: P × 3 poses and P weights.

    In the frame of the robot's own poses (`robot/{robot}/pose`), not in that of the team's map.
    """

    robot: Name
    poses: Floats
    weights: Floats

    def check(self) -> None:  # noqa: D102
        check_finite(self.poses, "poses", 3 * len(floats(self.weights, "weights")))
        check_finite(self.weights, "weights")


class Innovation(Message, frozen=True, kw_only=True, tag="innovation/1"):
    """Σ νᵀ S⁻¹ ν of a window's measurements against their prediction; χ² where the models are
    right.

    dof: its degrees of freedom, two for each measurement of a landmark that the window knew
    already. (robot, incarnation, sequence) and stamp_ns are those of the window's submap; an
    estimator over the whole stream says it of the measurements since the last of these, named by
    its incarnations so far.
    """

    robot: Name
    incarnation: Count
    sequence: Count
    squared: Annotated[float, Meta(ge=0.0, le=1e300)]
    dof: Count


class Rendezvous(Message, frozen=True, kw_only=True, tag="rendezvous/1"):
    """Announces that `submaps` buffered submaps are released; the oldest waited `waited_s` seconds.

    teammates: the robots that it sees, which release theirs on this message; empty where the robot
    itself was seen, or its stream has ended.
    """

    robot: Name
    incarnation: Count
    teammates: tuple[Name, ...]
    submaps: Count
    waited_s: Annotated[float, Meta(ge=0.0, le=1e12)]


class Disposition(msgspec.Struct, frozen=True, kw_only=True, array_like=True):
    """How many measurements of a robot ended in one way: in a submap, rejected for a reason,
    lost…
    """

    disposition: Text
    measurements: Count


class Done(Message, frozen=True, kw_only=True, tag="done/1"):
    """A robot has consumed every measurement of its stream and sent its last submap.

    last_map: the sequence of its last own map, where the rule consumes own maps; −1: none.
    """

    robot: Name
    incarnation: Count
    measurements: Count
    steps: Count
    submaps: Count
    ledger: tuple[Disposition, ...]
    last_map: int = -1
