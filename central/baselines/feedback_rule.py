"""The rules that fuse whole maps which the robots absorb again, in lockstep.

Each round takes the map that every robot sent for it. What comes back replaces the robots' own
landmarks, so the next round's maps hold this round's: under `kalman` and `kalman-per-axis` the same
measurements are counted again and again, and the covariance that they give is worth nothing.
"""

from collections.abc import Callable, Mapping, Sequence

import msgspec

from central.baselines.map_fusion import (
    covariance_intersection,
    fused_totally,
    kalman,
    kalman_per_axis,
)
from central.config import CentralConfig
from central.fused import fused_message
from team import translate
from team.config import FusionRule
from team.estimation.gaussian import NO_LANDMARKS, LandmarkGaussian
from team.wire import channels as ch
from team.wire import messages as m
from team.wire.bus import Outgoing

RULES: Mapping[FusionRule, Callable[[Sequence[LandmarkGaussian]], LandmarkGaussian]] = {
    "kalman": kalman,
    "kalman-per-axis": kalman_per_axis,
    "covariance-intersection": covariance_intersection,
}
_NOT_VALID = "this rule counts measurements more than once: its covariance is not valid"


class FeedbackRule:
    """Waits for every robot's map of a round, fuses them in the order of the robots' names."""

    def __init__(self, config: CentralConfig, digest: bytes) -> None:
        self._config = config
        self._config_digest = digest
        self._rounds: dict[int, dict[str, m.MapEstimate]] = {}
        self._fused: m.FusedMap | None = None
        self._next = 1
        self.landmarks = 0

    def take_map(self, estimate: m.MapEstimate) -> None:
        """A robot's map for the round that it names."""
        if estimate.exchange >= self._next:
            self._rounds.setdefault(estimate.exchange, {})[estimate.robot] = estimate

    def advance(
        self, taking_part: Callable[[str, int], bool], robots: Sequence[str]
    ) -> list[Outgoing]:
        """Fuse every round that no robot is missing from; `taking_part(robot, round)` says who.

        A centre that was started again goes on with the round that everybody is in.
        """

        def complete(number: int) -> bool:
            maps = self._rounds.get(number, {})
            return bool(maps) and all(r in maps or not taking_part(r, number) for r in robots)

        later = min(self._rounds, default=self._next)
        if complete(later):
            self._next = later
        out: list[Outgoing] = []
        while complete(self._next):
            maps = self._rounds[self._next]
            self._fused = self._fuse(self._next, [maps[r] for r in sorted(maps)])
            del self._rounds[self._next]
            self._next += 1
            out.append(Outgoing(ch.FUSED_MAP, "", self._fused))
        return out

    def conclude(self, now_ns: int) -> list[Outgoing]:
        """The last round's map is the final one."""
        last = self._fused
        if last is None:
            last = self._message(
                0,
                now_ns,
                (),
                NO_LANDMARKS,
                b"",
            )
        counted_often = self._config.fusion != "covariance-intersection"
        final = msgspec.structs.replace(
            last, final=True, reasons=(*last.reasons, *([_NOT_VALID] if counted_often else []))
        )
        return [Outgoing(ch.FINAL_MAP, "", final)]

    def _fuse(self, number: int, maps: Sequence[m.MapEstimate]) -> m.FusedMap:
        values = {
            x.robot: LandmarkGaussian(
                *translate.landmarks_of(x), translate.landmark_covariance_of(x)
            )
            for x in maps
        }
        value, refused = fused_totally(
            RULES[self._config.fusion], values, self._config.bounds.coordinate_m
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
            self._config,
            translate.digest_of(self._config_digest, number.to_bytes(8, "little"), inputs),
            value,
            members,
            stamp_ns=stamp_ns,
            joint=self._config.fusion != "kalman-per-axis",
            exchange=number,
            reasons=reasons,
        )
