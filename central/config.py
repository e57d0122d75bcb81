"""What the central computer is told before it starts."""

from typing import Annotated

import msgspec
from msgspec import Meta

from team.association import AssociationProfile
from team.config import Bounds, FusionRule, NonNegative, Positive


class BiasSigmas(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How large the errors are that all submaps of a robot share, before they are estimated.

    bearing [rad]; range_offset [m]; range_scale, forward_scale: shares of the range and of the way
    driven.
    """

    bearing: Positive = 0.01
    range_offset: Positive = 0.02
    range_scale: Positive = 0.005
    forward_scale: Positive = 0.05


class CommonBiasSigmas(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How large the errors are that all robots share, beside each robot's own; 0: there are none.

    What was calibrated for robots of a kind is off by one amount for all of them. marker: the share
    of the range by which a landmark's marker, each by itself, reads too far for whoever sees it,
    since it hangs higher or is larger than the others; for landmarks with names.
    """

    bearing: NonNegative = 0.0
    range_offset: NonNegative = 0.0
    range_scale: NonNegative = 0.0
    forward_scale: NonNegative = 0.0
    marker: NonNegative = 0.0


class CentralConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The rule and its figures.

    fusion: `join` keeps a set of submaps and joins them by least squares; `team.pairs` says what
    the others consume. Under rules with feedback the robots absorb the map again: their covariance
    counts measurements more than once, save that of `covariance-intersection`.
    tick_s: the fold takes the submaps of this much team time at once.
    broadcast_s: at least this much team time lies between two broadcasts of the fused map.
    robust_c: scale of the Cauchy loss on sqrt(chi2/dim) of each submap, under `batch` on sqrt(chi2)
    of each measurement (a range and a bearing); absent: plain squares.
    landmark_submaps: a landmark enters the map once so many submaps have it and are believed; above
    1 where measurements may have nothing to do with what is there.
    covariance_factor: the submaps' covariances are multiplied by it; 1 for a sensor whose errors
    are independent from measurement to measurement.
    normal_scale: what the covariance scale of the monitor is where the covariances are right. 1
    where the errors of windows are independent; less where part of them lasts for longer than a
    window, since what two windows have in common does not set them apart.
    particles: of `joint-fastslam`.
    bias_sigma: of the errors that robots send their submaps' sensitivities for.
    common_bias_sigma: of what all robots have in common of them, in addition.
    joined_ranges: the errors of ranges are proportional to the range, and a submap's landmarks
    count with what they are at the range of the joined map: at the measured one, what came out
    short weighs more and the map shrinks.
    withdraw_above: a robot of whose submaps the half and more cost above this per degree of freedom
    is withdrawn if the rest of the team agrees without it; absent: by an operator only.
    bounds: submaps, inter-robot measurements and initial poses beyond them are refused.
    association: when landmarks without names count as one: a profile for each kind of sensor.
    """

    fusion: FusionRule = "join"
    tick_s: Positive = 10.0
    broadcast_s: Positive = 10.0
    robust_c: Positive | None = None
    landmark_submaps: Annotated[int, Meta(ge=1, le=100)] = 1
    covariance_factor: Annotated[float, Meta(ge=1.0, le=1e9)] = 1.0
    normal_scale: Positive = 1.0
    gauss_newton_per_tick: Annotated[int, Meta(ge=1, le=50)] = 2
    bias_sigma: BiasSigmas = BiasSigmas()
    common_bias_sigma: CommonBiasSigmas = CommonBiasSigmas()
    joined_ranges: bool = False
    particles: Annotated[int, Meta(ge=4, le=100_000)] = 1000
    withdraw_above: Annotated[float, Meta(ge=2.0)] | None = 4.0
    bounds: Bounds = Bounds()
    association: AssociationProfile = AssociationProfile()
