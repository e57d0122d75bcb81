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

    complete_at_s: wall time from log start to its final map. uplink, downlink: bytes of set
    messages published (each once) and received. have: submaps by robot. over: new members by
    relaying node. agrees: peers whose last summary named the same set.
    """

    final_map_sha256: str | None
    submaps: int
    complete_at_s: float | None
    uplink: int | None
    downlink: int | None
    agrees: int
    have: Mapping[str, int] = field(default_factory=dict)
    over: Mapping[str, int] = field(default_factory=dict)


def peer_results(log: Collected) -> dict[str, PeerResult]:
    """Result of every robot with a copy of the set."""
    found = {}
    for robot in log.robots:
        status = log.sound(log.latest.get(ch.STATUS.key(ch.robot_node(robot))))
        figures = status.figures if isinstance(status, m.Status) else {}
        if "set_submaps" not in figures:
            continue
        sample = log.latest.get(ch.CONCLUDED.key(robot))
        message = log.sound(sample)
        concluded = message if isinstance(message, m.Concluded) else None
        at_ns = 0 if sample is None else sample.wall_ns - (log.first_ns or sample.wall_ns)
        found[robot] = PeerResult(
            final_map_sha256=None if concluded is None else concluded.sha256.hex(),
            submaps=int(figures["set_submaps"]) if concluded is None else concluded.submaps,
            complete_at_s=None if concluded is None else at_ns * 1e-9,
            uplink=int(figures.get("set_uplink_bytes", 0.0)),
            downlink=int(figures.get("set_downlink_bytes", 0.0)),
            agrees=int(figures.get("set_agrees", 0.0)),
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


def peer_json(peer: PeerResult) -> dict[str, object]:
    """Figures under their JSON names."""
    return {
        "final_map_sha256": peer.final_map_sha256,
        "submaps": peer.submaps,
        "complete_at_s": peer.complete_at_s,
        "uplink_bytes": peer.uplink,
        "downlink_bytes": peer.downlink,
        "agrees_with": peer.agrees,
        "have": dict(peer.have),
        "over": dict(peer.over),
    }
