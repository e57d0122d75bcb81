"""The fault boundary around a node: a message whose handling raises is set aside.

It is published as `Fault`, counted, and ignored when it is delivered again. An interrupt or an exit
ends the process.
"""

import traceback
from collections.abc import Callable
from dataclasses import dataclass, field
from types import TracebackType
from typing import Protocol, TypeVar, runtime_checkable

from teamslam.team.core import blake2b
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.bus import Outgoing, Sample, opened
from teamslam.team.wire.codec import WireError, decoded, encoded
from teamslam.team.wire.logs import LOG, cut, one_line

M = TypeVar("M", bound=m.Message)
MOST_ANSWERS = 1000  # most attempts of a node to continue after one message
LONGEST_TEXT = 1000  # longest text of an exception or a key in a fault [characters]
_OURS = ("teamslam.",)


@runtime_checkable
class Handler(Protocol):
    """A handler of messages, with optional methods.

    refusal(message): why to refuse it, or None. handle_sample(message, sample): in place of
    `handle`. set_aside(message, why): the messages after an exception.
    """

    def handle(self, message: m.Message) -> list[Outgoing]:
        """Handle one message; return the answers."""


@dataclass
class Boundary:
    """Pass messages to one node; aside: key and digest of those not handled again."""

    name: str
    faults: int = 0
    refused: int = 0
    last: str = ""
    last_refused: str = ""
    aside: set[tuple[str, bytes]] = field(default_factory=set)

    def take(self, node: Handler, sample: Sample) -> list[Outgoing]:
        """Decode a sample and let the node handle it; return the answers."""
        message = self.let_in(sample, lambda: opened(sample)[2])
        return message if isinstance(message, list) else self.hand(node, message, sample)

    def let_in(self, sample: Sample, open_: Callable[[], M]) -> M | list[Outgoing]:
        """Decode a sample; return the messages to publish if it is invalid."""
        try:
            return open_()
        except WireError as error:
            self.refuse(sample, str(error))
        except Exception as error:
            return [self.note(error, sample, "")]
        return []

    def hand(
        self, node: Handler, message: m.Message, sample: Sample | None = None
    ) -> list[Outgoing]:
        """Let the node handle a message; return the answers, or the fault and the replacement."""
        if self.aside and _name(sample or sample_of(message)) in self.aside:
            return []
        try:
            refusal = getattr(node, "refusal", None)
            refused = None if refusal is None else refusal(message)
            if refused is not None:
                self.refuse(sample or sample_of(message), refused)
                return []
            handle_sample = getattr(node, "handle_sample", None)
            if handle_sample is not None:
                out: list[Outgoing] = handle_sample(message, sample or sample_of(message))
                return out
            return node.handle(message)
        except Exception as error:
            return self._set_aside(node, message, sample or sample_of(message), error)

    def _set_aside(
        self, node: Handler, message: m.Message, sample: Sample, error: Exception
    ) -> list[Outgoing]:
        tag = m.tag_of(type(message))
        out = [self.note(error, sample, tag)]
        self.aside.add(_name(sample))
        set_aside = getattr(node, "set_aside", None)
        if set_aside is None:
            return out
        for _ in range(MOST_ANSWERS):
            try:
                return [*out, *set_aside(message, self.last)]
            except Exception as again:
                out.append(self.note(again, sample, tag))
        return out

    def refuse(self, sample: Sample, why: str) -> None:
        """Count and log a refused message."""
        self.refused += 1
        self.last_refused = one_line(f"{cut(sample.key, 80)}: {cut(why, 200)}")
        LOG.warning("%s: dropped %s (%d so far)", self.name, self.last_refused, self.refused)

    def note(self, error: Exception, sample: Sample, tag: str) -> Outgoing:
        """Count and log a fault; return its message. Re-raises KeyboardInterrupt."""
        if _is_interrupt(error):
            raise KeyboardInterrupt from error
        self.faults += 1
        place = place_of(error.__traceback__)
        text = one_line(cut(str(error), LONGEST_TEXT))
        key = one_line(cut(sample.key, LONGEST_TEXT))
        what = f"{tag} " if tag else ""
        self.last = f"{what}{cut(key, 80)}: {type(error).__name__} at {place}: {cut(text, 200)}"
        LOG.error("set aside: %s", self.last)
        LOG.debug("%s", "".join(traceback.format_exception(error)))
        fault = m.Fault(
            stamp_ns=min(max(sample.stamp_ns, -(2**62)), 2**62 - 1),
            node=self.name,
            origin=key,
            count=max(sample.counter, -1),
            message=tag,
            error=type(error).__name__,
            text=text,
            place=place,
            digest=_name(sample)[1],
        )
        return Outgoing(ch.FAULT, self.name, fault)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Numbers of refused messages and faults, in words."""
        dropped = f"{self.refused} dropped at the door, the last: {self.last_refused}"
        raised = f"{self.faults} set aside after a fault, the last: {self.last}"
        return (*([dropped] if self.refused else ()), *([raised] if self.faults else ()))


def sample_of(message: m.Message) -> Sample:
    """Convert a message that came without a sample, on no key."""
    return Sample(m.tag_of(type(message)), encoded(message), 0, 0, -1)


def reply_of(payload: bytes, expected: type[M]) -> M:
    """Decode a reply; raises WireError if it is invalid or of another type."""
    message: m.Message = decoded(payload)
    if not isinstance(message, expected):
        expected_tag = expected.__name__
        raise WireError("wrong tag", f"a reply is {type(message).__name__}, no {expected_tag}")
    return message


def place_of(trace: TracebackType | None) -> str:
    """Return module:function:line of the innermost frame of our packages, else of all."""
    frames = [(f.f_globals.get("__name__", "?"), f.f_code.co_qualname, line)
              for f, line in traceback.walk_tb(trace)]  # fmt: skip
    ours = [frame for frame in frames if f"{frame[0]}.".startswith(_OURS)]
    module, function, line = (ours or [("?", "?", 0), *frames])[-1]
    return cut(f"{module}:{function}:{line}", LONGEST_TEXT)


def _is_interrupt(error: BaseException | None) -> bool:
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None


def _name(sample: Sample) -> tuple[str, bytes]:
    return sample.key, blake2b(sample.payload, 8)
