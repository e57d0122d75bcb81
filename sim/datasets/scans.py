"""A robot's measurements by row."""

from dataclasses import dataclass, fields, replace

import numpy as np

from teamslam.sim.world.streams import Detections, grouped
from teamslam.team.shapes import Bool, Float, Int64, UInt32


@dataclass(frozen=True)
class Scans:
    """Measurements by time; ids: landmarks, teammate indices, or UTIAS subjects."""

    stamps_ns: Int64[np.ndarray, " R"]
    ids: UInt32[np.ndarray, " R"]
    ranges: Float[np.ndarray, " R"]
    bearings: Float[np.ndarray, " R"]
    points: Float[np.ndarray, "R 2"] | None = None
    covariances: Float[np.ndarray, "R 3"] | None = None

    def where(self, chosen: Bool[np.ndarray, " R"]) -> "Scans":
        """Chosen rows."""
        columns = {field.name: getattr(self, field.name) for field in fields(self)}
        given = {name: values[chosen] for name, values in columns.items() if values is not None}
        return replace(self, **given)

    def grouped(self) -> Detections:
        """One message per stamp and form."""
        return grouped(
            self.stamps_ns, self.ids, self.ranges, self.bearings, self.points, self.covariances
        )


def first_of_each(
    stamps_ns: Int64[np.ndarray, " R"],
    ids: UInt32[np.ndarray, " R"],
    usable: Bool[np.ndarray, " R"],
) -> Bool[np.ndarray, " R"]:
    """Mask of the first usable row of each (stamp, id)."""
    rows = np.flatnonzero(usable)
    order = rows[np.lexsort((ids[rows], stamps_ns[rows]))]
    repeated = (np.diff(stamps_ns[order]) == 0) & (np.diff(ids[order].astype(np.int64)) == 0)
    single = usable.copy()
    single[order[1:][repeated]] = False
    return single


def on_circle(angles: Float[np.ndarray, "*N"]) -> Float[np.ndarray, "*N"]:
    """Wrap to (−π, π], leaving the bits of angles inside."""
    turned = (angles + np.pi) % (2.0 * np.pi) - np.pi
    turned = np.where(turned == -np.pi, np.pi, turned)
    return np.where((angles > -np.pi) & (angles <= np.pi), angles, turned)


def count_note(count: int, thing: str, what: str) -> str:
    """Note such as "2 measurements dropped"; empty for none."""
    return f"{count} {thing}{'s' if count != 1 else ''} {what}" if count else ""
