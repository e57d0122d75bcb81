"""Presents a team without a centre to the desk: peers' messages about the map, as a centre's.

The running maps are those of one peer, the first that publishes one; the final map is any peer's,
since all are equal; a prior and a smoothed path are their own robot's. While there is a centre, its
own messages are used; when it has gone, a peer's.
"""

from collections.abc import Iterable, Iterator

import msgspec

from team.wire import channels as ch
from team.wire import messages as m
from team.wire.bus import Sample
from team.wire.codec import WireError, decoded, encoded

_CENTRE = frozenset({ch.FUSED_MAP.key(), ch.FINAL_MAP.key()})
_TOKEN = ch.ALIVE.key("central")
_AS = {
    ch.TEAM_CONFIG.name: ch.CENTRAL_CONFIG,
    ch.TEAM_MAP.name: ch.FUSED_MAP,
    ch.TEAM_FINAL.name: ch.FINAL_MAP,
    ch.TEAM_PRIOR.name: ch.PRIOR,
    ch.TEAM_TRAJECTORY.name: ch.TRAJECTORY,
}
LISTENS = (ch.TEAM_CONFIG, ch.TEAM_MAP, ch.TEAM_FINAL, ch.TEAM_PRIOR, ch.TEAM_TRAJECTORY)
"""The peers' channels that are presented in this way."""
_FOLD = "fold."
_LAST = (ch.TEAM_FINAL, ch.TEAM_TRAJECTORY)
"""Messages that stand for the team's unless a centre has published them; a centre that comes back
late may not.
"""


class PeersAsCentre:
    """Renames samples of peers to a centre's keys."""

    def __init__(self) -> None:
        self._centre = self._concluded = False
        self._robot: str | None = None

    def of(self, sample: Sample) -> Sample | None:
        """The sample as a centre would have published it; None where it has no counterpart."""
        if sample.key in _CENTRE:
            self._centre = True
            self._concluded = self._concluded or sample.key == ch.FINAL_MAP.key()
        elif sample.key == _TOKEN:
            self._centre = self._centre and _is_alive(sample)
        found = ch.channel_of(sample.key)
        if found is None or (self._centre and (self._concluded or found[0] not in _LAST)):
            return None
        channel, name = found
        if channel is ch.STATUS:
            return self._status(sample, name)
        as_channel = _AS.get(channel.name)
        if as_channel is None:
            return None
        if channel is ch.TEAM_MAP or channel is ch.TEAM_CONFIG:
            self._robot = name if self._robot is None else self._robot
            if name != self._robot:
                return None
        renamed = msgspec.structs.replace(sample, key=as_channel.key(name))
        return self._spoken(renamed) if channel is ch.TEAM_CONFIG else renamed

    def _spoken(self, sample: Sample) -> Sample | None:
        try:
            message = decoded(sample.payload, m.Configuration)
        except WireError:
            return None
        as_centre = msgspec.structs.replace(message, node="central")
        return msgspec.structs.replace(sample, payload=encoded(as_centre))

    def _status(self, sample: Sample, node: str) -> Sample | None:
        """The status of the peer's fold as a centre's status."""
        if self._robot is None or node != ch.robot_node(self._robot):
            return None
        try:
            status = decoded(sample.payload, m.Status)
        except WireError:
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


def _is_alive(token: Sample) -> bool:
    try:
        return decoded(token.payload, m.Liveliness).alive
    except WireError:
        return True


def with_centre_messages(centre: PeersAsCentre, samples: Iterable[Sample]) -> Iterator[Sample]:
    """The samples, each followed by its counterpart in a centre's name."""
    for sample in samples:
        yield sample
        counterpart = centre.of(sample)
        if counterpart is not None:
            yield counterpart
