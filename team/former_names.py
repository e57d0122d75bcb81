"""Former names of settings, with which the scenarios and configurations in logs of that time are
still read.
"""

from typing import Any

FIELDS = {
    "garbage": "outlier_share",
    "garbage_kind": "outlier_kind",
    "landmarks_told": "landmark_form",
    "look_at_start": "observe_at_start",
}
"""The former name and today's, of fields of `world` and of a robot's `front_end`."""
VALUES = {("outlier_kind", "reading"): "measurement"}
"""Values that had another name, by today's name of their field."""


def with_current_names(value: Any) -> Any:
    """Replace former names in the decoded JSON of a scenario or a configuration."""
    if isinstance(value, list):
        return [with_current_names(each) for each in value]
    if not isinstance(value, dict):
        return value
    former: dict[str, Any] = value
    current = {FIELDS.get(name, name): each for name, each in former.items()}
    return {
        name: VALUES.get((name, each), each) if isinstance(each, str) else with_current_names(each)
        for name, each in current.items()
    }
