"""Thresholds of data association between submaps, one profile for each kind of sensor."""

from math import hypot
from typing import Annotated

import msgspec
from msgspec import Meta

from teamslam.team.config import GATE, NonNegative, Positive, Sensor, Share

Few = Annotated[int, Meta(ge=1, le=1000)]


class AssociationProfile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Thresholds for merging landmarks without identities; lengths in metres.

    LLR: log-likelihood ratio of one landmark against two. Derivations:
    docs/notes/association-with-undo.md.
    """

    gate: Positive = GATE  # χ² of 2 degrees of freedom beyond which two landmarks are not one
    slack: NonNegative = 0.03
    """Difference between two submaps' positions of one landmark beside their covariance."""
    density: Positive = 0.5  # expected landmarks per square metre, λ
    llr_tight: float = 1.0
    """LLR required of a pair whose difference has a standard deviation below `tight`."""
    llr_loose: float = 8.0  # LLR required of any other pair
    odds: NonNegative = 4.0  # LLR required beyond that of the best rival
    tight: Positive = 0.15
    near: Positive = 0.35
    """Largest standard deviation for which old landmarks are candidates without a closure."""
    same: Positive = 0.5  # largest distance of two landmarks that may be one that was split
    recent: Few = 6  # number of a robot's last submaps that are tracked and searched for closures
    absent: NonNegative = 1.5
    """Cost of a landmark that the other side lacks although it observed the place: −ln of the
    probability."""
    closure_pairs: Few = 10  # fewest pairs of a closure
    closure_llr: float = 25.0
    """Least evidence of a closure: the sum of the pairs' LLR less the cost of absent landmarks."""
    margin: NonNegative = 10.0  # least evidence beyond that of the best other alignment
    ratio: Annotated[float, Meta(ge=1.0)] = 1.5
    """Least evidence relative to that of the best other alignment."""
    island_pairs: Few = 8  # closure_pairs between robots with unknown initial poses
    island_llr: float = 15.0  # closure_llr between robots with unknown initial poses
    context: NonNegative = 2.0
    """Fewest landmarks outside the matched place, relative to the pairs; with fewer the place may
    not be unique. 0: not tested. A saved map needs none where `share` of the overlap is matched."""
    share: Share = 0.7
    """Least share of matched landmarks near the matched places, on the side with fewer."""
    undone_below: Share = 0.5
    """A closure whose share falls below this within `audited` ticks is undone."""
    audited: Annotated[int, Meta(ge=0, le=1000)] = 12


DEFAULT_PROFILE = AssociationProfile()

SCALE_M = 0.03  # sensor error [m] of the default profile at the far end of its view


LENGTHS = ("slack", "density", "tight", "near", "same")  # the thresholds that `profile_for` scales


def has_default_lengths(profile: AssociationProfile) -> bool:
    """Return whether a profile states none of its lengths."""
    return all(getattr(profile, name) == getattr(DEFAULT_PROFILE, name) for name in LENGTHS)


def profile_for(
    sensor: Sensor, farthest_m: float, profile: AssociationProfile = DEFAULT_PROFILE
) -> AssociationProfile:
    """Scale the lengths of a profile by √(σ_range² + (σ_bearing r)²) at r = farthest_m."""
    along = hypot(sensor.range_sigma, sensor.range_sigma_per_m * farthest_m)
    scale = max(hypot(along, sensor.bearing_sigma * farthest_m) / SCALE_M, 1.0)
    lengths = {name: getattr(profile, name) * scale for name in LENGTHS}
    lengths["density"] = profile.density / scale**2
    return msgspec.structs.replace(profile, **lengths)
