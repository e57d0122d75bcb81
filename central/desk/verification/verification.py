"""Recompute every recomputable message of a log and compare.

Each message is computed from the inputs that it names, so an error appears in one message only:
submaps, own maps and poses from measurements; a team pose from its prior; maps, priors and
trajectories from the submaps of the map's version vector; exchanges from the recorded maps.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from functools import cache, partial
from multiprocessing import get_context
from typing import Any, get_type_hints

import msgspec
import numpy as np
from numpy.typing import NDArray

from teamslam.central.desk.verification.centre import recompute_centre, recompute_peer
from teamslam.central.desk.verification.recorded import (
    Identity,
    Recorded,
    RecordedOutput,
    RerunError,
    identity,
    index_log,
)
from teamslam.central.desk.verification.robot import recompute_robot
from teamslam.team.recording.parts import OWN
from teamslam.team.recording.provenance import provenance
from teamslam.team.recording.reader import Log
from teamslam.team.recording.tables import numbers_of
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.codec import encoded

RELATIVE = 1e-6
ABSOLUTE = 1e-9
"""Elsewhere: |a − b| ≤ ABSOLUTE·s + RELATIVE·|b|, s the array's largest magnitude (at least 1)."""
Field = tuple[str, str, str]
"""Name of a differing field, and the recorded and the recomputed value as text."""


@cache
def _arrays_of(kind: type[m.Message]) -> frozenset[str]:
    """Fields that are compared number by number; digests state their length."""
    hints = get_type_hints(kind, include_extras=True)
    return frozenset(name for name, hint in hints.items() if hint is bytes)


def _first_difference(recorded: m.Message, recomputed: m.Message, *, exact: bool) -> Field | None:
    arrays = _arrays_of(type(recorded))
    for name in recorded.__struct_fields__:
        a, b = getattr(recorded, name), getattr(recomputed, name)
        if a == b:
            continue
        if name in arrays:
            one, other = numbers_of(recorded, name), numbers_of(recomputed, name)
            found = _array_difference(name, one, other, exact=exact)
            if found is not None:
                return found
        elif exact or not _close(a, b):
            return name, _text(a), _text(b)
    return None


def _array_difference(name: str, a: NDArray[Any], b: NDArray[Any], *, exact: bool) -> Field | None:
    if len(a) != len(b):
        return name, f"{len(a)} numbers", f"{len(b)} numbers"
    if exact or a.dtype.kind != "f":
        bits = f"u{a.itemsize}"
        same = a.view(bits) == b.view(bits)
    else:
        scale = max(1.0, float(np.abs(b).max(initial=0.0)))
        same = np.isclose(a, b, RELATIVE, ABSOLUTE * scale)
    if same.all():
        return None
    k = int(np.argmin(same))
    return f"{name}[{k}]", repr(a[k].item()), repr(b[k].item())


def _close(a: object, b: object) -> bool:
    if isinstance(a, float) and isinstance(b, float):
        return math.isclose(a, b, rel_tol=RELATIVE, abs_tol=ABSOLUTE)
    if isinstance(a, tuple) and isinstance(b, tuple):
        return len(a) == len(b) and all(map(_close, a, b))
    if isinstance(a, msgspec.Struct) and type(a) is type(b):
        return _close(msgspec.structs.astuple(a), msgspec.structs.astuple(b))
    return a == b


def _text(value: object) -> str:
    if isinstance(value, bytes):
        return value.hex()
    if isinstance(value, msgspec.Struct | tuple):
        return str(msgspec.to_builtins(value))[:200]
    return repr(value)[:200]


PLATFORM = ("core", "estimation", "arithmetic", "version.numpy", "version.scipy")
"""Metadata that must be equal for equal bits (docs/decisions/32)."""
MAPS = (ch.FUSED_MAP, ch.FINAL_MAP, ch.TEAM_MAP, ch.TEAM_FINAL)
CHECKED = (
    ch.SUBMAP, ch.ASSOCIATION, ch.SIGHTING_FACTOR, ch.OWN_MAP, ch.OWN_POSE, ch.TEAM_POSE,
    ch.ROBOT_DONE, ch.FUSED_MAP, ch.PRIOR, ch.TRAJECTORY, ch.FINAL_MAP, ch.PARTICLES, ch.INNOVATION,
    ch.CENTRAL_POSE, ch.TEAM_MAP, ch.TEAM_PRIOR, ch.TEAM_TRAJECTORY, ch.TEAM_FINAL,
)  # fmt: skip
"""Channels in order of cause and effect."""


@dataclass(frozen=True)
class Difference:
    """Recorded message that differs from the recomputed one; lacks: an input is not in the log."""

    key: str
    stamp_ns: int
    counter: int
    names: str
    field: str
    recorded: str
    recomputed: str
    lacks: bool = False

    def __str__(self) -> str:
        return (
            f"{self.key} at {self.stamp_ns * 1e-9:.3f} s, counter {self.counter} ({self.names}): "
            f"{self.field} is {self.recorded} in the log, {self.recomputed} when computed again"
        )


@dataclass(frozen=True)
class ChannelResult:
    """Counts of one channel's messages; first: that differs, or else that lacks an input."""

    channel: str
    messages: int
    equal: int
    close: int
    first: Difference | None
    lacking: int = 0

    @property
    def different(self) -> int:
        """Number of messages that differ."""
        return self.messages - self.equal - self.close - self.lacking


@dataclass(frozen=True)
class Verification:
    """Result of recomputing a log.

    other_platform: metadata in which this platform differs; if any, numbers have a tolerance.
    span_s: team time between first and last measurement.
    """

    channels: tuple[ChannelResult, ...]
    other_platform: tuple[str, ...]
    measurements: int
    span_s: float
    unsound: int

    @property
    def first(self) -> Difference | None:
        """First difference, causes first; else the first that lacks an input."""
        found = [c.first for c in self.channels if c.first is not None]
        return min(found, key=lambda each: each.lacks, default=None)

    @property
    def messages(self) -> int:
        """Number of compared messages."""
        return sum(c.messages for c in self.channels)


Part = Callable[[], Mapping[Identity, m.Message]]
"""Messages of one node, recomputed from the log alone."""


def verify(log: Log, processes: int = 1) -> Verification:
    """Recompute a log and compare. Raises RerunError, LogError.

    processes: most forked processes; above 1 this process may hold no lock in a thread.
    """
    here = provenance()
    other = tuple(name for name in PLATFORM if log.metadata.get(name) != here[name])
    found = index_log(log)
    recomputed: dict[Identity, m.Message] = {}
    others = _teammates_of(log, found)
    own = [robot for robot in found.robots if robot not in others]
    parts: list[Part] = [partial(recompute_robot, found, robot) for robot in own]
    parts.append(partial(recompute_centre, found))
    parts += [partial(recompute_peer, found, robot) for robot in own]
    for messages in _compute_parts(parts, processes):
        recomputed |= messages
    results = []
    for channel in CHECKED:
        of_channel = found.outputs_of(channel)
        outputs = [each for each in of_channel if getattr(each.message, "robot", "") not in others]
        if outputs:
            results.append(_compared(channel.name, outputs, recomputed, found, exact=not other))
    spans = [stream.span_ns for stream in found.measurements.values()]
    span_s = (max(s[1] for s in spans) - min(s[0] for s in spans)) * 1e-9 if spans else 0.0
    count = sum(map(len, found.measurements.values()))
    return Verification(tuple(results), other, count, span_s, found.unsound)


def _compute_parts(parts: Sequence[Part], processes: int) -> Iterator[Mapping[Identity, m.Message]]:
    if processes == 1:
        yield from (part() for part in parts)
        return
    pool = ProcessPoolExecutor(processes, get_context("fork"), _inherited.extend, (parts,))
    try:
        # The centre, which is last, takes longest.
        begun = [pool.submit(_compute_part, number) for number in reversed(range(len(parts)))]
        yield from (each.result() for each in reversed(begun))
    except BrokenProcessPool:
        raise RerunError(
            "a process that recomputed a node was killed, perhaps for its memory: on one "
            "processor, as by `taskset -c 0`, one process recomputes all nodes"
        ) from None
    finally:
        pool.shutdown(cancel_futures=True)


_inherited: list[Part] = []  # parts of a forked process


def _compute_part(number: int) -> Mapping[Identity, m.Message]:
    return _inherited[number]()


def _teammates_of(log: Log, found: Recorded) -> frozenset[str]:
    """Teammates in a robot's own log, which are not verified."""
    if OWN not in log.metadata:
        return frozenset()
    there = frozenset(r for r in found.robots if ch.robot_node(r) in found.configured)
    return frozenset(found.robots) - there if there else frozenset()


def _compared(
    name: str,
    outputs: list[RecordedOutput],
    recomputed: Mapping[Identity, m.Message],
    log: Recorded,
    *,
    exact: bool,
) -> ChannelResult:
    equal = close = 0
    differences = []
    for each in outputs:
        again = recomputed.get(identity(each.sample.key, each.message))
        if again is not None and encoded(again) == each.sample.payload:
            equal += 1
        elif (difference := _difference(each, again, log, exact=exact)) is None:
            close += 1
        else:
            differences.append(difference)
    first = min(differences, key=lambda d: (d.lacks, d.stamp_ns, d.key), default=None)
    lacking = sum(d.lacks for d in differences)
    return ChannelResult(name, len(outputs), equal, close, first, lacking)


def _difference(
    output: RecordedOutput, recomputed: m.Message | None, log: Recorded, *, exact: bool
) -> Difference | None:
    lacks = None
    if recomputed is None:
        lacks = _lacking(output.message, log)
        field: Field = ("the message", "there", "none" if lacks is None else f"{lacks}: none")
    else:
        differs = _first_difference(output.message, recomputed, exact=exact)
        if differs is None and not exact:
            return None
        field = differs or ("the encoding", "another", "the program's")
    sample, names = output.sample, _names(output.message)
    where = sample.key, sample.stamp_ns, sample.counter
    return Difference(*where, names, *field, lacks=lacks is not None)


def _names(message: m.Message) -> str:
    if isinstance(message, m.FusedMap):
        return f"map {message.digest.hex()}"
    sequence = getattr(message, "sequence", None)
    named = "" if sequence is None else f", sequence {sequence}"
    return f"incarnation {getattr(message, 'incarnation', None)}{named}"


def _lacking(message: m.Message, log: Recorded) -> str | None:
    match message:
        case m.PoseEstimate() if any(message.map_digest):
            priors = log.of(m.Prior, ch.PRIOR, ch.TEAM_PRIOR)
            if message.map_digest not in {p.digest for p in priors if p.robot == message.robot}:
                return f"no prior {message.map_digest.hex()} in the log"
            return _gap(log, message)
        case m.Prior() | m.Trajectory():
            fused = {each.digest: each for each in log.of(m.FusedMap, *MAPS)}.get(message.digest)
            if fused is None:
                return f"no map {message.digest.hex()} in the log"
            return _lacking(fused, log)  # its map lacks an input
        case m.FusedMap():
            found = log.submaps()
            for each in message.members:
                there = found.get((each.robot, each.incarnation), {})
                gone = next((k for k in range(each.sequence + 1) if k not in there), None)
                if gone is not None:
                    of = f"{each.robot}, incarnation {each.incarnation}"
                    return f"submap {gone} of {of}, is not in the log"
            return None
        case _:
            return _gap(log, message)


def _gap(log: Recorded, message: m.Message) -> str | None:
    robot, incarnation = getattr(message, "robot", ""), getattr(message, "incarnation", None)
    for stream in sorted(log.measurements):
        if stream[0] != robot or incarnation not in {None, stream[1]}:
            continue
        there = log.measurements[stream]
        lost = next((n for n in range(there.last) if n not in there), None)
        before = None if lost is None else there.get(lost - 1)
        if lost is not None and (before is None or before.stamp_ns <= message.stamp_ns):
            return f"measurement {lost} is not in the log"
    return None
