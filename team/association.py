"""Thresholds of data association between submaps: one profile for each kind of sensor."""

from math import hypot
from typing import Annotated

import msgspec
from msgspec import Meta

from team.config import GATE, NonNegative, Positive, Sensor, Share

Few = Annotated[int, Meta(ge=1, le=1000)]


class AssociationProfile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Thresholds by which landmarks without identities are merged; lengths in metres.

    Pairs of landmarks:
    gate: χ² (2 degrees of freedom) beyond which two are not one landmark: `GATE`.
    slack: standard deviation beside the covariance by which two submaps' positions of one landmark
        differ: SCALE_M.
    density: λ, upper bound of the expected landmarks per square metre; the map's own density
        replaces it where it is larger, or known.
    llr_tight, llr_loose: log-likelihood ratio that a pair needs where the standard deviation of its
        difference is below `tight`, and elsewhere.
    odds: how much more it needs than its best rival [nat]; 4 are odds of 55 to 1.
    near: up to this standard deviation old landmarks are candidates without a closure.
    same: two landmarks nearer than this may be parts of one.
    recent: number of a robot's last submaps that tracking follows, and that are the patch of a
        closure.

    Closures:
    absent: cost of a landmark that one side has where the other side observed and has none,
        −ln P(missed); 1.5 is P = 0.22.
    closure_pairs, closure_llr: least number of pairs, and least evidence (the sum of their
        log-likelihood ratios less the cost of absent landmarks).
    margin, ratio: how much more evidence than the best other alignment, and how many times as much.
    island_pairs, island_llr: as closure_*, between robots with unknown initial poses.
    context: least number of landmarks of both sides outside the matched place, relative to the
        pairs; with fewer nothing shows whether the place is unique.
    share: least share of the landmarks near the matched places, of the side that has fewer, that
        are matched.
    undone_below, audited: a closure whose share falls below this within so many ticks is undone.

    Thresholds without a derivation are empirical; their evidence is in
    docs/decisions/29-association-in-the-fold.md. `tight`, `same` and `slack` are reduced where a
    map's landmarks stand closer (`team.estimation.association.density`).
    """

    gate: Positive = GATE
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
    """Scale the lengths of the default profile with a sensor's error at the far end of its view.

    The error is √(σ_range² + (σ_bearing r)²) at r = farthest_m, and at least SCALE_M; in units of
    it real and simulated sensors need the same thresholds.
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
