"""Present peers' map messages as a centre's, for a team without a centre.

Running maps come from the first peer that publishes one, the final map is the one on which all
peers agree. A present centre takes precedence.
"""

from collections.abc import Collection, Iterable, Iterator
from contextlib import suppress
from typing import TypeVar

import msgspec

from teamslam.central.desk.agreement import LISTENS as OF_AGREEMENT
from teamslam.central.desk.agreement import Agreement, as_centre_final
from teamslam.central.team_config import team_config
from teamslam.team.wire import channels as ch
from teamslam.team.wire import messages as m
from teamslam.team.wire.bus import Sample
from teamslam.team.wire.codec import WireError, decoded, encoded

_CENTRE = frozenset({ch.FUSED_MAP.key(), ch.FINAL_MAP.key()})
_TOKEN = ch.ALIVE.key("central")
_AS = {
    ch.TEAM_CONFIG.name: ch.CENTRAL_CONFIG,
    ch.TEAM_MAP.name: ch.FUSED_MAP,
    ch.TEAM_PRIOR.name: ch.PRIOR,
    ch.TEAM_TRAJECTORY.name: ch.TRAJECTORY,
    ch.TEAM_WITHDRAWAL.name: ch.WITHDRAWAL,
}
LISTENS = (
    ch.TEAM_MAP, ch.TEAM_PRIOR, ch.TEAM_TRAJECTORY, ch.TEAM_WITHDRAWAL, ch.WORLD_CONFIG,
    *OF_AGREEMENT,
)  # fmt: skip
_FOLD = "fold."
_LAST = (ch.TEAM_FINAL, ch.CONCLUDED, ch.TEAM_TRAJECTORY)
"""Used unless a centre has published them."""


class PeersAsCentre:
    """Map peers' samples to a centre's keys.

    robots: the peers, empty for a team with a centre only; None: as `world/config` names them.
    """

    def __init__(self, robots: Collection[str] | None = None) -> None:
        self._centre = self._concluded = False
        self._robot: str | None = None
        self._final: bytes | None = None
        self._is_told = robots is not None
        self.agreement = Agreement(robots)

    def of(self, sample: Sample) -> Sample | None:
        """Sample as a centre would publish it, or None."""
        if sample.key in _CENTRE:
            self._centre = True
            self._concluded = self._concluded or sample.key == ch.FINAL_MAP.key()
        elif sample.key == _TOKEN:
            token = _decoded(sample, m.Liveliness)
            self._centre = self._centre and (token is None or token.alive)
        found = ch.channel_of(sample.key)
        if found is None:
            return None
        channel, name = found
        if channel is ch.WORLD_CONFIG and not self._is_told:
            self._learn(sample)
        if self.agreement.robots is not None and not self.agreement.robots:
            return None
        self.agreement.take(sample)
        if self._centre and (self._concluded or channel not in _LAST):
            return None
        if channel is ch.TEAM_FINAL or channel is ch.CONCLUDED:
            return self._agreed()
        if channel is ch.STATUS:
            return self._status(sample, name)
        return self._renamed(sample, channel, name)

    def _renamed(self, sample: Sample, channel: ch.Channel, name: str) -> Sample | None:
        as_channel = _AS.get(channel.name)
        if as_channel is None:
            return None
        if channel in (ch.TEAM_MAP, ch.TEAM_CONFIG):
            self._robot = name if self._robot is None else self._robot
            if name != self._robot:
                return None
        if channel is ch.TEAM_WITHDRAWAL:
            order = _decoded(sample, m.Withdrawal)
            name = name if order is None else order.robot
        renamed = msgspec.structs.replace(sample, key=as_channel.key(name))
        return self._spoken(renamed) if channel is ch.TEAM_CONFIG else renamed

    def _learn(self, sample: Sample) -> None:
        message = _decoded(sample, m.Configuration)
        if message is None:
            return
        with suppress(ValueError):
            team = team_config(message.configuration)
            self.agreement.robots = frozenset(each.id for each in team.robots if team.peers)

    def _agreed(self) -> Sample | None:
        agreed = self.agreement.agreed
        if agreed is None or agreed.payload == self._final:
            return None
        self._final = agreed.payload
        return as_centre_final(agreed)

    def _spoken(self, sample: Sample) -> Sample | None:
        message = _decoded(sample, m.Configuration)
        if message is None:
            return None
        as_centre = msgspec.structs.replace(message, node="central")
        return msgspec.structs.replace(sample, payload=encoded(as_centre))

    def _status(self, sample: Sample, node: str) -> Sample | None:
        if self._robot is None or node != ch.robot_node(self._robot):
            return None
        status = _decoded(sample, m.Status)
        if status is None:
            return None
        figures = {
            name.removeprefix(_FOLD): value
            for name, value in status.figures.items()
            if name.startswith(_FOLD)
        }
        own = m.Status(
            stamp_ns=status.stamp_ns, node="central", state=status.state, figures=figures
        )
        return msgspec.structs.replace(sample, key=ch.STATUS.key("central"), payload=encoded(own))


M = TypeVar("M", bound=m.Message)


def _decoded(sample: Sample, kind: type[M]) -> M | None:
    try:
        return decoded(sample.payload, kind)
    except WireError:
        return None


def with_centre_messages(centre: PeersAsCentre, samples: Iterable[Sample]) -> Iterator[Sample]:
    """Yield samples, each followed by its counterpart in a centre's name."""
    for sample in samples:
        yield sample
        counterpart = centre.of(sample)
        if counterpart is not None:
            yield counterpart
