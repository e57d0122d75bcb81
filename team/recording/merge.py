"""Merge logs of several robots, or parts of one log."""

from collections.abc import Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import NamedTuple

from teamslam.team.recording.reader import Log, LogError
from teamslam.team.recording.recorder import Recorder
from teamslam.team.wire.bus import Sample
from teamslam.team.wire.channels import SENSORS, SIGHTING_FACTOR, SUBMAP, channel_of

_BY_CONTENT = (*SENSORS, SUBMAP, SIGHTING_FACTOR)
MERGED = "merged"  # metadata name that lists the merged logs


class Merged(NamedTuple):
    """Numbers of written messages and of omitted duplicates."""

    messages: int
    duplicates: int


def merge(logs: Sequence[Log], out: str | Path) -> Merged:
    """Write each sample once to a new log `out`, in order of team time, all in memory at once.

    Equal key, counter, wall clock and payload are one publication; measurements, submaps and
    inter-robot measurements are compared by content. Raises `LogError`, before creating `out`, for
    logs of different teams or a damaged one.
    """
    first = logs[0]
    for log in logs[1:]:
        if log.team != first.team:
            what = f"a log of team {log.team!r}, not {first.team!r} as {first.path} is"
            raise LogError(log.path, what, "merge the logs of one team")
    read = list(chain.from_iterable(log.samples() for log in logs))
    once = sorted(_once(read), key=lambda sample: sample.stamp_ns)
    with Recorder(out, first.team, merged_metadata(logs)) as recorder:
        recorder.write(once)
    return Merged(len(once), len(read) - len(once))


def merged_metadata(logs: Sequence[Log]) -> dict[str, str]:
    """Merge metadata: entries on which all logs agree, others as `name@file`, `name@1:file`."""
    files = [log.path.name for log in logs]
    if len(set(files)) < len(files):
        files = [f"{i}:{file}" for i, file in enumerate(files, 1)]
    named = dict(zip(files, (log.metadata for log in logs), strict=True))
    merged: dict[str, str] = {}
    for name in dict.fromkeys(chain.from_iterable(named.values())):
        values = {f"{name}@{file}": own[name] for file, own in named.items() if name in own}
        distinct = set(values.values())
        merged |= values if len(distinct) > 1 else {name: distinct.pop()}
    return {**merged, MERGED: ", ".join(files)}


def _once(samples: Sequence[Sample]) -> Iterator[Sample]:
    seen: set[tuple[object, ...]] = set()
    for sample in samples:
        row = channel_of(sample.key)
        by_content = row is not None and row[0] in _BY_CONTENT
        published = () if by_content else (sample.counter, sample.wall_ns)
        name = (sample.key, sample.payload, *published)
        if name not in seen:
            seen.add(name)
            yield sample
