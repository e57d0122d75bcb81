"""A member of the team's set: a message's original bytes and its name in the set."""

from dataclasses import dataclass
from functools import cached_property

from teamslam.team.core import blake2b
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.bus import NO_COUNTER, Sample, opened

STREAMED = (ch.START, ch.SUBMAP, ch.SIGHTING_FACTOR)
STATED = (
    ch.ROBOT_DONE, ch.ORDER, ch.GIVEN_UP, ch.VERDICT, ch.SAVED_MAP, ch.CONCLUDED, ch.CERTIFICATE,
)  # fmt: skip
CHANNELS = (*STREAMED, *STATED)  # channels whose messages are members
LARGEST_MEMBER = 4 * 2**20  # most bytes of a member; a submap of 1000 landmarks has 2·10⁶
LARGEST_SIGNATURE = 8192
"""Most bytes of a member's signature; an operator's includes its certificate."""


@dataclass(frozen=True)
class Member:
    """One member; `signature` is its author's, empty in a team without keys."""

    key: str
    payload: bytes
    message: m.Message
    signature: bytes = b""

    @cached_property
    def hash(self) -> bytes:
        """32 bytes that identify key and payload."""
        named = len(self.key).to_bytes(2, "little") + self.key.encode() + self.payload
        return blake2b(named, 32)

    @property
    def size(self) -> int:
        """Approximate size on the wire and on disk [bytes]."""
        return len(self.key) + len(self.payload) + len(self.signature)

    def as_sample(self, now_ns: int) -> Sample:
        """Convert to a sample that arrives now (wall clock [ns])."""
        return Sample(self.key, self.payload, self.message.stamp_ns, now_ns, NO_COUNTER)


def member_of(key: str, payload: bytes, signature: bytes = b"") -> Member:
    """Decode and check a member; raises WireError or ValueError."""
    for size, most in ((len(payload), LARGEST_MEMBER), (len(signature), LARGEST_SIGNATURE)):
        if size > most:
            raise ValueError(f"too large: {size} bytes, {most} at most")
    channel, _, message = opened(Sample(key, payload, 0, 0, -1))
    if channel not in CHANNELS:
        raise ValueError(f"wrong field: {key[:80]!r} is no key of a set's members")
    return Member(key, payload, message, signature)


def about(message: m.Message) -> str:
    """Return the robot or saved map that a member is about."""
    if isinstance(message, m.GivenUp):
        return ch.robot_of(message.node) or ""
    if isinstance(message, m.SavedMap):
        return message.author
    return str(getattr(message, "robot", ""))
