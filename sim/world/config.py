"""The kinds of world that a scenario may name, as a user describes them."""

from itertools import pairwise
from math import hypot
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from team.config import Fraction, NonNegative, Positive, RobotConfig

Identities = Literal["known", "hidden"]
OutlierKind = Literal["measurement", "identity", "drop"]
Steering = Literal["together", "turn-first"]
OdometryForm = Literal["speeds", "increments", "steering"]
LandmarkForm = Literal["ranges", "points"]
Layout = Literal["uniform", "twins", "rooms"]
Point = tuple[float, float]


class SimulatedWorld(
    msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="kind", tag="simulated"
):
    """A square place of side size_m with point landmarks; robots drive steps of step_s seconds.

    radius_m: the place is a disc about (0, 0) instead: random landmarks and way-points have a
    uniform direction and a radius that is uniform up to it, and robots start at its centre.

    landmarks: their positions, or landmark_count of them at random. layout: "uniform"; "twins",
    each with another one twin_m beside it; or "rooms", a grid of rooms × rooms equal squares with
    the same pattern, which no map can tell apart.

    paths: path i has the way-points of robot i. A robot without one drives to random way-points at
    up to speed_m_s and turn_rate_rad_s; a way-point is reached within way_point_tolerance_m. With
    way_point_count the world ends, before `steps`, when all robots have reached that many.
    steering: "together" turns and drives in one step; "turn-first" does not drive in a step that
    turns.

    observe_at_start: there is a message of landmarks before the first step, too. visible_from_m,
    visible_to_m: landmarks at a *true* range between them are measured; absent: the limits of the
    robot's sensor. They belong to the world, since a gate on noisy measurements at the same limits
    selects by the noise and biases the map. unknown_starts: the robots whose initial pose the team
    is not given; "*" is all of them, "!r1" after it all but that one.

    outlier_share: the probability of a measurement of a landmark to be an outlier. outlier_kind: a
    "measurement" gets a uniform range and bearing, an "identity" becomes that of another landmark;
    "drop" leaves out the very measurements that the others spoil, all else being the same, for
    comparison.

    odometry: its form: "speeds", "increments" on SE(2), or a car's wheel speed and "steering".
    odometry_claims: increments come with a covariance, that of the motion model's forward, lateral
    and turn; the errors of the last two have the correlation odometry_correlation. landmark_form:
    "ranges" and bearings, or "points" in the sensor's frame. landmark_claims: each comes with a
    covariance of its own, whose standard deviations are the sensor's times factors between these
    two, and with errors of that size. claims_factor: these covariances are the true ones divided by
    this.

    identities: "hidden" publishes detections without identities, except for the share `tagged` of
    landmarks. missed: the probability of a measurement to be left out. clutter: with hidden
    identities, the share of detections that are of nothing at all.
    """

    steps: Annotated[int, Meta(ge=1, le=1_000_000)]
    size_m: Positive = 100.0
    radius_m: Positive | None = None
    step_s: Annotated[float, Meta(ge=1e-6, le=1e6)] = 1.0
    landmarks: tuple[Point, ...] = ()
    landmark_count: Annotated[int, Meta(ge=0, le=100_000)] = 0
    layout: Layout = "uniform"
    twin_m: Positive = 1.0
    rooms: Annotated[int, Meta(ge=1, le=100)] = 3
    paths: tuple[tuple[Point, ...], ...] = ()
    speed_m_s: Positive = 1.0
    turn_rate_rad_s: Positive = 1.0
    way_point_tolerance_m: Positive = 1.0
    way_point_count: Annotated[int, Meta(ge=0, le=1_000_000)] = 0
    steering: Steering = "together"
    observe_at_start: bool = False
    visible_from_m: NonNegative | None = None
    visible_to_m: Positive | None = None
    unknown_starts: tuple[str, ...] = ()
    outlier_share: Fraction = 0.0
    outlier_kind: OutlierKind = "measurement"
    odometry: OdometryForm = "speeds"
    odometry_claims: bool = False
    odometry_correlation: Annotated[float, Meta(gt=-1.0, lt=1.0)] = 0.0
    landmark_form: LandmarkForm = "ranges"
    landmark_claims: tuple[Positive, Positive] | None = None
    claims_factor: Positive = 1.0
    identities: Identities = "known"
    tagged: Fraction = 0.0
    missed: Fraction = 0.0
    clutter: Annotated[float, Meta(ge=0.0, le=0.9)] = 0.0

    def __post_init__(self) -> None:
        if self.odometry_claims and self.odometry != "increments":
            raise ValueError('odometry_claims: only odometry = "increments" has a covariance')
        if self.outlier_share and (self.landmark_claims or self.landmark_form == "points"):
            raise ValueError("outliers are of ranges and bearings without covariances of their own")
        if self.landmarks and self.landmark_count:
            raise ValueError("landmarks and landmark_count exclude each other: leave one away")
        for i, path in enumerate(self.paths):
            if sum(hypot(b[0] - a[0], b[1] - a[1]) for a, b in pairwise(path)) == 0.0:
                raise ValueError(f"path {i} has no length: give two way-points or more")


class UtiasWorld(
    msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="kind", tag="utias"
):
    """A data set in the UTIAS MRCLAM format.

    path: its folder or zip. odometry_delay_s: odometry logged at t acts at t + odometry_delay_s on
    the camera's clock. start_sigma_m, start_sigma_rad: how well the start poses are known; both 0:
    exactly. unknown_starts: as in a simulated world. duration_s: only this much from the team's
    first measurement. errata: repair known faults.
    """

    path: str = ""
    odometry_delay_s: NonNegative = 0.0
    start_sigma_m: NonNegative = 0.0
    start_sigma_rad: NonNegative = 0.0
    unknown_starts: tuple[str, ...] = ()
    duration_s: Annotated[float, Meta(gt=0.0, le=1e9)] | None = None
    errata: bool = True
    identities: Identities = "known"

    def __post_init__(self) -> None:
        if (self.start_sigma_m == 0.0) != (self.start_sigma_rad == 0.0):
            raise ValueError("start_sigma_m and start_sigma_rad are both 0 or both above 0")


class FolderWorld(
    msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="kind", tag="folder"
):
    """A data set in a folder (or zip) of CSV tables, with a sub-folder for each robot.

    path: the folder. unknown_starts: as in a simulated world, beside the robots without start.csv.
    duration_s: only this much from the team's first measurement.
    """

    path: str = ""
    unknown_starts: tuple[str, ...] = ()
    duration_s: Annotated[float, Meta(gt=0.0, le=1e9)] | None = None
    identities: Identities = "known"


class LiveWorld(
    msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="kind", tag="live"
):
    """No world: each robot has a driver that publishes its measurements and ends its own stream.

    admit: robots that the scenario does not name may join. newcomer: the configuration of such a
    robot unless its own process gives another; the scenario's [defaults].
    """

    admit: bool = False
    newcomer: RobotConfig | None = None


class UnlabelledWorld(
    msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="kind", tag="unlabelled"
):
    """A data set of one robot whose landmarks have no names: odometry.csv and detections.csv.

    path: the folder. With several robots, each drives a piece of the log from an unknown initial
    pose. duration_s: only this much from the first measurement. identities: "known" takes its
    labels for identities, for a run to compare with.
    """

    path: str = ""
    unknown_starts: tuple[str, ...] = ()
    duration_s: Annotated[float, Meta(gt=0.0, le=1e9)] | None = None
    identities: Identities = "hidden"


World = SimulatedWorld | UtiasWorld | FolderWorld | LiveWorld | UnlabelledWorld


def starts_unknown(world: World, robot: str) -> bool:
    """Whether the team is not given this robot's initial pose; that of a live robot comes from
    its driver.
    """
    if isinstance(world, LiveWorld):
        return False
    named = world.unknown_starts
    return robot in named or ("*" in named and f"!{robot}" not in named)


class RadioWindow(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """These robots reach each other from from_s until to_s of team time since the beginning."""

    robots: tuple[str, ...]
    from_s: NonNegative
    to_s: Positive


class Radio(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The radio of robots without a centre; by default every message arrives at once.

    comm_range_m: by true distance; absent: any. windows: if there are any, only then, and within
    the range. loss: the share of messages that never arrive. delay_s: until one does. bytes_per_s:
    what each link carries; absent: anything. Once a robot's stream has ended it reaches everyone
    whose stream has ended, too: robots are collected, and what is not known yet spreads.
    """

    comm_range_m: Positive | None = None
    windows: tuple[RadioWindow, ...] = ()
    loss: Annotated[float, Meta(ge=0.0, lt=1.0)] = 0.0
    delay_s: NonNegative = 0.0
    bytes_per_s: Positive | None = None

    @property
    def is_perfect(self) -> bool:
        """Whether everyone reaches everyone at once."""
        return self == Radio()
