"""The configuration of the central computer, and of a team."""

from typing import Annotated

import msgspec
from msgspec import Meta

from teamslam.team.association import AssociationProfile
from teamslam.team.config import (
    UNNAMED,
    BiasSigmas,
    Bounds,
    Estimator,
    Exchange,
    FusionRule,
    NonNegative,
    Positive,
    RobotConfig,
)
from teamslam.team.datum import Datum

ClassName = Annotated[str, Meta(pattern="^[A-Za-z][A-Za-z0-9_ -]{0,31}$")]


class CommonBiasSigmas(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Prior standard deviations of the errors shared by all robots; 0: none.

    marker: share of the range by which a landmark's marker appears too far to every robot.
    """

    bearing: NonNegative = 0.0
    clock_offset: NonNegative = 0.0
    range_offset: NonNegative = 0.0
    range_scale: NonNegative = 0.0
    forward_scale: NonNegative = 0.0
    marker: NonNegative = 0.0


class SurveyedLandmark(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A landmark ~ N((x, y), P) in the team's frame [m].

    sigma_m: of each coordinate. covariance: xx, xy, yy of P [m²] instead.
    """

    landmark: Annotated[int, Meta(ge=0, lt=UNNAMED)]
    x: float
    y: float
    sigma_m: Positive = 0.02
    covariance: tuple[Positive, float, Positive] | None = None

    def __post_init__(self) -> None:
        xx, xy, yy = self.covariance or (1.0, 0.0, 1.0)
        if not xx * yy > xy * xy:
            raise ValueError("the covariance xx, xy, yy must be positive definite")

    @property
    def matrix(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """The covariance P [m²]."""
        variance = self.sigma_m * self.sigma_m
        xx, xy, yy = self.covariance or (variance, 0.0, variance)
        return (xx, xy), (xy, yy)


class CentralConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The fusion rule and its parameters; docs/scenario.md describes every field."""

    fusion: FusionRule = "join"
    tick_s: Positive = 10.0
    broadcast_s: Positive = 10.0
    batch_robust_c: Positive | None = None
    landmark_submaps: Annotated[int, Meta(ge=1, le=100)] = 1
    covariance_factor: Annotated[float, Meta(ge=1.0, le=1e9)] = 1.0
    normal_scale: Positive = 1.0
    gauss_newton_per_tick: Annotated[int, Meta(ge=1, le=50)] = 2
    bias_sigma: BiasSigmas = BiasSigmas()
    common_bias_sigma: CommonBiasSigmas = CommonBiasSigmas()
    joined_ranges: bool = False
    particles: Annotated[int, Meta(ge=4, le=100_000)] = 1000
    withdraw_above: Annotated[float, Meta(ge=2.0)] | None = 4.0
    least_sigma: tuple[NonNegative, NonNegative] = (5e-4, 5e-5)
    bounds: Bounds = Bounds()
    association: AssociationProfile = AssociationProfile()
    landmark_sigma: NonNegative = 0.0
    localise: bool = False
    surveyed: Annotated[tuple[SurveyedLandmark, ...], Meta(max_length=1000)] = ()
    datum: Datum | None = None
    classes: Annotated[tuple[ClassName, ...], Meta(max_length=64)] = ()

    def __post_init__(self) -> None:
        if len({each.landmark for each in self.surveyed}) < len(self.surveyed):
            raise ValueError("surveyed names each landmark once")
        if len(set(self.classes)) < len(self.classes):
            raise ValueError("classes names each class once")
        if self.surveyed and self.fusion != "join":
            raise ValueError("surveyed landmarks need the rule join")


KeyChunk = Annotated[str, Meta(pattern="^[A-Za-z0-9_.-]{1,64}$")]
"""A part of a key, between two slashes."""


class TeamConfig(msgspec.Struct, frozen=True, kw_only=True):
    """A scenario without its world: every robot and the centre have the seed, estimator and rule
    (docs/scenario.md).

    team: the chunk of the keys `team/<team>/…` that separates two teams. exchange: with
    "rendezvous" submaps are sent at encounters only. peers: every robot folds the team's set
    (docs/without_a_centre.md). Fields of a world are ignored in decoding.
    """

    name: KeyChunk
    team: KeyChunk
    robots: tuple[RobotConfig, ...]
    central: CentralConfig = CentralConfig()
    seed: Annotated[int, Meta(ge=0, le=2**63 - 1)] = 1
    estimator: Estimator = "hybrid"
    fusion: FusionRule = "join"
    exchange: Exchange = "continuous"
    peers: bool = False
    centre: bool = True


UNREADABLE = msgspec.MsgspecError, UnicodeEncodeError, RecursionError
"""Errors of decoding a configuration in JSON that another process has written."""


def team_config(text: str) -> TeamConfig:
    """Decode a resolved scenario in JSON; raises ValueError."""
    try:
        return msgspec.json.decode(text, type=TeamConfig)
    except UNREADABLE as error:
        raise ValueError(f"not a team's configuration in JSON: {error}") from None
