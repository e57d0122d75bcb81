"""A robot's own estimates, for viewers and rules on whole maps, and the end of its work."""

from typing import Annotated

import msgspec
from msgspec import Meta

from teamslam.team.core import check_finite, check_pose_covariance
from teamslam.team.wire.arrays import Floats, Ids, floats
from teamslam.team.wire.messages.base import Count, Digest, Message, Name, Text, check_landmarks


class MapEstimate(Message, frozen=True, kw_only=True, tag="map/1"):
    """A robot's running map in the team's frame.

    exchange: number of map exchanges under a rule with feedback (lockstep); 0 under `join`. means:
    L × 2 floats. covariance: packed upper triangle of the 2L × 2L joint if `joint`, else L packed 2
    × 2 blocks.
    """

    robot: Name
    incarnation: Count
    sequence: Count
    exchange: Count
    joint: bool
    ids: Ids
    means: Floats
    covariance: Floats

    def check(self) -> None:
        check_landmarks(self.ids, self.means, self.covariance, joint=self.joint)


class PoseEstimate(Message, frozen=True, kw_only=True, tag="pose/1"):
    """A robot's pose at stamp_ns, with its 3 × 3 covariance, in `frame`.

    map_digest: the fused map that it uses (8 zero bytes: none). sequence: the submap in progress.
    frame: as `FusedMap.frame`; empty in older logs. in_team_frame: frame is the team's; on
    team/pose that of the named map, on own/pose if the initial pose is known. A pose on team/pose
    outside the team's frame is the own pose and withdraws the poses before it.
    """

    robot: Name
    incarnation: Count
    sequence: Count
    map_digest: Digest
    pose: Floats
    covariance: Floats
    frame: Text = ""
    in_team_frame: bool = True

    def check(self) -> None:
        check_finite(self.pose, "pose", 3)
        check_pose_covariance(self.covariance, "covariance")


class ParticleCloud(Message, frozen=True, kw_only=True, tag="particles/1"):
    """A thinned particle cloud for viewers: P × 3 poses and P weights, in the frame of own/pose."""

    robot: Name
    poses: Floats
    weights: Floats

    def check(self) -> None:
        check_finite(self.poses, "poses", 3 * len(floats(self.weights, "weights")))
        check_finite(self.weights, "weights")


class Innovation(Message, frozen=True, kw_only=True, tag="innovation/1"):
    """NIS of a window's measurements, Σ νᵀ S⁻¹ ν; χ²(dof) if the models are right.

    dof: two for each measurement of a mapped landmark. sequence: the window's submap; an estimator
    over the whole stream publishes the NIS since its last message.
    """

    robot: Name
    incarnation: Count
    sequence: Count
    squared: Annotated[float, Meta(ge=0.0, le=1e300)]
    dof: Count


class Rendezvous(Message, frozen=True, kw_only=True, tag="rendezvous/1"):
    """Release of `submaps` buffered submaps; the oldest was buffered for `waited_s` seconds.

    teammates: the observed robots, which release theirs, too; empty if the robot was observed
    itself, or its stream has ended.
    """

    robot: Name
    incarnation: Count
    teammates: tuple[Name, ...]
    submaps: Count
    waited_s: Annotated[float, Meta(ge=0.0, le=1e12)]


class Disposition(msgspec.Struct, frozen=True, kw_only=True, array_like=True):
    """Number of a robot's measurements with one disposition, such as "submap" or a rejection."""

    disposition: Text
    measurements: Count


class Done(Message, frozen=True, kw_only=True, tag="done/1"):
    """End of a robot's work: all measurements are consumed, and the last submap is sent.

    last_map: sequence of the last own map, if the rule consumes own maps; else −1.
    """

    robot: Name
    incarnation: Count
    measurements: Count
    steps: Count
    submaps: Count
    ledger: tuple[Disposition, ...]
    last_map: int = -1
