"""All reasons to reject a measurement."""

from enum import StrEnum

REJECTED = "rejected: "  # begins the disposition of a rejected measurement


class Rejection(StrEnum):
    """A reason to reject a measurement, as spelt by ledger, `Done` and `teamslam verify-ledger`."""

    OLDER = "older than the odometry"
    NOT_COVERED = "no odometry covers it"
    NO_TIME = "odometry over no time"
    SPEED = "odometry beyond the bounds"  # the interval's time is used, its motion is not
    STEERING = "steering without a car's motion model"
    """As SPEED; steering needs motion.kind = "ackermann"."""
    TIME = "a time beyond the bounds"
    RANGE = "a range beyond the bounds"
    SENSOR_LIMITS = "outside the sensor's limits"
    CLAIMS = "this estimator takes no covariances of measurements"
    ITSELF = "a robot does not see itself"
    NO_LANDMARKS = "this estimator uses no landmarks"
    NO_ASSOCIATION = "this estimator takes no landmarks without identities"
    UNCONFIRMED = "no detection of it is seen often enough"
    CLUTTER = "clutter alone"
    NO_TEAMMATES = "sightings and fixes are not used by this estimator"
    NO_NODES = "sightings and fixes need pose nodes, and front_end.node_s is 0"
    NO_NODE = "no pose node near it"
    LATE = "counted in a window that ends before its stamp"
    UNSOLVED = "its window has no solution"  # the submap has the odometry's motion alone
    SET_ASIDE = "its handling raised"

    @property
    def disposition(self) -> str:
        """The disposition under which the ledger counts it."""
        return f"{REJECTED}{self.value}"


BY_CORE = (
    None, Rejection.NO_TIME, Rejection.OLDER, Rejection.TIME, Rejection.SPEED, Rejection.STEERING,
    Rejection.RANGE, Rejection.SENSOR_LIMITS,
)  # fmt: skip
"""The verdicts of `core.StreamJudge` and `core.Segmenter`, in their order."""
UNMEASURED = frozenset({None, Rejection.SPEED, Rejection.STEERING})
"""Outcomes of an odometry interval whose time is used."""
