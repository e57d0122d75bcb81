"""The result of a window: a submap with the names of its inputs."""

from dataclasses import dataclass

from teamslam.team.estimation.hybrid_slam.pose_grid import NodeSighting
from teamslam.team.estimation.hybrid_slam.window import NOTHING, Innovation, Window
from teamslam.team.estimation.submap import Became, LocalMap, Slipped


@dataclass(frozen=True, kw_only=True)
class ClosedWindow:
    """A submap with the names of its inputs, and the inter-robot measurements from its pose nodes.

    window, keyframes_ns: its particles with their paths, and the keyframes' team times, if solved.
    innovation: of predicted measurements. gated: measurements that no others confirmed. late:
    rejected scans, stamped behind the window's end. became: outcomes of detections without
    identity. slips: motions that the odometry missed. unsolved: scans without a Gaussian, of which
    the submap has only the motion.
    """

    sequence: int
    first_measurement: int
    last_measurement: int
    start_ns: int
    end_ns: int
    local: LocalMap
    sightings: tuple[NodeSighting, ...] = ()
    window: Window | None = None
    keyframes_ns: tuple[int, ...] = ()
    innovation: Innovation = NOTHING
    gated: int = 0
    late: int = 0
    unsolved: int = 0
    became: Became | None = None
    slips: tuple[Slipped, ...] = ()
