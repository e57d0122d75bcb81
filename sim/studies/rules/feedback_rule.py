"""Rules that fuse whole maps which the robots absorb, in lockstep.

The fused map replaces the robots' landmarks, so under `kalman` and `kalman-per-axis` measurements
are counted repeatedly, and the covariance has no meaning.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

import msgspec

from teamslam.central.config import CentralConfig
from teamslam.central.fused_map import fused_message
from teamslam.sim.studies.rules.centre import ComparisonCentre, recorded_maps
from teamslam.sim.studies.rules.map_fusion import (
    covariance_intersection,
    fuse_maps,
    kalman,
    kalman_per_axis,
)
from teamslam.sim.studies.rules.map_rules import members_of, value_of
from teamslam.team.estimation.gaussian import NO_LANDMARKS, LandmarkGaussian
from teamslam.team.wire import channels as ch
from teamslam.team.wire import messages as m
from teamslam.team.wire.bus import Outgoing
from teamslam.team.wire.digest import digest_of

if TYPE_CHECKING:
    from teamslam.central.desk.verification.recorded import Recorded

RULES: Mapping[str, Callable[[Sequence[LandmarkGaussian]], LandmarkGaussian]] = {
    "kalman": kalman,
    "kalman-per-axis": kalman_per_axis,
    "covariance-intersection": covariance_intersection,
}
_NOT_VALID = "this rule counts measurements more than once: its covariance is not valid"


class RoundsCentre(ComparisonCentre):
    """Fusion of each round's maps in the order of names; stores submaps for restarted robots."""

    inputs = (ch.START, ch.SUBMAP, ch.OWN_MAP)

    def __init__(
        self, config: CentralConfig, robots: Sequence[str], *, admit: bool = False
    ) -> None:
        super().__init__(config, robots, admit=admit)
        self._rounds: dict[int, dict[str, m.MapEstimate]] = {}
        self._next = 1
        self._fused: m.FusedMap | None = None

    def file(self, message: m.Message) -> list[Outgoing]:
        """File a map under its round."""
        if isinstance(message, m.MapEstimate):
            if message.exchange >= self._next:
                self._rounds.setdefault(message.exchange, {})[message.robot] = message
        elif isinstance(message, m.InitialPose | m.Submap):
            self.store.add(message)
        return []

    def publish_due(self) -> list[Outgoing]:
        """Make the map of every complete round, after a restart from the present one on."""
        later = min(self._rounds, default=self._next)
        if self._is_complete(later):
            self._next = later
        out = []
        while self._is_complete(self._next):
            maps = self._rounds.pop(self._next)
            out.append(self._fuse(self._next, [maps[robot] for robot in sorted(maps)]))
            self._next += 1
        return out

    def publish_final(self) -> list[Outgoing]:
        """The last round's map as the final one."""
        return [Outgoing(ch.FINAL_MAP, "", self._final(self.attendance.now_ns))]

    def recomputed(
        self, log: "Recorded", maps: Sequence[m.FusedMap], finals: Sequence[m.FusedMap]
    ) -> Iterator[Outgoing]:
        """Recompute the rounds in order from their recorded maps."""
        for fused in sorted(maps, key=lambda each: each.exchange):
            yield self._fuse(fused.exchange, recorded_maps(log, fused))
        for fused in finals:
            yield Outgoing(ch.FINAL_MAP, "", self._final(fused.stamp_ns))

    def _is_complete(self, number: int) -> bool:
        maps = self._rounds.get(number, {})
        return bool(maps) and all(
            r in maps or not self.attendance.takes_part(r) for r in self.robots
        )

    def _final(self, now_ns: int) -> m.FusedMap:
        last = self._fused
        if last is None:
            last = self._message(0, now_ns, (), NO_LANDMARKS, b"")
        counted_often = self.config.fusion != "covariance-intersection"
        reasons = (*last.reasons, *([_NOT_VALID] if counted_often else []))
        return msgspec.structs.replace(last, final=True, reasons=reasons)

    def _fuse(self, number: int, maps: Sequence[m.MapEstimate]) -> Outgoing:
        values = {x.robot: value_of(x) for x in maps}
        value, refused = fuse_maps(
            RULES[self.config.fusion], values, self.config.bounds.coordinate_m
        )
        payload = b"".join(x.ids + x.means + x.covariance for x in maps)
        previous = b"" if self._fused is None else self._fused.digest
        stamp_ns = max(x.stamp_ns for x in maps)
        self._fused = self._message(
            number, stamp_ns, members_of(maps), value, payload + previous, refused
        )
        return Outgoing(ch.FUSED_MAP, "", self._fused)

    def _message(
        self,
        number: int,
        stamp_ns: int,
        members: tuple[m.VersionEntry, ...],
        value: LandmarkGaussian,
        inputs: bytes,
        reasons: tuple[str, ...] = (),
    ) -> m.FusedMap:
        self.landmarks = len(value.ids)
        return fused_message(
            self.config,
            digest_of(self.config_digest, number.to_bytes(8, "little"), inputs),
            value,
            members,
            stamp_ns=stamp_ns,
            joint=self.config.fusion != "kalman-per-axis",
            exchange=number,
            reasons=reasons,
        )
