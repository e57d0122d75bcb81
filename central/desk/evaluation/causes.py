"""Machine-readable causes of a result's texts, for `--json`.

A program compares `cause`; `text` is for people. Each text is in one list: `not_joined`,
`withdrawn`, or `warnings`, which has the rest but the diagnosis.
"""

from collections.abc import Iterable, Mapping

from teamslam.central.desk.evaluation.states import NO_MEMBER, RobotState

_NOT_JOINED = (
    (NO_MEMBER, "no_submaps"),
    ("disagree", "maps_disagree"),
    ("leave two places", "ambiguous"),
    ("margin", "ambiguous"),
    ("needed", "too_little_shared"),
    ("shared", "too_little_shared"),
)
_WARNINGS = (
    ("left out", "landmarks_left_out"),
    ("refused", "refused"),
    ("placed weakly", "weak_heading"),
    ("farther off than its covariance", "nonlinear"),
    ("was lost", "weak_heading"),
    ("two places look alike", "places_alike"),
    ("not settled", "not_settled"),
    ("no full solution", "no_solution"),
    ("another map fits", "wrong_minimum"),
    ("does not fit its submaps", "misfit"),
    ("contradict each other", "robots_contradict"),
    ("not calibrated", "not_calibrated"),
    ("claim to be surer", "covariance_raised"),
    ("measurement times", "clocks"),
)


def _cause(text: str, table: Iterable[tuple[str, str]], otherwise: str) -> str:
    return next((cause for words, cause in table if words in text), otherwise)


def absent_robots(states: Mapping[str, RobotState], state: str) -> list[dict[str, str]]:
    """Make the objects of the robots that are not joined, or of the withdrawn ones."""
    found = []
    for robot, of in states.items():
        if of.state != state:
            continue
        if state == "withdrawn":
            cause = "contradicts_the_rest" if of.why.startswith("by central") else "ordered"
        else:
            cause = _cause(of.why, _NOT_JOINED, "no_place_found")
        found.append({"robot": robot, "cause": cause, "text": of.why})
    return found


def warning_objects(texts: Iterable[str]) -> list[dict[str, str]]:
    """Make the objects of warnings."""
    return [{"cause": _cause(each, _WARNINGS, "other"), "text": each} for each in texts]
