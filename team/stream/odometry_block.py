"""Many odometry intervals of one stream as arrays: from their payloads to one compiled call.

Odometry is most of what a robot measures, and hardly any of it leads to more than motion. Where
many intervals are at hand, in a log or in a queue, they are decoded together and taken together
(`RobotNode.drive_on`); whatever is not a plain interval is taken as every other message.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int64, UInt8

from team.estimation.compiled import compiled
from team.estimation.odometry import Intervals
from team.wire import messages as m

HEAD = b"\x98\xaa" + m.tag_of(m.Odometry).encode()
"""The beginning of an encoded `Odometry`: eight fields, the first of which is the tag."""


class OdometryBlock(NamedTuple):
    """Odometry of one incarnation by its numbers, which follow one another: `first`, `first` + 1 …

    Stamps and durations are in ns, speeds in m/s, yaw rates in rad/s, as in `Odometry`.
    """

    robot: str
    incarnation: int
    first: int
    stamps_ns: Int64[np.ndarray, " n"]
    durations_ns: Int64[np.ndarray, " n"]
    forward: Float[np.ndarray, " n"]
    yaw_rates: Float[np.ndarray, " n"]

    @property
    def size(self) -> int:
        """Number of intervals."""
        return len(self.stamps_ns)

    def part(self, begin: int, end: int) -> "OdometryBlock":
        """The intervals begin … end − 1."""
        if begin == 0 and end >= self.size:
            return self
        return OdometryBlock(
            self.robot,
            self.incarnation,
            self.first + begin,
            self.stamps_ns[begin:end],
            self.durations_ns[begin:end],
            self.forward[begin:end],
            self.yaw_rates[begin:end],
        )

    def message(self, k: int) -> m.Odometry:
        """The k-th interval as the message that it came in."""
        return m.Odometry(
            stamp_ns=int(self.stamps_ns[k]),
            robot=self.robot,
            incarnation=self.incarnation,
            number=self.first + k,
            duration_ns=int(self.durations_ns[k]),
            forward=float(self.forward[k]),
            yaw_rate=float(self.yaw_rates[k]),
        )

    def messages(self) -> Iterator[m.Odometry]:
        """All intervals as messages."""
        return (self.message(k) for k in range(self.size))

    def intervals(self, clock_offset_s: float) -> Intervals:
        """The intervals in team time, as `translate.interval_of` has each."""
        ends_ns = self.stamps_ns
        if clock_offset_s:
            ends_ns = ends_ns + round(clock_offset_s * 1e9)
        return Intervals(ends_ns, self.durations_ns, self.forward, self.yaw_rates)


class OdometryTable(NamedTuple):
    """Decoded odometry of one robot, a row each, in the order of the payloads.

    is_plain: whether a payload is an `Odometry` of that robot that every door lets in; the other
    rows are empty. incarnations, numbers: its name.
    """

    is_plain: Bool[np.ndarray, " n"]
    incarnations: Int64[np.ndarray, " n"]
    numbers: Int64[np.ndarray, " n"]
    stamps_ns: Int64[np.ndarray, " n"]
    durations_ns: Int64[np.ndarray, " n"]
    forward: Float[np.ndarray, " n"]
    yaw_rates: Float[np.ndarray, " n"]

    @classmethod
    def empty(cls) -> "OdometryTable":
        """A table without rows."""
        none = np.empty(0, np.int64)
        return cls(np.empty(0, np.bool_), none, none, none, none, np.empty(0), np.empty(0))

    def only(self, rows: Bool[np.ndarray, " n"]) -> "OdometryTable":
        """Some of the rows."""
        return OdometryTable(*(column[rows] for column in self))

    def block(self, robot: str, incarnation: int, begin: int, end: int) -> OdometryBlock:
        """The rows begin … end − 1, of one incarnation and with numbers that follow one another."""
        first = int(self.numbers[begin])
        return OdometryBlock(robot, incarnation, first, *(column[begin:end] for column in self[3:]))


def together(tables: Sequence[OdometryTable]) -> OdometryTable:
    """The rows of all tables, one table after the other."""
    columns = zip(*tables, strict=True)
    return OdometryTable(*(np.concatenate(column) for column in columns))


def decoded_odometry(robot: str, payloads: Sequence[bytes]) -> OdometryTable:
    """Decode what came on a robot's odometry key; what is not plain needs `bus.opened`."""
    ends = np.cumsum(np.fromiter(map(len, payloads), np.int64, len(payloads)))
    data = np.frombuffer(bytearray(b"".join(payloads)), np.uint8)
    name = robot.encode()
    key = np.frombuffer(bytearray(bytes([0xA0 | len(name)]) + name), np.uint8)
    return _decoded(data, ends, np.frombuffer(bytearray(HEAD), np.uint8), key)


@compiled
def _decoded(
    data: UInt8[np.ndarray, " bytes"],
    ends: Int64[np.ndarray, " n"],
    head: UInt8[np.ndarray, " head"],
    robot: UInt8[np.ndarray, " name"],
) -> OdometryTable:
    """MessagePack of [tag, stamp_ns, robot, incarnation, number, duration_ns, forward, yaw_rate],
    checked as the codec checks the fields; a name is shorter than 32 bytes.
    """
    n = len(ends)
    is_plain = np.zeros(n, np.bool_)
    whole = np.zeros((4, n), np.int64)
    speeds = np.zeros((2, n))
    begin = 0
    for k in range(n):
        end = ends[k]
        at = _behind(data, begin, end, head)
        stamp_ns, at = _integer(data, at, end)
        at = _behind(data, at, end, robot)
        incarnation, at = _integer(data, at, end)
        number, at = _integer(data, at, end)
        duration_ns, at = _integer(data, at, end)
        forward, at = _real(data, at, end)
        yaw_rate, at = _real(data, at, end)
        in_range = -(2**62) <= stamp_ns < 2**62 and 0 <= duration_ns < 2**62
        finite = -1e300 <= forward <= 1e300 and -1e300 <= yaw_rate <= 1e300
        if at == end and in_range and finite and incarnation >= 0 and number >= 0:
            is_plain[k] = True
            whole[0, k], whole[1, k] = incarnation, number
            whole[2, k], whole[3, k] = stamp_ns, duration_ns
            speeds[0, k], speeds[1, k] = forward, yaw_rate
        begin = end
    return OdometryTable(is_plain, whole[0], whole[1], whole[2], whole[3], speeds[0], speeds[1])


@compiled
def _behind(
    data: UInt8[np.ndarray, " bytes"], at: int, end: int, expected: UInt8[np.ndarray, " m"]
) -> int:
    """The place behind these bytes; −1 where others are."""
    if at < 0 or at + len(expected) > end:
        return -1
    for i in range(len(expected)):
        if data[at + i] != expected[i]:
            return -1
    return at + len(expected)


@compiled
def _integer(data: UInt8[np.ndarray, " bytes"], at: int, end: int) -> tuple[int, int]:
    """A MessagePack integer and the place behind it; −1 where there is none below 2⁶³."""
    if at < 0 or at >= end:
        return 0, -1
    kind = 0 + data[at]
    if kind < 0x80:
        return kind, at + 1
    if kind >= 0xE0:
        return kind - 0x100, at + 1
    if not 0xCC <= kind <= 0xD3:
        return 0, -1
    size = 1 << (kind & 3)
    if at + 1 + size > end:
        return 0, -1
    first = 0 + data[at + 1]
    is_signed = kind >= 0xD0
    if size == 8 and not is_signed and first >= 0x80:
        return 0, -1
    value = first - 0x100 if is_signed and first >= 0x80 else first
    for i in range(1, size):
        value = value * 256 + data[at + 1 + i]
    return value, at + 1 + size


@compiled
def _real(data: UInt8[np.ndarray, " bytes"], at: int, end: int) -> tuple[float, int]:
    """A MessagePack float of 64 bits and the place behind it; −1 where there is none."""
    if at < 0 or at + 9 > end or data[at] != 0xCB:
        return 0.0, -1
    bits = np.zeros(1, np.int64)
    for i in range(8):
        bits[0] = (bits[0] << 8) | data[at + 1 + i]
    return float(bits.view(np.float64)[0]), at + 9
