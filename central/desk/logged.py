"""Samples of a log that several readers take in one pass, each decoded once."""

from collections.abc import Iterable, Iterator
from functools import cached_property

from teamslam.central.desk.peers_as_centre import PeersAsCentre
from teamslam.team.recording.inventory import Head, numbered_in
from teamslam.team.wire import messages as m
from teamslam.team.wire.bus import Sample, try_open
from teamslam.team.wire.channels import Channel


class Logged:
    """A sample, decoded on demand."""

    def __init__(self, sample: Sample) -> None:
        self.sample = sample

    @cached_property
    def opened(self) -> tuple[Channel, str, m.Message] | None:
        """Channel, name and message; None if the sample is invalid or of no channel."""
        return try_open(self.sample)

    @property
    def message(self) -> m.Message | None:
        """Message of a valid sample."""
        return None if self.opened is None else self.opened[2]

    @property
    def numbered(self) -> Head | m.Measurement | None:
        """Robot, incarnation and number of a measurement, also of one with invalid contents."""
        message = self.message
        if message is None or not m.is_measurement(message):
            return numbered_in(self.sample.payload)
        return message


def read_logged(
    samples: Iterable[Sample], centre: PeersAsCentre
) -> Iterator[tuple[Logged, Logged | None]]:
    """Yield each sample, and the same as a centre would publish it, if it does."""
    for sample in samples:
        as_centre = centre.of(sample)
        yield Logged(sample), None if as_centre is None else Logged(as_centre)
