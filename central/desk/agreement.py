"""The final map on which all peers of a team agree."""

import hashlib
from collections import Counter
from collections.abc import Collection

import msgspec

from teamslam.team.wire import channels as ch
from teamslam.team.wire import messages as m
from teamslam.team.wire.bus import Sample, try_open

LISTENS = (ch.TEAM_CONFIG, ch.TEAM_FINAL, ch.CONCLUDED, ch.GIVEN_UP, ch.ORDER)
_NAMES = frozenset(channel.name for channel in LISTENS)


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
