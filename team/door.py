"""Refuses messages that are valid in themselves and can not be true of this team.

A stranger, or a broken robot, may name unknown robots, incarnations and counters that can not be
reached, stamps that are years away. A node gives the reason by `refusal`; the boundary
(`team.containment`) counts it and names it in the node's status; the recorder keeps everything.
Every bound is far beyond what a team does, so that no order of arrival makes a true message fail.
"""

from collections.abc import Iterable, Iterator

from team.wire import messages as m

MOST_LIVES = 1_000
"""Most incarnations of a stream; each begins because the source has lost requested measurements."""
MOST_COUNT = 2**40
"""Largest value of any counter; at 100 Hz it is reached after 348 years."""
EARLY_NS = 86_400 * 10**9
LATE_NS = 400 * EARLY_NS
"""A stream's messages lie within a day before and 400 days after its initial pose's stamp."""
OF_ROBOTS = (
    m.Measurement, m.Submap, m.SightingFactor, m.MapEstimate, m.Progress, m.Done, m.Rendezvous,
    m.Innovation, m.Association, m.StreamHead,
)  # fmt: skip
"""Messages about a stream: they have its robot and its incarnation."""


class Door:
    """Knows the team's robots, and when each stream began according to its source."""

    def __init__(self, robots: Iterable[str]) -> None:
        self._robots = frozenset(robots)
        self._began: dict[tuple[str, int], int | None] = {}

    def admit(self, robot: str) -> None:
        """From now on the robot is in the team."""
        self._robots |= {robot}

    def refusal(self, message: m.Message) -> str | None:
        """Why the message can not be true of this team, in words; None if it can."""
        strangers = sorted(set(_robots(message)) - self._robots)
        if strangers:
            return f"of {', '.join(strangers)}, not in this team"
        refused = absurd(message)
        if refused is None and isinstance(message, m.InitialPose):
            self._note_beginning(message)
        return refused or self._another_time(message)

    def _note_beginning(self, start: m.InitialPose) -> None:
        """Note when a stream begins; one that two messages begin at two times has no bounds.

        One of the two is a stranger's, and its source's own messages must pass.
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
    """Why a stamp can not be of a stream that began at this time, in words."""
    after_ns = stamp_ns - began_ns
    if -EARLY_NS <= after_ns <= LATE_NS:
        return None
    return f"stamped {after_ns / EARLY_NS:.0f} days after its stream began"


def absurd(message: m.Message) -> str | None:
    """Why a count is absurd, in words."""
    if (
        isinstance(message, m.Measurement)  # most messages are
        and message.incarnation <= MOST_LIVES
        and message.number <= MOST_COUNT
    ):
        return None
    for incarnation in _lives(message):
        if incarnation > MOST_LIVES:
            return f"of incarnation {incarnation}; no stream has more than {MOST_LIVES}"
    for count in _counts(message):
        if count > MOST_COUNT:
            return f"counts to {count}; nobody has come further than {MOST_COUNT}"
    return None


def _robots(message: m.Message) -> Iterator[str]:
    """The robots that a message names as the team's."""
    match message:
        case m.SightingFactor():
            yield from (message.robot, message.teammate)
        case m.End():
            yield from (stream.robot for stream in message.streams)
        case m.Withdrawal():
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
