"""Kinds of world in a scenario; docs/scenario.md describes their fields."""

from itertools import pairwise
from math import hypot
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from teamslam.team.config import Fraction, NonNegative, Positive, RobotConfig

Identities = Literal["known", "hidden"]
OutlierKind = Literal["measurement", "identity", "drop"]
Steering = Literal["together", "turn-first"]
OdometryForm = Literal["speeds", "increments", "steering"]
LandmarkForm = Literal["ranges", "points"]
Layout = Literal["uniform", "twins", "rooms"]
Point = tuple[float, float]


class _World(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="kind"):
    pass


class SimulatedWorld(_World, frozen=True, tag="simulated"):
    """Square of side size_m with point landmarks; robots drive in steps of step_s seconds.

    visible_from_m and visible_to_m limit the *true* range: a gate on measurements biases the map.
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
        nearest, farthest = self.visible_from_m, self.visible_to_m
        if nearest is not None and farthest is not None and farthest <= nearest:
            raise ValueError(
                f"visible_to_m = {farthest:g} is not above visible_from_m = {nearest:g}: no "
                "landmark would be seen"
            )
        if self.landmarks and self.landmark_count:
            raise ValueError("landmarks and landmark_count exclude each other: leave one away")
        for i, path in enumerate(self.paths):
            if sum(hypot(b[0] - a[0], b[1] - a[1]) for a, b in pairwise(path)) == 0.0:
                raise ValueError(f"path {i} has no length: give two way-points or more")


class UtiasWorld(_World, frozen=True, tag="utias"):
    """Data set in the UTIAS MRCLAM format."""

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


class _DataSet(_World, frozen=True):
    path: str = ""
    unknown_starts: tuple[str, ...] = ()
    duration_s: Annotated[float, Meta(gt=0.0, le=1e9)] | None = None
    identities: Identities = "known"


class FolderWorld(_DataSet, frozen=True, tag="folder"):
    """Data set in a folder or zip of CSV tables."""


class LiveWorld(_World, frozen=True, tag="live"):
    """Drivers publish measurements and end streams; newcomer: configuration of unnamed robots."""

    admit: bool = False
    newcomer: RobotConfig | None = None


class UnlabelledWorld(_DataSet, frozen=True, tag="unlabelled"):
    """Data set of one robot with unnamed landmarks.

    Several robots each drive a piece of the log from an unknown initial pose.
    """

    identities: Identities = "hidden"
    fixes: bool = False


class GraphWorld(_DataSet, frozen=True, tag="graph"):
    """Landmark graph of isam, TORO, g2o or PyFactorGraph.

    More robots than the file's one each drive a piece; only the first has an initial pose.
    """


World = SimulatedWorld | UtiasWorld | FolderWorld | LiveWorld | UnlabelledWorld | GraphWorld


def starts_unknown(world: World, robot: str) -> bool:
    """Whether the team lacks this robot's initial pose; a driver gives a live robot's."""
    if isinstance(world, LiveWorld):
        return False
    named = world.unknown_starts
    return robot in named or ("*" in named and f"!{robot}" not in named)


class RadioWindow(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Robots that reach each other in [from_s, to_s] of team time."""

    robots: tuple[str, ...]
    from_s: NonNegative
    to_s: Positive


class Radio(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Radio of robots without a centre; by default instant and lossless.

    Robots whose streams have ended reach each other.
    """

    comm_range_m: Positive | None = None
    windows: tuple[RadioWindow, ...] = ()
    loss: Annotated[float, Meta(ge=0.0, lt=1.0)] = 0.0
    delay_s: NonNegative = 0.0
    bytes_per_s: Positive | None = None

    @property
    def is_perfect(self) -> bool:
        """Whether all robots reach each other at once."""
        return self == Radio()
