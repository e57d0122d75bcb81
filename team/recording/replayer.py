"""Replay schedule of a log's samples: a function of their stamps alone."""

from collections.abc import Iterable, Iterator

from teamslam.team.wire.bus import Sample


def schedule(samples: Iterable[Sample], speed: float) -> Iterator[tuple[float, Sample]]:
    """(delay [s] after the previous one, sample), in the given order, at `speed` × team time.

    delay = max(0, t − newest stamp so far)/speed: late samples and the first one are published at
    once, and delays sum to the elapsed team time. Infinite speed has no delay. Raises ValueError
    unless speed > 0.
    """
    if not speed > 0.0:
        raise ValueError(f"out of bounds: speed {speed} is not positive")
    newest: int | None = None
    for sample in samples:
        ahead_ns = 0 if newest is None else max(0, sample.stamp_ns - newest)
        newest = sample.stamp_ns if newest is None else max(newest, sample.stamp_ns)
        yield 1e-9 * ahead_ns / speed, sample
