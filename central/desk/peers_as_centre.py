"""Present peers' map messages as a centre's, unless there is a centre.

Running maps come from the first peer that publishes one, the final map is the one on which all
peers agree.
"""

import hashlib
from collections import Counter
from collections.abc import Collection
from contextlib import suppress
from typing import TypeVar

import msgspec

from teamslam.central.config import team_config
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.bus import Sample, try_open
from teamslam.team.wire.codec import WireError, decoded, encoded

OF_AGREEMENT = (ch.TEAM_CONFIG, ch.TEAM_FINAL, ch.CONCLUDED, ch.GIVEN_UP, ch.ORDER)


class Agreement:
    """Announced final map of each peer.

    robots: the peers; None: all that announced a fold. A robot given up or withdrawn need not
    agree.
    """

    def __init__(self, robots: Collection[str] | None = None) -> None:
        self.robots = robots
        self._folding: set[str] = set()
        self._excused: set[str] = set()
        self._finals: dict[str, tuple[bytes, Sample]] = {}
        self._concluded: dict[str, m.Concluded] = {}

    def take(self, sample: Sample) -> None:
        """Process a sample of these channels."""
        if ch.row_of(sample.key) not in OF_AGREEMENT or (sound := try_open(sample)) is None:
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
        """Final map of most robots; of equal counts the smaller hash."""
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
        """Robots whose final map is not the majority's, as text."""
        largest = self.largest
        if largest is None:
            return ()
        sha256 = hashlib.sha256(largest.payload).digest()
        found = []
        for robot in self.needed:
            of, published = self.of(robot), self._finals.get(robot)
            if of is None:
                found.append(f"{robot} has announced no final map")
            elif of != sha256:
                found.append(
                    f"{robot} has another final map, {of.hex()[:12]}, than most of them, "
                    f"{sha256.hex()[:12]}"
                )
            elif published is not None and published[0] != of:
                found.append(
                    f"{robot} has published another final map, {published[0].hex()[:12]}, than the "
                    "one with which it concluded"
                )
        return tuple(f"the peers do not agree: {each}" for each in found)


def as_centre_final(sample: Sample) -> Sample:
    """A peer's final map under the centre's key."""
    return msgspec.structs.replace(sample, key=ch.FINAL_MAP.key())


_AS = {
    ch.TEAM_MAP: ch.FUSED_MAP,
    ch.TEAM_PRIOR: ch.PRIOR,
    ch.TEAM_TRAJECTORY: ch.TRAJECTORY,
    ch.TEAM_WITHDRAWAL: ch.WITHDRAWAL,
}
LISTENS = (
    ch.TEAM_MAP, ch.TEAM_PRIOR, ch.TEAM_TRAJECTORY, ch.TEAM_WITHDRAWAL, ch.WORLD_CONFIG,
    *OF_AGREEMENT,
)  # fmt: skip
_FOLD = "fold."
_LAST = (ch.TEAM_FINAL, ch.CONCLUDED, ch.TEAM_TRAJECTORY)  # used unless a centre has published them


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
        channel, name = ch.channel_of(sample.key) or (None, "")
        if channel in (ch.FUSED_MAP, ch.FINAL_MAP):
            self._centre = True
            self._concluded = self._concluded or channel is ch.FINAL_MAP
        elif channel is ch.ALIVE and name == "central":
            token = _decoded(sample, m.Liveliness)
            self._centre = self._centre and (token is None or token.alive)
        elif channel is ch.WORLD_CONFIG and not self._is_told:
            self._take_robots(sample)
        if self.agreement.robots is not None and not self.agreement.robots:
            return None
        self.agreement.take(sample)
        if channel is None or (self._centre and (self._concluded or channel not in _LAST)):
            return None
        if channel in (ch.TEAM_FINAL, ch.CONCLUDED):
            agreed = self.agreement.agreed
            if agreed is None or agreed.payload == self._final:
                return None
            self._final = agreed.payload
            return as_centre_final(agreed)
        if channel in (ch.TEAM_MAP, ch.TEAM_CONFIG):
            self._robot = name if self._robot is None else self._robot
            if name != self._robot:
                return None
        return self._renamed(sample, channel, name)

    def _renamed(self, sample: Sample, channel: ch.Channel, name: str) -> Sample | None:
        if channel is ch.TEAM_CONFIG:
            if (config := _decoded(sample, m.Configuration)) is None:
                return None
            own: m.Message = msgspec.structs.replace(config, node="central")
            return _with_message(sample, ch.CENTRAL_CONFIG.key(name), own)
        if channel is ch.STATUS:
            status = _decoded(sample, m.Status)
            if status is None or self._robot is None or name != ch.robot_node(self._robot):
                return None
            folding = (each for each in status.figures.items() if each[0].startswith(_FOLD))
            figures = {figure.removeprefix(_FOLD): value for figure, value in folding}
            own = m.Status(
                stamp_ns=status.stamp_ns, node="central", state=status.state, figures=figures
            )
            return _with_message(sample, ch.STATUS.key("central"), own)
        if channel is ch.TEAM_WITHDRAWAL and (order := _decoded(sample, m.Withdrawal)) is not None:
            name = order.robot
        if (as_channel := _AS.get(channel)) is None:
            return None
        return msgspec.structs.replace(sample, key=as_channel.key(name))

    def _take_robots(self, sample: Sample) -> None:
        message = _decoded(sample, m.Configuration)
        with suppress(ValueError):
            if message is not None:
                team = team_config(message.configuration)
                self.agreement.robots = frozenset(each.id for each in team.robots if team.peers)


M = TypeVar("M", bound=m.Message)


def _decoded(sample: Sample, kind: type[M]) -> M | None:
    try:
        return decoded(sample.payload, kind)
    except WireError:
        return None


def _with_message(sample: Sample, key: str, message: m.Message) -> Sample:
    return msgspec.structs.replace(sample, key=key, payload=encoded(message))
