"""Truth for the evaluation, the known map of localisation, the plan of a simulated radio."""

from teamslam.team.core import check_ascending, check_finite, check_named
from teamslam.team.wire.arrays import Floats, Ids, Stamps, ids, stamps
from teamslam.team.wire.messages.base import Message, Name, StampNs, check_counts


class Truth(Message, frozen=True, kw_only=True, tag="truth/1"):
    """True poses of a robot, for the evaluation only: T stamps and T × 3 floats (x, y, theta)."""

    robot: Name
    stamps: Stamps
    poses: Floats

    def check(self) -> None:
        check_finite(self.poses, "poses", 3 * len(stamps(self.stamps, "stamps")))


class LandmarkPositions(Message, frozen=True, kw_only=True):
    """Positions of landmarks with identities: L ids, ascending, and L × 2 floats."""

    ids: Ids
    positions: Floats

    def check(self) -> None:
        check_ascending(self.ids, "ids")
        check_named(self.ids, "ids")
        check_finite(self.positions, "positions", 2 * len(ids(self.ids, "ids")))


class TruthLandmarks(LandmarkPositions, frozen=True, kw_only=True, tag="truth_landmarks/1"):
    """True landmark positions, for the evaluation only."""


class TruthLabels(Message, frozen=True, kw_only=True, tag="truth_labels/1"):
    """True landmarks of a robot's detections, for the evaluation only.

    stamps: of M scans; counts: detections of each; labels: of each detection the landmark's number,
    or NO_LABEL.
    """

    robot: Name
    stamps: Stamps
    counts: Ids
    labels: Ids

    def check(self) -> None:
        check_counts(self.counts, len(stamps(self.stamps, "stamps")), len(self.labels) // 4)
        ids(self.labels, "labels")


NO_LABEL = 2**32 - 1
"""The label of clutter, and of detections of an unknown landmark."""


class TruthPositions(Message, frozen=True, kw_only=True, tag="truth_positions/1"):
    """Positions of a robot by another sensor, such as a GPS, for the evaluation only.

    T stamps and T × 2 floats (x, y) in a frame of its own; some may be metres off.
    """

    robot: Name
    stamps: Stamps
    positions: Floats

    def check(self) -> None:
        check_finite(self.positions, "positions", 2 * len(stamps(self.stamps, "stamps")))


class KnownMap(LandmarkPositions, frozen=True, kw_only=True, tag="known_map/1"):
    """Prior map for localisation-only robots, in the team's frame."""


class RadioPlan(Message, frozen=True, kw_only=True, tag="radio/1"):
    """Links of a simulated radio in each second of team time from stamp_ns on.

    pairs: for each second a row of bits of the pairs of robots in their order, padded to bytes.
    ends_ns: when each robot's stream ends.
    """

    robots: tuple[Name, ...]
    ends_ns: tuple[StampNs, ...]
    pairs: bytes

    def check(self) -> None:
        n = len(self.robots)
        width = max((n * (n - 1) // 2 + 7) // 8, 1)
        if len(self.ends_ns) != n or not self.pairs or len(self.pairs) % width:
            raise ValueError("wrong length: ends_ns or pairs")
