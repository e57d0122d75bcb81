"""Write a robot's estimates as messages."""

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from teamslam.team import core, translate
from teamslam.team.config import UNNAMED
from teamslam.team.core import packed
from teamslam.team.estimation.gaussian import LandmarkGaussian, PoseGaussian
from teamslam.team.estimation.hybrid_slam.pose_grid import NodeSighting
from teamslam.team.estimation.hybrid_slam.window import ClosedWindow, Innovation
from teamslam.team.estimation.submap import Became
from teamslam.team.robot.maps import Cloud
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.arrays import from_floats, from_ids, from_stamps
from teamslam.team.wire.bus import Outgoing
from teamslam.team.wire.digest import NO_MAP


@dataclass(frozen=True)
class MessageWriter:
    """Writer of one incarnation's messages under a configuration's digest.

    started: its initial pose is known.
    """

    robot: str
    incarnation: int
    config: bytes
    started: bool

    def submap(self, closed: ClosedWindow) -> m.Submap:
        """Write the window's Gaussian with its inputs."""
        return translate.submap_message(
            robot=self.robot,
            incarnation=self.incarnation,
            sequence=closed.sequence,
            measurements=(closed.first_measurement, closed.last_measurement),
            span_ns=(closed.start_ns, closed.end_ns),
            config=self.config,
            local=closed.local,
            sightings=len(closed.sightings),
            gated=closed.gated,
        )

    def association(self, sequence: int, stamp_ns: int, became: Became) -> Outgoing:
        """Write the outcomes of the window's detections without identities."""
        landmarks = np.where(became.clutter, m.CLUTTER, m.UNCONFIRMED)
        message = m.Association(
            stamp_ns=stamp_ns,
            robot=self.robot,
            incarnation=self.incarnation,
            sequence=sequence,
            stamps=from_stamps(became.stamps),
            counts=from_ids(became.counts),
            rows=from_ids(became.rows),
            landmarks=from_ids(np.where(became.landmarks >= UNNAMED, became.landmarks, landmarks)),
        )
        return Outgoing(ch.ASSOCIATION, self.robot, message)

    def sighting(self, sequence: int, each: NodeSighting) -> m.SightingFactor:
        """Write the inter-robot measurement from a window's pose node, with its inputs."""
        return m.SightingFactor(
            stamp_ns=each.stamp_ns,
            robot=self.robot,
            incarnation=self.incarnation,
            sequence=sequence,
            config=self.config,
            teammate=each.teammate,
            range=float(each.measurement[0]),
            bearing=float(each.measurement[1]),
            covariance=from_floats(packed(each.covariance)),
            measurements=each.measurements,
            point=from_floats(each.point) if each.point.any() else b"",
        )

    def cloud(self, stamp_ns: int, cloud: Cloud) -> Outgoing:
        """Write the thinned particles."""
        poses, weights = (from_floats(x) for x in cloud)
        message = m.ParticleCloud(stamp_ns=stamp_ns, robot=self.robot, poses=poses, weights=weights)
        return Outgoing(ch.PARTICLES, self.robot, message)

    def innovation(self, stamp_ns: int, sequence: int, found: Innovation) -> Outgoing:
        """Write the innovations of a window, or since the last such message."""
        message = m.Innovation(
            stamp_ns=stamp_ns,
            robot=self.robot,
            incarnation=self.incarnation,
            sequence=sequence,
            squared=found.squared,
            dof=found.dof,
        )
        return Outgoing(ch.INNOVATION, self.robot, message)

    def own_map(
        self,
        stamp_ns: int,
        sequence: int,
        exchange: int,
        landmarks: LandmarkGaussian,
        kind: Literal["joint", "blocks"],
    ) -> Outgoing:
        """Write the running map, with joint or separate covariances."""
        joint = kind == "joint"
        message = m.MapEstimate(
            stamp_ns=stamp_ns,
            robot=self.robot,
            incarnation=self.incarnation,
            sequence=sequence,
            exchange=exchange,
            joint=joint,
            ids=from_ids(landmarks.ids),
            means=from_floats(landmarks.means),
            covariance=translate.covariance_bytes(landmarks.covariance, joint=joint),
        )
        return Outgoing(ch.OWN_MAP, self.robot, message)

    @cached_property
    def _frame(self) -> str:
        return translate.frame_name(self.robot, self.incarnation)

    def pose(
        self, stamp_ns: int, sequence: int, pose: PoseGaussian, prior: m.Prior | None = None
    ) -> Outgoing:
        """Write a running pose by own measurements, in the stream's start frame; given the team's
        map, in the prior's frame.
        """
        mean, covariance = core.pose_bytes(*pose)
        message = m.PoseEstimate(
            stamp_ns=stamp_ns,
            robot=self.robot,
            incarnation=self.incarnation,
            sequence=sequence,
            map_digest=NO_MAP if prior is None else prior.digest,
            pose=mean,
            covariance=covariance,
            frame=self._frame if prior is None else prior.frame,
            in_team_frame=self.started or prior is not None,
        )
        return Outgoing(ch.OWN_POSE if prior is None else ch.TEAM_POSE, self.robot, message)
