"""Present peers' map messages as a centre's, for a team without a centre.

Running maps come from the first peer that publishes one, the final map is the one on which all
peers agree. A present centre takes precedence.
"""

import hashlib
from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from contextlib import suppress
from typing import TypeVar

import msgspec

from teamslam.central.config import team_config
from teamslam.team.wire import channels as ch
from teamslam.team.wire import messages as m
from teamslam.team.wire.bus import Sample, try_open
from teamslam.team.wire.codec import WireError, decoded, encoded

OF_AGREEMENT = (ch.TEAM_CONFIG, ch.TEAM_FINAL, ch.CONCLUDED, ch.GIVEN_UP, ch.ORDER)
_NAMES = frozenset(channel.name for channel in OF_AGREEMENT)


class Agreement:
    """Announced final map of each peer.

    robots: the peers; None: all that announced a fold. Robots given up or withdrawn need not agree.
    """

    def __init__(self, robots: Collection[str] | None = None) -> None:
        self.robots = robots
        self._folding: set[str] = set()
        self._excused: set[str] = set()
        self._finals: dict[str, tuple[bytes, Sample]] = {}
        self._concluded: dict[str, m.Concluded] = {}

    def take(self, sample: Sample) -> None:
        """Process a sample; ignore other channels and invalid samples."""
        found = ch.channel_of(sample.key)
        if found is None or found[0].name not in _NAMES:
            return
        if (sound := try_open(sample)) is None:
            return
        channel, name, message = sound
        if channel is ch.TEAM_CONFIG:
            self._folding.add(name)
        elif isinstance(message, m.GivenUp):
            self.excuse(ch.robot_of(message.node) or "")
        elif isinstance(message, m.Withdrawal):
            self.excuse(name)
        elif isinstance(message, m.Concluded):
            before = self._concluded.get(name)
            if before is None or message.serial >= before.serial:
                self._concluded[name] = message
        elif isinstance(message, m.FusedMap) and message.final:
            self._finals[name] = hashlib.sha256(sample.payload).digest(), sample

    def excuse(self, robot: str) -> None:
        """Exempt a robot that was given up or withdrawn."""
        self._excused.add(robot)

    @property
    def needed(self) -> list[str]:
        """Robots that have to agree."""
        known = {*self._folding, *self._finals, *self._concluded}
        return sorted(set(known if self.robots is None else self.robots) - self._excused)

    def of(self, robot: str) -> bytes | None:
        """SHA-256 of a robot's final map."""
        if robot in self._concluded:
            return self._concluded[robot].sha256
        return self._finals[robot][0] if robot in self._finals else None

    @property
    def agreed(self) -> Sample | None:
        """Final map on which all peers agree."""
        found = {self.of(robot) for robot in self.needed}
        return self._final_with(*found) if len(found) == 1 else None

    @property
    def largest(self) -> Sample | None:
        """Final map of most robots; among equal counts, the smaller hash."""
        votes = Counter(sha for robot in self.needed if (sha := self.of(robot)) is not None)
        for sha, _ in sorted(votes.items(), key=lambda vote: (-vote[1], vote[0])):
            if (found := self._final_with(sha)) is not None:
                return found
        return None

    def _final_with(self, sha256: bytes | None) -> Sample | None:
        finals = (self._finals[robot] for robot in self.needed if robot in self._finals)
        return next((sample for sha, sample in finals if sha == sha256), None)

    @property
    def disagreement(self) -> tuple[str, ...]:
        """Robots whose final map differs from the majority's, as text."""
        largest = self.largest
        if largest is None:
            return ()
        sha256 = hashlib.sha256(largest.payload).digest()
        found = []
        for robot in self.needed:
            of, published = self.of(robot), self._finals.get(robot)
            if of is None:
                found.append(f"the peers do not agree: {robot} has announced no final map")
            elif of != sha256:
                found.append(
                    f"the peers do not agree: {robot} has another final map, {of.hex()[:12]}, "
                    f"than most of them, {sha256.hex()[:12]}"
                )
            elif published is not None and published[0] != of:
                found.append(
                    f"the peers do not agree: {robot} has published another final map, "
                    f"{published[0].hex()[:12]}, than the one with which it concluded"
                )
        return tuple(found)


def as_centre_final(sample: Sample) -> Sample:
    """A peer's final map under the centre's key."""
    return msgspec.structs.replace(sample, key=ch.FINAL_MAP.key())


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
