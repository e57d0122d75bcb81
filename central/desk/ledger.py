"""Ledger of a log: the disposition of every measurement (law 1), and the maps of every submap.

Measurements after the last submap are open if consumed, else lost.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from teamslam.central.desk.names import in_order
from teamslam.central.desk.verification.recorded import Recorded, RerunError
from teamslam.central.desk.verification.robot import run_alone
from teamslam.team.rejection import REJECTED
from teamslam.team.robot.ledger import IN_SIGHTING
from teamslam.team.store import Stream
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.arrays import ids

IN_SUBMAP, OPEN, LOST = "in a submap", "open", "lost"
MOST_LOST, MOST_LOST_SHARE = 1_000_000, 10
"""Limits on listed missing measurements: a number, or a multiple of the existing ones."""
SubmapName = tuple[str, int, int]


@dataclass(frozen=True)
class Entry:
    """Disposition of one measurement, and sequence of its submap."""

    disposition: str
    submap: int | None


@dataclass(frozen=True)
class Rejected:
    """A rejected measurement; kind: its message, as `observations`."""

    robot: str
    incarnation: int
    number: int
    stamp_s: float
    kind: str
    landmarks: tuple[int, ...]
    teammates: tuple[str, ...]
    reason: str


@dataclass(frozen=True)
class Outliers:
    """Number of detections that the window of a submap rejected as outliers."""

    robot: str
    incarnation: int
    submap: int
    start_s: float
    stamp_s: float
    detections: int


@dataclass(frozen=True)
class Ledger:
    """Entries by stream and counter, map digests by submap in log order, and violations.

    withdrawn: robots that the last map leaves out. rejected: by stream and number.
    """

    entries: Mapping[Stream, tuple[Entry, ...]]
    maps: Mapping[SubmapName, tuple[str, ...]]
    offenders: tuple[str, ...]
    withdrawn: tuple[str, ...] = ()
    rejected: tuple[Rejected, ...] = ()
    outliers: tuple[Outliers, ...] = ()

    @property
    def measurements(self) -> int:
        """Number of measurements of all robots."""
        return sum(len(entries) for entries in self.entries.values())

    def totals(self, robot: str | None = None) -> dict[str, int]:
        """Measurements by disposition, of one robot or all."""
        of = (entries for (name, _), entries in self.entries.items() if robot in (None, name))
        return dict(sorted(Counter(e.disposition for entries in of for e in entries).items()))

    def statement(self) -> str:
        """Describe the result in one sentence."""
        parts = ", ".join(f"{count:,} {name}" for name, count in self.totals().items())
        sentence = (
            f"each of {self.measurements:,} measurements has exactly one disposition: {parts}"
        )
        if not self.withdrawn:
            return sentence
        gone = sum(self.totals(robot).get(IN_SUBMAP, 0) for robot in self.withdrawn)
        gone_with = ", ".join(self.withdrawn)
        return f"{sentence}; {gone:,} of those in submaps are withdrawn with {gone_with}"

    def to_json(self) -> dict[str, Any]:
        """All entries as objects, submaps with number of measurements and maps."""
        counts = Counter((*of, e.submap) for of, own in self.entries.items() for e in own)
        robots = in_order({robot for robot, _ in self.entries})
        columns = "robot", "incarnation", "sequence"
        return {
            "measurements": self.measurements,
            "dispositions": self.totals(),
            "robots": {robot: self.totals(robot) for robot in robots},
            "submaps": [
                {**dict(zip(columns, n, strict=True)), "measurements": counts[n], "maps": maps}
                for n, maps in sorted(self.maps.items())
            ],
            "rejected": [asdict(each) for each in self.rejected],
            "outliers": [asdict(each) for each in self.outliers],
            "withdrawn": self.withdrawn,
            "offenders": self.offenders,
        }


def ledger(log: Recorded, progress: Callable[[str], None] = lambda _: None) -> Ledger:
    """Compute the ledger of a log; raises RerunError."""
    offenders = [
        f"measurement {each.number} of {_name((each.robot, each.incarnation))} is in the log twice "
        "with different contents"
        for each in log.contradicted
    ]
    entries = {}
    outliers: list[Outliers] = []
    for stream in sorted(log.measurements.keys() | log.submaps().keys()):
        progress(stream[0])
        submaps, wrong = _submaps_of(log, stream)
        entries[stream], more = _entries(log, stream, submaps)
        offenders += [*wrong, *more, *_contradictions(log, stream, entries[stream])]
        outliers += [
            Outliers(*stream, s.sequence, s.start_ns / 1e9, s.stamp_ns / 1e9, s.gated)
            for s in submaps
            if s.gated
        ]
    fused = log.of(m.FusedMap, ch.FUSED_MAP, ch.FINAL_MAP)
    maps, unknown = _maps(log, fused)
    rejected = tuple(_rejected(log, entries))
    withdrawn = fused[-1].withdrawn if fused else ()
    return Ledger(entries, maps, (*offenders, *unknown), withdrawn, rejected, tuple(outliers))


def _rejected(log: Recorded, entries: Mapping[Stream, Sequence[Entry]]) -> Iterator[Rejected]:
    for stream, own in entries.items():
        for number, entry in enumerate(own):
            if not entry.disposition.startswith(REJECTED):
                continue
            each = log.measurements[stream][number]
            yield Rejected(
                *stream,
                number,
                each.stamp_ns / 1e9,
                m.tag_of(type(each)).partition("/")[0],
                tuple(ids(each.ids, "ids").tolist()) if isinstance(each, m.AnyScan) else (),
                each.teammates if isinstance(each, m.Sightings) else (),
                entry.disposition.removeprefix(REJECTED),
            )


def _name(stream: Stream) -> str:
    return f"{stream[0]}, incarnation {stream[1]}"


def _submaps_of(log: Recorded, stream: Stream) -> tuple[list[m.Submap], list[str]]:
    found: dict[int, m.Submap] = {}
    wrong = []
    for submap in log.of(m.Submap, ch.SUBMAP):
        if (submap.robot, submap.incarnation) != stream:
            continue
        if found.setdefault(submap.sequence, submap) != submap:
            name = f"submap {submap.sequence} of {_name(stream)}"
            wrong.append(f"{name} is in the log twice with different contents")
    return [found[k] for k in sorted(found)], wrong


def _entries(
    log: Recorded, stream: Stream, submaps: list[m.Submap]
) -> tuple[tuple[Entry, ...], list[str]]:
    measurements: Mapping[int, m.Measurement] = log.measurements.get(stream, {})
    count = max(log.published.get(stream, 0), max(measurements, default=-1) + 1)
    if count > max(MOST_LOST, MOST_LOST_SHARE * len(measurements)):
        raise RerunError(
            f"{count:,} measurements of {_name(stream)}, are announced, "
            f"{len(measurements):,} are in the log: too many are missing to list"
        )
    holder: list[int | None] = [None] * count
    wrong = []
    for each in submaps:
        for counter in range(each.first_measurement, each.last_measurement + 1):
            if counter >= count:
                name = f"submap {each.sequence} of {_name(stream)}"
                wrong.append(f"{name} uses measurement {counter}, which the log does not have")
                break
            if holder[counter] is not None:
                wrong.append(
                    f"measurement {counter} of {_name(stream)} is in two submaps: "
                    f"{holder[counter]} and {each.sequence}"
                )
            holder[counter] = each.sequence
    computed = run_alone(log, *stream).dispositions
    last = max((s.last_measurement for s in submaps), default=-1)
    consumed = log.reported.get(stream, 0)
    entries = []
    for counter in range(count):
        submap = holder[counter]
        disposition = IN_SUBMAP if counter in measurements and submap is not None else LOST
        if counter < len(computed):
            disposition = computed[counter]
        if counter not in measurements and submap is not None:
            name = f"measurement {counter} of {_name(stream)}"
            wrong.append(f"{name} is in submap {submap}, but not in the log")
        elif disposition in (IN_SUBMAP, IN_SIGHTING) and submap is None:
            if counter < last:
                name = f"measurement {counter} of {_name(stream)}"
                wrong.append(f"{name} is behind its submaps and in none of them")
            disposition = OPEN if counter < consumed else LOST
        entries.append(Entry(disposition, submap))
    return tuple(entries), wrong


def _contradictions(log: Recorded, stream: Stream, entries: tuple[Entry, ...]) -> Iterator[str]:
    """Differences between a robot's `Done` and the ledger.

    A resumed robot counts earlier measurements as in submaps, so only its sum is compared.
    """
    for done in log.of(m.Done, ch.ROBOT_DONE):
        if (done.robot, done.incarnation) != stream:
            continue
        announced = {d.disposition: d.measurements for d in done.ledger}
        if sum(announced.values()) != done.measurements:
            yield f"{_name(stream)}: {done.measurements} measurements, {announced} dispositions"
        found = dict(Counter(entry.disposition for entry in entries[: done.measurements]))
        if "start pose" in announced and found != announced:
            yield f"{_name(stream)} reports {announced}, the log has {found}"


def _maps(
    log: Recorded, maps: Iterable[m.FusedMap]
) -> tuple[dict[SubmapName, tuple[str, ...]], list[str]]:
    users: dict[SubmapName, list[str]] = {
        (s.robot, s.incarnation, s.sequence): [] for s in log.of(m.Submap, ch.SUBMAP)
    }
    wrong = []
    for fused in maps:
        if fused.rule != "join":
            continue
        digest = fused.digest.hex()
        streams = Counter((x.robot, x.incarnation) for x in fused.members)
        wrong += [f"map {digest} counts {_name(s)} twice" for s, n in streams.items() if n > 1]
        wrong += [
            f"map {digest} uses submaps of {robot}, which it lists as withdrawn"
            for robot, _ in streams
            if robot in fused.withdrawn
        ]
        for member in fused.members:
            stream = member.robot, member.incarnation
            for sequence in range(member.sequence + 1):
                if (*stream, sequence) not in users:
                    what = f"submap {sequence} of {_name(stream)}"
                    wrong.append(f"map {digest} uses {what}, which is not in the log")
                    break
                users[*stream, sequence].append(digest)
    return {name: tuple(digests) for name, digests in users.items()}, wrong
