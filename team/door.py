"""Refuse messages that contradict the team: strangers, impossible counters, stamps.

No order of arrival makes a true message fail.
"""

from collections.abc import Iterable, Iterator, Mapping

from teamslam.team.config import MAP
from teamslam.team.wire import messages as m

MOST_LIVES = 1_000  # most incarnations of a stream
MOST_COUNT = 2**40  # largest counter: 348 years at 100 Hz
EARLY_NS = 86_400 * 10**9
LATE_NS = 400 * EARLY_NS
"""Stamps of a stream lie from EARLY_NS before to LATE_NS after that of its initial pose."""
OF_ROBOTS = (
    m.Measurement, m.Submap, m.SightingFactor, m.MapEstimate, m.Progress, m.Done, m.Rendezvous,
    m.Innovation, m.Association, m.StreamHead,
)  # fmt: skip
"""Messages of a stream, with robot and incarnation."""
COUNTERS: Mapping[type[m.Message], tuple[str, ...]] = {
    m.Submap: ("sequence", "last_measurement", "sightings"),
    m.SightingFactor: ("sequence",),
    m.Progress: ("measurements", "submaps"),
    m.StreamHead: ("measurements",),
    m.Done: ("measurements", "submaps", "steps"),
    m.MapEstimate: ("sequence", "exchange"),
}
"""Fields of messages that are bounded by MOST_COUNT."""


class Door:
    """The team's robots, and the start time of each stream."""

    def __init__(self, robots: Iterable[str]) -> None:
        self._robots = frozenset(robots)
        self._began: dict[tuple[str, int], int | None] = {}

    def admit(self, robot: str) -> None:
        """Add a robot to the team."""
        self._robots |= {robot}

    def refusal(self, message: m.Message) -> str | None:
        """Return the reason to refuse a message."""
        strangers = sorted(set(_robots(message)) - self._robots)
        if strangers:
            return f"of {', '.join(strangers)}, not in this team"
        refused = absurd(message)
        if refused is None and isinstance(message, m.InitialPose):
            self._note_beginning(message)
        return refused or self._another_time(message)

    def _note_beginning(self, start: m.InitialPose) -> None:
        """Store a stream's start time; two contradicting ones remove its bounds."""
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
    """Return the reason to refuse a stamp of a stream that began at this time."""
    after_ns = stamp_ns - began_ns
    if -EARLY_NS <= after_ns <= LATE_NS:
        return None
    return f"stamped {after_ns / EARLY_NS:.0f} days after its stream began"


def absurd(message: m.Message) -> str | None:
    """Return the reason to refuse a message with an unreachable count."""
    if (
        m.is_measurement(message)  # most messages are
        and message.incarnation <= MOST_LIVES
        and message.number <= MOST_COUNT
    ):
        return None
    lives = [message.incarnation] if isinstance(message, OF_ROBOTS) else []
    if isinstance(message, m.End):
        lives = [stream.incarnation for stream in message.streams]
    for incarnation in lives:
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


def _counts(message: m.Message) -> Iterator[int]:
    if m.is_measurement(message):
        yield message.number
    elif isinstance(message, m.End):
        yield from (stream.measurements for stream in message.streams)
    else:
        yield from (getattr(message, name) for name in COUNTERS.get(type(message), ()))
    if isinstance(message, m.SightingFactor):
        yield from message.measurements
