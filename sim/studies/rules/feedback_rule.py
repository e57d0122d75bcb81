"""The rules that fuse whole maps which the robots absorb again, in lockstep.

Each round takes the map that every robot sent for it. The fused map replaces the robots' own
landmarks, so the next round's maps contain this round's: under `kalman` and `kalman-per-axis` the
same measurements are counted again and again, and the covariance has no meaning.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence

import msgspec

from central.attendance import TeamAttendance
from central.config import CentralConfig
from central.fused import fused_message
from central.intake import Instant, Intake, MapInputs
from central.rule import FusionRule, Tail
from central.submap_set import SubmapSet
from sim.studies.rules.map_fusion import (
    covariance_intersection,
    fused_totally,
    kalman,
    kalman_per_axis,
)
from team import translate
from team.estimation.contribution import Stream
from team.estimation.gaussian import NO_LANDMARKS, LandmarkGaussian
from team.wire import channels as ch
from team.wire import messages as m
from team.wire.bus import Outgoing
from team.wire.digest import digest_of

RULES: Mapping[str, Callable[[Sequence[LandmarkGaussian]], LandmarkGaussian]] = {
    "kalman": kalman,
    "kalman-per-axis": kalman_per_axis,
    "covariance-intersection": covariance_intersection,
}
_NOT_VALID = "this rule counts measurements more than once: its covariance is not valid"


class Rounds(Intake[MapInputs]):
    """Every robot's map of a round, and its submaps, for the robots' next processes."""

    listens = (ch.START, ch.SUBMAP, ch.OWN_MAP)
    due = "now"

    def __init__(self, config: CentralConfig, robots: Sequence[str]) -> None:
        super().__init__(config, robots)
        self._rounds: dict[int, dict[str, m.MapEstimate]] = {}
        self._next = 1
        self._set = SubmapSet()
        self._starts: dict[Stream, m.InitialPose] = {}

    def take(self, message: m.Message, now_ns: int) -> list[Outgoing]:
        """File a map under the round that it names."""
        match message:
            case m.InitialPose():
                self._starts.setdefault((message.robot, message.incarnation), message)
            case m.Submap():
                self._set.admit(message)
            case m.MapEstimate() if message.exchange >= self._next:
                self._rounds.setdefault(message.exchange, {})[message.robot] = message
            case _:
                pass
        return []

    def inputs(self, closed_ns: float, now_ns: int) -> MapInputs:
        """No maps: those of a round are in its own instant."""
        return MapInputs(now_ns=now_ns)

    def instants(self, attendance: TeamAttendance) -> Iterator[Instant[MapInputs]]:
        """Every round that has the maps of all robots that may still send one.

        A centre that was started again continues with the present round.
        """

        def complete(number: int) -> bool:
            maps = self._rounds.get(number, {})
            return bool(maps) and all(
                r in maps or not attendance.takes_part(r) for r in attendance.robots
            )

        later = min(self._rounds, default=self._next)
        if complete(later):
            self._next = later
        while complete(self._next):
            maps = self._rounds.pop(self._next)
            inputs = MapInputs(
                now_ns=attendance.now_ns, maps=[maps[r] for r in sorted(maps)], exchange=self._next
            )
            self._next += 1
            yield Instant(attendance.now_ns, inputs)

    def stored_messages(self, robot: str) -> Sequence[m.Message]:
        """The initial pose of the robot's latest incarnation and its submaps without a gap."""
        incarnations = [incarnation for name, incarnation in self._set.streams if name == robot]
        submaps = self._set.chain((robot, max(incarnations))) if incarnations else []
        start = self._starts.get((robot, submaps[0].incarnation)) if submaps else None
        return () if start is None else (start, *submaps)


class ExchangeRule(FusionRule[MapInputs]):
    """Fuses the maps of a round in the order of the robots' names; a round names those before."""

    intake = Rounds

    def __init__(self, config: CentralConfig, digest: bytes, robots: Sequence[str] = ()) -> None:
        super().__init__(config, digest, robots)
        self._fused: m.FusedMap | None = None

    def fuse(self, inputs: MapInputs, tail: Tail) -> list[Outgoing]:
        """A round's map from the maps that it names; the last round's is the final one."""
        if tail == "final":
            return [Outgoing(ch.FINAL_MAP, "", self._final(inputs.now_ns))]
        self._fused = self._fuse(inputs.exchange, inputs.maps)
        return [Outgoing(ch.FUSED_MAP, "", self._fused)]

    def _final(self, now_ns: int) -> m.FusedMap:
        last = self._fused
        if last is None:
            last = self._message(0, now_ns, (), NO_LANDMARKS, b"")
        counted_often = self.config.fusion != "covariance-intersection"
        reasons = (*last.reasons, *([_NOT_VALID] if counted_often else []))
        return msgspec.structs.replace(last, final=True, reasons=reasons)

    def _fuse(self, number: int, maps: Sequence[m.MapEstimate]) -> m.FusedMap:
        values = {
            x.robot: LandmarkGaussian(
                *translate.landmarks_of(x), translate.landmark_covariance_of(x)
            )
            for x in maps
        }
        value, refused = fused_totally(
            RULES[self.config.fusion], values, self.config.bounds.coordinate_m
        )
        members = tuple(
            m.VersionEntry(robot=x.robot, incarnation=x.incarnation, sequence=x.sequence)
            for x in maps
        )
        payload = b"".join(x.ids + x.means + x.covariance for x in maps)
        previous = b"" if self._fused is None else self._fused.digest
        stamp_ns = max(x.stamp_ns for x in maps)
        return self._message(number, stamp_ns, members, value, payload + previous, refused)

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
