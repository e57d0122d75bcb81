"""The origin of a team's frame on the Earth."""

from typing import Annotated

import msgspec
from msgspec import Meta


class Datum(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Origin of a tangent plane on WGS84: x east, y north; height above the ellipsoid."""

    latitude_deg: Annotated[float, Meta(ge=-89.0, le=89.0)]
    longitude_deg: Annotated[float, Meta(ge=-180.0, le=180.0)]
    height_m: Annotated[float, Meta(ge=-1e4, le=1e5)] = 0.0
