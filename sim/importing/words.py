"""Words in names of files, columns and topics."""

import re

TRUTH_WORDS = (
    "truth", "gt", "groundtruth", "true", "ref", "reference", "mocap", "optitrack", "vicon", "vrpn",
    "qualisys",
)  # fmt: skip
"""Words for references, which are no measurements of the robot."""
FUSED_WORDS = (
    "filtered", "fused", "ekf", "ukf", "global", "map", "amcl", "gps", "slam", "localization",
    "kiss", "visual", "vio", "lidar", "icp",
)  # fmt: skip
"""Words for odometry from more than wheels."""


ROBOT_COLUMN = re.compile(
    r"(robot|agent|vehicle|platform|rover|ugv)s?_?(id|name|no|nr|number|index|ns|namespace)?"
)


def names_robot(column: str) -> bool:
    """Whether a column is called as one of robots' names."""
    return ROBOT_COLUMN.fullmatch(re.sub(r"[^a-z0-9]+", "_", column.lower())) is not None


def has_word(name: str, words: tuple[str, ...]) -> bool:
    """Whether a name has such a word between marks or capitals."""
    parts = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name).lower()
    return not set(re.split(r"[^a-z]+", parts)).isdisjoint(words)
