"""Append-only log of the members of all unnamed landmarks, in shared arrays.

A longer log shares all but its last rows with the log before, so checkpoints store no row twice and
a tick costs the time of its own submaps.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from teamslam.team.config import UNNAMED
from teamslam.team.estimation.contribution import Stream
from teamslam.team.shapes import Bool, UInt32

KINDS = ("track", "near", "sweep", "closure", "merge", "verdict")  # the steps that merge landmarks
RUN = 64  # submaps of a stream whose rows are stored together
CHUNK = 4096  # given numbers that are stored together
LAST = 11  # last members of a landmark in its summary

Rows = np.ndarray
"""The unnamed landmarks of one submap, ascending by local number, as records of `ROW`."""
ROW = np.dtype(
    [
        ("local", np.uint32),
        ("number", np.uint32),
        ("step", np.uint8),
        ("into", np.uint32),
        ("into_stream", np.uint16),
        ("into_sequence", np.uint32),
        ("into_local", np.uint32),
        ("llr", np.float64),
        ("rival", np.float64),
        ("sd", np.float64),
        ("stamp_ns", np.int64),
    ]
)
"""step: 1 + the index in KINDS of the step that merged the landmark into another; 0: none."""
NO_ROWS: Rows = np.zeros(0, ROW)


class LocalLandmark(NamedTuple):
    """One local landmark of one submap."""

    robot: str
    incarnation: int
    sequence: int
    local: int

    def __str__(self) -> str:
        """Format as `r1/1/12/7`: robot, incarnation, sequence of the submap, local landmark."""
        return f"{self.robot}/{self.incarnation}/{self.sequence}/{self.local}"


class MergeRecord(NamedTuple):
    """The step that merged a set into another one, and its figures.

    stamp_ns: last end of a submap in the tick.
    """

    kind: str
    into: int
    llr: float
    rival: float
    sd: float
    stamp_ns: int


class MemberRecord(NamedTuple):
    """A member of a landmark; tie: the merge by which it lost its own number."""

    name: LocalLandmark
    tie: MergeRecord | None = None


class MemberSummary(NamedTuple):
    """Number, first and last members of a landmark, by name."""

    size: int
    first: MemberRecord
    last: tuple[MemberRecord, ...] = ()

    def merge(self, others: "MemberSummary") -> "MemberSummary":
        """Merge with the members of another landmark."""
        first, *rest = sorted((self.first, others.first, *self.last, *others.last))
        return MemberSummary(self.size + others.size, first, tuple(rest[-LAST:]))


@dataclass(frozen=True, eq=False)
class MemberLog:
    """Each stream's rows in runs of submaps, by sequence; all given numbers in sorted chunks."""

    streams: tuple[Stream, ...] = ()
    runs: tuple[tuple[tuple[Rows, ...], ...], ...] = ()
    chunks: tuple[UInt32[np.ndarray, " _"], ...] = ()

    def rows(self, stream: Stream, sequence: int) -> Rows:
        """Return the rows of a submap; none if it has no unnamed landmark or is absent."""
        if stream not in self.streams:
            return NO_ROWS
        runs = self.runs[self.streams.index(stream)]
        of_run = runs[sequence // RUN] if sequence // RUN < len(runs) else ()
        return of_run[sequence % RUN] if sequence % RUN < len(of_run) else NO_ROWS

    def all_rows(self) -> Iterator[tuple[Stream, int, Rows]]:
        """Yield stream, sequence and rows of each submap, by the streams' names."""
        for stream in sorted(self.streams):
            for k, of_run in enumerate(self.runs[self.streams.index(stream)]):
                for n, rows in enumerate(of_run):
                    yield stream, RUN * k + n, rows

    def mark_given(self, numbers: UInt32[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
        """Mark the numbers that are in the log."""
        found = np.zeros(len(numbers), np.bool_)
        for chunk in self.chunks:
            at = np.minimum(np.searchsorted(chunk, numbers), len(chunk) - 1)
            found |= chunk[at] == numbers
        return found

    def add_submap(
        self, stream: Stream, sequence: int, locals_: Sequence[int], numbers: Sequence[int]
    ) -> "MemberLog":
        """Append the unnamed landmarks of one submap."""
        rows = np.zeros(len(numbers), ROW)
        rows["local"], rows["number"] = locals_, numbers
        log = self._write(stream, sequence, rows)
        *full, last = log.chunks or (rows["number"][:0],)
        more = np.sort(np.concatenate([last, rows["number"]]))
        chunks = (*full, more) if len(last) < CHUNK else (*full, last, np.sort(rows["number"]))
        return replace(log, chunks=chunks)

    def record_merge(
        self, member: LocalLandmark, tie: MergeRecord, into: LocalLandmark | None
    ) -> "MemberLog":
        """Record that a member has lost its number to `tie.into`.

        into: the member of that number; None for a name.
        """
        stream = (member.robot, member.incarnation)
        rows = self.rows(stream, member.sequence).copy()
        where = (0, 0, 0)
        if into is not None:
            of = self.streams.index((into.robot, into.incarnation))
            where = (of, into.sequence, into.local)
        at = int(np.searchsorted(rows["local"], member.local))
        step = 1 + KINDS.index(tie.kind)
        figures = (tie.llr, tie.rival, tie.sd, tie.stamp_ns)
        rows[at] = (member.local, rows["number"][at], step, tie.into, *where, *figures)
        return self._write(stream, member.sequence, rows)

    def _write(self, stream: Stream, sequence: int, rows: Rows) -> "MemberLog":
        streams, runs = self.streams, list(self.runs)
        if stream not in streams:
            streams = (*streams, stream)
            runs.append(())
        own = list(runs[streams.index(stream)])
        k, n = divmod(sequence, RUN)
        own += [()] * (k + 1 - len(own))
        of_run = list(own[k])
        of_run += [NO_ROWS] * (n + 1 - len(of_run))
        of_run[n] = rows
        own[k] = tuple(of_run)
        runs[streams.index(stream)] = tuple(own)
        return MemberLog(streams, tuple(runs), self.chunks)

    def identity(self, member: LocalLandmark) -> int | None:
        """Look up the number or name of a member's landmark; None for an unknown member."""
        while True:
            rows = self.rows((member.robot, member.incarnation), member.sequence)
            at = int(np.searchsorted(rows["local"], member.local))
            if at == len(rows) or rows["local"][at] != member.local:
                return None
            row = rows[at]
            if not row["step"]:
                return int(row["number"])
            if int(row["into"]) < UNNAMED:
                return int(row["into"])
            robot, incarnation = self.streams[row["into_stream"]]
            there = int(row["into_sequence"]), int(row["into_local"])
            member = LocalLandmark(robot, incarnation, *there)

    def identities(self) -> dict[int, int]:
        """Tabulate the identity of each number ever given."""
        into: dict[int, int] = {}
        numbers: list[int] = []
        for _, _, rows in self.all_rows():
            numbers += rows["number"].tolist()
            gone = rows[rows["step"] > 0]
            into |= zip(gone["number"].tolist(), gone["into"].tolist(), strict=True)
        found: dict[int, int] = {}
        for number in numbers:
            path = [number]
            while path[-1] in into and path[-1] not in found:
                path.append(into[path[-1]])
            last = found.get(path[-1], path[-1])
            found |= dict.fromkeys(path, last)
        return found


def record_of(stream: Stream, sequence: int, row: Sequence[Any]) -> MemberRecord:
    """Convert a row of the log to its member."""
    local, _, step, into, *_, llr, rival, sd, stamp_ns = row
    name = LocalLandmark(*stream, sequence, local)
    tie = MergeRecord(KINDS[step - 1], into, llr, rival, sd, stamp_ns) if step else None
    return MemberRecord(name, tie)
