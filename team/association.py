"""The thresholds of data association between submaps: one profile for each kind of sensor."""

from math import hypot
from typing import Annotated

import msgspec
from msgspec import Meta

from team.config import NonNegative, Positive, Sensor, Share

Few = Annotated[int, Meta(ge=1, le=1000)]


class AssociationProfile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Thresholds by which landmarks without identities are merged; lengths in metres.

    gate: χ² (2 numbers) beyond which two are not one. slack: what two submaps' places of one
    landmark differ by beside their covariance. density: λ, landmarks to be expected per square
    metre. llr_tight, llr_loose: the log-likelihood ratio that a pair needs where the standard
    deviation of its difference is below `tight`, and elsewhere. odds: how much more it needs than
    its best rival. near: up to this standard deviation old landmarks are candidates without a
    closure. same: two landmarks nearer than this may be one that was split. recent: so many last
    submaps of a robot are followed by tracking, and are the patch for which a closure is searched.
    absent: the cost of a landmark that one side has and the other, which observed its place, has
    not: −ln of the probability of that. closure_pairs, closure_llr, margin, ratio: what a closure
    needs: pairs, evidence (the sum of their log-likelihood ratios less what is absent), how much
    more and how many times the evidence of the best other alignment. island_pairs, island_llr: the
    same between robots with unknown initial poses. context: least number of landmarks of both sides
    outside the matched place, relative to the pairs; with fewer it is unknown whether the place is
    unique. share: of the landmarks of either side near the matched places (of the side that has
    fewer), how many are matched. A closure whose share falls below undone_below within `audited`
    ticks is undone.
    """

    gate: Positive = 13.8
    slack: NonNegative = 0.03
    density: Positive = 0.5
    llr_tight: float = 1.0
    llr_loose: float = 8.0
    odds: NonNegative = 4.0
    tight: Positive = 0.15
    near: Positive = 0.35
    same: Positive = 0.5
    recent: Few = 6
    absent: NonNegative = 1.5
    closure_pairs: Few = 10
    closure_llr: float = 25.0
    margin: NonNegative = 10.0
    ratio: Annotated[float, Meta(ge=1.0)] = 1.5
    island_pairs: Few = 8
    island_llr: float = 15.0
    context: NonNegative = 2.0
    share: Share = 0.7
    undone_below: Share = 0.5
    audited: Annotated[int, Meta(ge=0, le=1000)] = 12


DEFAULT_PROFILE = AssociationProfile()

SCALE_M = 0.03
"""The sensor error [m] of the default profile at the far end of its view."""


def profile_for(sensor: Sensor, farthest_m: float) -> AssociationProfile:
    """The default profile in the lengths of a sensor: times its error at the far end of its view.

    The error is √(σ_range² + (σ_bearing r)²) at r = farthest_m; in units of it the sensors that the
    default thresholds were found with, and simulated ones, need the same thresholds.
    """
    along = hypot(sensor.range_sigma, sensor.range_sigma_per_m * farthest_m)
    scale = max(hypot(along, sensor.bearing_sigma * farthest_m) / SCALE_M, 1.0)
    default = DEFAULT_PROFILE
    return msgspec.structs.replace(
        default,
        slack=default.slack * scale,
        density=default.density / scale**2,
        tight=default.tight * scale,
        near=default.near * scale,
        same=default.same * scale,
    )
