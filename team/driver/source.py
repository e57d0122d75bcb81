"""The source of a stream, a world or a driver: credit, batches and answers to requests."""

from collections.abc import Callable

from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.codec import encoded

CREDIT_MEASUREMENTS = 4096
"""Most measurements that a source is ahead of its robot, while that is present."""
CREDIT_RECORDER = 16384
"""Most measurements, over all robots, that a source is ahead of a present recorder."""
BATCH = 256  # measurements published between two checks of the inbox
ANSWER = 8192  # most measurements in one answer to a query
FIRST_INCARNATION = 1


def channel_of(measurement: m.Measurement) -> ch.Channel:
    """Return the channel on which a measurement is published."""
    return next(row for row in ch.SENSORS if isinstance(measurement, row.kinds))


def answer_request(
    requested: m.MeasurementsRequest, count: int, measurement: Callable[[int], m.Measurement]
) -> list[bytes]:
    """Encode the requested ones of `count` measurements, at most ANSWER."""
    last = count - 1 if requested.last < 0 else min(requested.last, count - 1)
    last = min(last, requested.first + ANSWER - 1)
    return [encoded(measurement(number)) for number in range(requested.first, last + 1)]
