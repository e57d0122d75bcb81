"""Peers of a log: final map, its time, and traffic of the set."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from teamslam.central.desk.evaluation.log import Collected
from teamslam.team.wire import channels as ch
from teamslam.team.wire import messages as m

_OF, _OVER, _OVER_BYTES = "set_submaps.", "set_over.", "set_over_bytes."


@dataclass(frozen=True, kw_only=True)
class PeerResult:
    """Announced conclusion of one peer.

    complete_at_s: wall time from log start to its final map. have: submaps by robot. over: new
    members by relaying node. agrees_with: number of peers with the same set.
    """

    final_map_sha256: str | None
    submaps: int
    complete_at_s: float | None
    uplink_bytes: int | None
    downlink_bytes: int | None
    agrees_with: int
    have: Mapping[str, int] = field(default_factory=dict)
    over: Mapping[str, int] = field(default_factory=dict)


def peer_results(log: Collected) -> dict[str, PeerResult]:
    """Result of every robot with a copy of the set."""
    found = {}
    for robot in log.robots:
        status = log.newest(ch.STATUS, m.Status, ch.robot_node(robot))
        figures = {} if status is None else status.figures
        if "set_submaps" not in figures:
            continue
        sample = log.latest.get(ch.CONCLUDED.key(robot))
        concluded = log.newest(ch.CONCLUDED, m.Concluded, robot)
        at_ns = 0 if sample is None else sample.wall_ns - (log.first_ns or sample.wall_ns)
        found[robot] = PeerResult(
            final_map_sha256=None if concluded is None else concluded.sha256.hex(),
            submaps=int(figures["set_submaps"]) if concluded is None else concluded.submaps,
            complete_at_s=None if concluded is None else at_ns * 1e-9,
            uplink_bytes=int(figures.get("set_uplink_bytes", 0.0)),
            downlink_bytes=int(figures.get("set_downlink_bytes", 0.0)),
            agrees_with=int(figures.get("set_agrees", 0.0)),
            have=_named(figures, _OF),
            over=_named(figures, _OVER),
        )
    return found


def _named(figures: Mapping[str, float], prefix: str) -> dict[str, int]:
    return {
        name.removeprefix(prefix): int(value)
        for name, value in figures.items()
        if name.startswith(prefix)
    }
