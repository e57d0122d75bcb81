"""Former names of settings, by which old logs are still read."""

from typing import Any

FIELDS = {
    "garbage": "outlier_share",
    "robust_c": "batch_robust_c",
    "garbage_kind": "outlier_kind",
    "landmarks_told": "landmark_form",
    "look_at_start": "observe_at_start",
}
"""Fields of `world` and `central`: the former name and today's."""
GONE = {
    "robust_c": "the join is robust without it: leave it out (under `batch`: batch_robust_c)",
    "outlier_share": "windows reject outliers without it: leave it out",
}
"""Removed settings of `central` and `front_end` in old scenario files, with the remedy."""
SHARES = ("garbage", "outlier_share")  # fields of a robot's `front_end` that have no successor
VALUES = {("outlier_kind", "reading"): "measurement"}
"""Renamed values, by today's name of their field."""


def with_current_names(value: Any) -> Any:
    """Replace former names in the decoded JSON of a scenario or a configuration."""
    if isinstance(value, list):
        return [with_current_names(each) for each in value]
    if not isinstance(value, dict):
        return value
    former: dict[str, Any] = value
    current = {FIELDS.get(name, name): each for name, each in former.items()}
    if "front_end" in current:
        front_end = current["front_end"]
        current["front_end"] = {k: v for k, v in front_end.items() if k not in SHARES}
    return {
        name: VALUES.get((name, each), each) if isinstance(each, str) else with_current_names(each)
        for name, each in current.items()
    }
