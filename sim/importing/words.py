"""Words in the names of files, columns and topics, and the sources that they indicate."""

import re

TRUTH_WORDS = (
    "truth", "gt", "groundtruth", "true", "ref", "reference", "mocap", "optitrack", "vicon", "vrpn",
    "qualisys",
)  # fmt: skip
"""Words in the names of references, which are no measurements of the robot's."""
FUSED_WORDS = (
    "filtered", "fused", "ekf", "ukf", "global", "map", "amcl", "gps", "slam", "localization",
    "kiss", "visual", "vio", "lidar", "icp",
)  # fmt: skip
"""Words in the names of odometry that is not the wheels' alone."""


def has_word(name: str, words: tuple[str, ...]) -> bool:
    """Whether a name has one of these words between its marks and at its capital letters."""
    parts = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name).lower()
    return not set(re.split(r"[^a-z]+", parts)).isdisjoint(words)
