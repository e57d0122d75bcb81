"""Common part of the comparison centres without submaps."""

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

from teamslam.central.node import CentralNode
from teamslam.team.wire import channels as ch
from teamslam.team.wire import messages as m
from teamslam.team.wire.bus import Outgoing

if TYPE_CHECKING:
    from teamslam.central.desk.verification.recorded import Recorded


class ComparisonCentre(CentralNode):
    """A centre that neither acknowledges nor awaits submaps.

    landmarks: number in its newest map.
    """

    landmarks = 0

    @property
    def figures(self) -> Mapping[str, float]:
        """Figures for viewers."""
        return {}

    @property
    def findings(self) -> tuple[str, ...]:
        """Warnings for readers of the map."""
        return ()

    def publish_newest(self) -> list[Outgoing]:
        """Do nothing: maps follow the method's clock."""
        return []

    def has_received(self, done: m.Done) -> bool:
        """True: no submap is awaited."""
        return True

    def lacking(self) -> list[m.SubmapsRequest]:
        """No requests: no submap is awaited."""
        return []

    def recomputed(
        self, log: "Recorded", maps: Sequence[m.FusedMap], finals: Sequence[m.FusedMap]
    ) -> Iterator[Outgoing]:
        """Recompute recorded maps from their named inputs."""
        raise NotImplementedError


def recorded_maps(log: "Recorded", fused: m.FusedMap) -> list[m.MapEstimate]:
    """The robots' own maps that a recorded map names."""
    own = (x for x in log.of(ch.OWN_MAP) if isinstance(x, m.MapEstimate))
    by_name = {(x.robot, x.incarnation, x.sequence, x.exchange): x for x in own}
    names = ((x.robot, x.incarnation, x.sequence, fused.exchange) for x in fused.members)
    return [by_name[name] for name in names if name in by_name]
