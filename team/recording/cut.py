"""Cut an interval of team time, or some channels, into a new log."""

from collections.abc import Collection, Iterator
from pathlib import Path

from teamslam.team.recording.reader import Log, LogError
from teamslam.team.recording.recorder import Recorder
from teamslam.team.recording.summary import summarise_log
from teamslam.team.wire import channels as ch
from teamslam.team.wire.bus import Sample

CUT = "cut"  # metadata name that marks a cut, with the original log
STANDING = frozenset(
    channel.name
    for channel in (ch.ROBOT_CONFIG, ch.CENTRAL_CONFIG, ch.WORLD_CONFIG, ch.TRUTH_LANDMARKS)
)
"""Channels whose messages stay valid, so a cut includes earlier ones."""


def cut(
    log: Log,
    out: str | Path,
    from_s: float | None = None,
    to_s: float | None = None,
    channels: Collection[ch.Channel] | None = None,
) -> int:
    """Write the samples of [from_s, to_s) on these channels to a new log; return their number.

    Times are seconds of team time since the first measurement; None: no bound. Earlier messages of
    `STANDING` channels are included. Raises `LogError`, before creating `out`, for an empty result
    or a damaged log.
    """
    summary = summarise_log(log)
    if summary.damaged:
        raise LogError(log.path, summary.damaged[0], "`teamslam log repair` saves the rest")
    span = summary.span_ns()
    if span is None:
        raise LogError(log.path, "no message in it", "give a log that has some")
    begin, end = (None if s is None else span[0] + round(s * 1e9) for s in (from_s, to_s))
    beyond = (begin is not None and begin > span[1]) or (end is not None and end <= span[0])
    if beyond or not any(True for _ in _within(log, begin, end, channels)):
        seconds = (span[1] - span[0]) * 1e-9
        remedy = (
            f"its measurements are from 0 to {seconds:.3f} s; `teamslam log info` has its channels"
        )
        raise LogError(log.path, "nothing of it is in this cut", remedy)
    note = _note(log.path.name, span[0], from_s, to_s, channels)
    notes = "; ".join(filter(None, (log.metadata.get(CUT), note)))
    count = 0
    with Recorder(out, log.team, {**log.metadata, CUT: notes}) as recorder:
        for sample in _within(log, begin, end, channels):
            recorder.write([sample])
            count += 1
    return count


def _within(
    log: Log, begin_ns: int | None, end_ns: int | None, channels: Collection[ch.Channel] | None
) -> Iterator[Sample]:
    for sample in log.samples(channels):
        if end_ns is not None and sample.stamp_ns >= end_ns:
            continue
        row = ch.row_of(sample.key)
        stands = row is not None and row.name in STANDING
        if begin_ns is None or sample.stamp_ns >= begin_ns or stands:
            yield sample


def _note(
    name: str,
    start_ns: int,
    from_s: float | None,
    to_s: float | None,
    channels: Collection[ch.Channel] | None,
) -> str:
    begin, end = ("" if s is None else f"{s:g}" for s in (from_s, to_s))
    names = "all channels" if channels is None else ", ".join(each.name for each in channels)
    return f"{name}: [{begin}, {end}) s since {start_ns} ns, {names}"
