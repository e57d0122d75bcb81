"""State of a running team: last node statuses, map, process events."""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cached_property
from typing import TYPE_CHECKING

from teamslam.central.desk.names import in_order
from teamslam.central.desk.peers_as_centre import PeersAsCentre
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.bus import Bus, Sample, open_printable
from teamslam.team.wire.codec import WireError
from teamslam.team.wire.message_order import is_newer_map

if TYPE_CHECKING:
    from teamslam.sim.launch.live_errors import LiveErrors
    from teamslam.team.keys.signing import Signer

TURN_S = 0.1
DRIVERS = "drivers"  # node name of all drivers of a live team
UNIX_S = 1e9  # team times from here on are Unix times: 1e9 s is in 2001
SILENT_S = 10.0  # driver silence [s] that is reported; a status is due each second
COMPARED = (ch.START, ch.TRUTH, ch.TRUTH_LANDMARKS, ch.OWN_POSE, ch.TEAM_POSE)
"""Channels of `LiveErrors`, besides the fused map's."""
_PROGRESS = ("measurements", "submaps", "messages")  # status figures that grow with progress


@dataclass
class Watch:
    """State of a running team.

    drivers: awaited ones of a live team. place: options by which other commands reach the team;
    call: the same for a driver's program. last_message: time of each node's last status. peers:
    robots that need a final map; concluded: those that have it, since concluded_s. centre: presents
    peers' messages as a centre's.
    """

    statuses: dict[str, m.Status] = field(default_factory=dict)
    fused: m.FusedMap | None = None
    failures: list[str] = field(default_factory=list)
    began: float = field(default_factory=time.monotonic)
    robots: tuple[str, ...] = ()
    place: str = ""
    call: str = ""
    notes: list[str] = field(default_factory=list)
    restarts: dict[str, int] = field(default_factory=dict)
    given_up: list[str] = field(default_factory=list)
    last_message: dict[str, float] = field(default_factory=dict)
    drivers: tuple[str, ...] | None = None
    peers: frozenset[str] = frozenset()
    concluded: dict[str, m.Concluded] = field(default_factory=dict)
    concluded_s: dict[str, float] = field(default_factory=dict)
    signer: "Signer | None" = None
    centre: PeersAsCentre = field(default_factory=PeersAsCentre)

    @property
    def world(self) -> m.Status | None:
        """The world's status, or the sum of the drivers'."""
        if self.drivers is None:
            return self.statuses.get("world")
        statuses = [s for node, s in self.statuses.items() if node.startswith("source/")]
        figures = {
            "of": sum(status.figures.get("measurements", 0.0) for status in statuses),
            "team_time_s": max((s.figures.get("team_time_s", 0.0) for s in statuses), default=0.0),
        }
        states = {status.state for status in statuses}
        return m.Status(
            stamp_ns=max((status.stamp_ns for status in statuses), default=0),
            node=DRIVERS,
            state=states.pop() if len(states) == 1 else "measuring" if states else "waiting",
            figures=figures,
            warnings=tuple(self._drivers_lacking(statuses)),
        )

    def _drivers_lacking(self, statuses: Sequence[m.Status]) -> Iterator[str]:
        missing = in_order(set(self.drivers or ()) - {_robot(status) for status in statuses})
        if missing:
            first = missing[0]
            yield (
                f"waiting for the driver{'s' * (len(missing) > 1)} of {', '.join(missing)}: start "
                f'the program that has Driver("{first}", {self.call}), or, of a ROS 2 robot, '
                f"teamslam driver {first} --ros2 FILE {self.place}; teamslam end --without "
                f"{first} {self.place} goes on without it"
            )
        now = time.monotonic()
        for status in sorted(statuses, key=_robot):
            robot = _robot(status)
            silent = now - self.last_message.get(status.node, now) > SILENT_S
            if status.state == "left" or (silent and status.state != "ended"):
                yield (
                    f"the driver of {robot} is away: start it again with its file, or go on by "
                    f"teamslam end --without {robot} {self.place}"
                )
            elif status.state == "waiting":
                yield f"the driver of {robot} is running and has sent no odometry yet"

    @cached_property
    def errors(self) -> "LiveErrors":
        """Errors so far; NumPy is loaded when all processes run."""
        from teamslam.sim.launch.live_errors import LiveErrors

        return LiveErrors()

    @property
    def missing_robots(self) -> list[str]:
        """Robots without a status."""
        return [each for each in self.robots if f"robot/{each}" not in self.statuses]

    @property
    def end_reason(self) -> str:
        """Why the run ended."""
        if self.is_over:
            return "the final map is there"
        if self.given_up:
            return f"{', '.join(self.given_up)} was given up"
        return "all processes have ended, without a final map"

    @property
    def is_over(self) -> bool:
        """Whether the centre's final map exists, or that of every peer."""
        if not self.peers:
            return self.fused is not None and self.fused.final
        for name in self.given_up:
            self.centre.agreement.excuse(name.removeprefix("robot-"))
        needed = self.centre.agreement.needed
        return bool(needed) and self.concluded.keys() >= set(needed)

    def take(self, bus: Bus) -> None:
        """Process newly arrived messages."""
        for sample in bus.receive(TURN_S):
            self._take(sample)
            counterpart = self.centre.of(sample) if self.peers else None
            if counterpart is not None:
                self._take(counterpart)

    def _take(self, sample: Sample) -> None:
        found = ch.channel_of(sample.key)
        if found is None or (found[0] in COMPARED and not self.errors.wants(*found, sample)):
            return
        try:
            channel, _, message = open_printable(sample)
        except WireError:
            return
        if isinstance(message, m.Status):
            self.statuses[message.node] = message
            self.last_message[message.node] = time.monotonic()
        elif isinstance(message, m.FusedMap) and channel in (ch.FUSED_MAP, ch.FINAL_MAP):
            self.fused = message if is_newer_map(message, self.fused) else self.fused
        elif isinstance(message, m.Fault):
            self._take_fault(message)
        elif isinstance(message, m.Concluded):
            self.concluded[message.robot] = message
            self.concluded_s.setdefault(message.robot, time.monotonic() - self.began)
        if channel in (*COMPARED, ch.FUSED_MAP, ch.FINAL_MAP):
            self.errors.take(channel, message)

    def _take_fault(self, fault: m.Fault) -> None:
        named = f"{fault.node} set aside "
        if not any(failure.startswith(named) for failure in self.failures):
            what = f"{fault.origin}: {fault.error} at {fault.place}: {fault.text}"
            self.failures.append(f"{named}{what}")

    def note(self, text: str) -> None:
        """Record a process event."""
        elapsed = time.monotonic() - self.began
        self.notes.append(f"at {elapsed:.1f} s {text}")

    def progress(self, node: str) -> float:
        """Progress by the last status; of the router, the team's."""
        names = list(self.statuses) if node == "router" else [node]
        statuses = [self.statuses[name] for name in names if name in self.statuses]
        figures = [status.figures.get(name, 0.0) for status in statuses for name in _PROGRESS]
        return sum(figures)


def _robot(status: m.Status) -> str:
    return status.node.removeprefix("source/")


def team_time(world: m.Status) -> str:
    """Team time as text; Unix time as UTC."""
    seconds = world.figures.get("team_time_s", 0.0)
    if seconds < UNIX_S:
        return f"team time {seconds:,.0f} s"
    return f"team time {datetime.fromtimestamp(seconds, UTC):%Y-%m-%d %H:%M:%S} UTC"
