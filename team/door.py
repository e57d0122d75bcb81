"""Refuse messages that are valid but contradict the team: strangers, impossible counters, stamps.

The bounds are so wide that no order of arrival makes a true message fail.
"""

from collections.abc import Iterable, Iterator

from teamslam.team.config import MAP
from teamslam.team.wire import messages as m

MOST_LIVES = 1_000
"""Most incarnations of a stream."""
MOST_COUNT = 2**40
"""Largest counter: 348 years at 100 Hz."""
EARLY_NS = 86_400 * 10**9
LATE_NS = 400 * EARLY_NS
"""Stamps of a stream lie from EARLY_NS before to LATE_NS after that of its initial pose."""
OF_ROBOTS = (
    m.Measurement, m.Submap, m.SightingFactor, m.MapEstimate, m.Progress, m.Done, m.Rendezvous,
    m.Innovation, m.Association, m.StreamHead,
)  # fmt: skip
"""Messages of a stream, with robot and incarnation."""


class Door:
    """The team's robots, and the start time of each stream."""

    def __init__(self, robots: Iterable[str]) -> None:
        self._robots = frozenset(robots)
        self._began: dict[tuple[str, int], int | None] = {}

    def admit(self, robot: str) -> None:
        """Add a robot to the team."""
        self._robots |= {robot}

    def refusal(self, message: m.Message) -> str | None:
        """Return the reason to refuse a message; None: accepted."""
        strangers = sorted(set(_robots(message)) - self._robots)
        if strangers:
            return f"of {', '.join(strangers)}, not in this team"
        refused = absurd(message)
        if refused is None and isinstance(message, m.InitialPose):
            self._note_beginning(message)
        return refused or self._another_time(message)

    def _note_beginning(self, start: m.InitialPose) -> None:
        """Store a stream's start time; two contradicting ones, one of them forged, remove its
        bounds.
        """
        stream = (start.robot, start.incarnation)
        known = self._began.setdefault(stream, start.stamp_ns)
        if known is not None and another_time(start.stamp_ns, known) is not None:
            self._began[stream] = None

    def _another_time(self, message: m.Message) -> str | None:
        if not isinstance(message, OF_ROBOTS):
            return None
        began = self._began.get((message.robot, message.incarnation))
        return None if began is None else another_time(message.stamp_ns, began)


def another_time(stamp_ns: int, began_ns: int) -> str | None:
    """Return the reason to refuse a stamp of a stream that began at this time; None: accepted."""
    after_ns = stamp_ns - began_ns
    if -EARLY_NS <= after_ns <= LATE_NS:
        return None
    return f"stamped {after_ns / EARLY_NS:.0f} days after its stream began"


def absurd(message: m.Message) -> str | None:
    """Return the reason to refuse a message with an unreachable count; None: accepted."""
    if (
        m.is_measurement(message)  # most messages are
        and message.incarnation <= MOST_LIVES
        and message.number <= MOST_COUNT
    ):
        return None
    for incarnation in _lives(message):
        if incarnation > MOST_LIVES:
            return f"of incarnation {incarnation}; no stream has more than {MOST_LIVES}"
    for count in _counts(message):
        if count > MOST_COUNT:
            return f"counts to {count}; {MOST_COUNT} at most"
    return None


def _robots(message: m.Message) -> Iterator[str]:
    match message:
        case m.SightingFactor():
            yield message.robot
            if not message.teammate.startswith(MAP):
                yield message.teammate
        case m.End():
            yield from (stream.robot for stream in message.streams)
        case m.Withdrawal() if not message.robot.startswith(MAP):
            yield message.robot
        case m.Verdict():
            yield from (message.judgement.first.robot, message.judgement.second.robot)
        case _ if isinstance(message, OF_ROBOTS):
            yield message.robot


def _lives(message: m.Message) -> Iterator[int]:
    if isinstance(message, m.End):
        yield from (stream.incarnation for stream in message.streams)
    elif isinstance(message, OF_ROBOTS):
        yield message.incarnation


def _counts(message: m.Message) -> Iterator[int]:
    match message:
        case m.Measurement():
            yield message.number
        case m.Submap():
            yield from (message.sequence, message.last_measurement, message.sightings)
        case m.SightingFactor():
            yield from (message.sequence, *message.measurements)
        case m.Progress():
            yield from (message.measurements, message.submaps)
        case m.StreamHead():
            yield message.measurements
        case m.Done():
            yield from (message.measurements, message.submaps, message.steps)
        case m.MapEstimate():
            yield from (message.sequence, message.exchange)
        case m.End():
            yield from (stream.measurements for stream in message.streams)
        case _:
            pass
