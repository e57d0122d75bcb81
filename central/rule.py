"""What a fusion rule is to the centre's node, and which one has which name."""

from collections.abc import Mapping, Sequence
from typing import Protocol, runtime_checkable

from central.baselines.batch_rule import BatchRule
from central.baselines.joint_fastslam_rule import JointFastSlamRule
from central.baselines.map_rules import AloneRule, ExchangeRule, LatestRule
from central.config import CentralConfig
from central.roll import Roll
from central.submap_rules import submap_rule
from team.pairs import FEEDBACK
from team.wire import channels as ch
from team.wire import messages as m
from team.wire.bus import Outgoing


@runtime_checkable
class Rule(Protocol):
    """Messages of the robots in, the team's maps out; the node keeps the roll.

    listens: the channels whose messages it takes. landmarks: in its newest map. submaps: those
    that it has dealt with. figures: for people. warnings: what went wrong, the newest last.
    """

    @property
    def landmarks(self) -> int: ...  # noqa: D102
    @property
    def listens(self) -> tuple[ch.Channel, ...]: ...  # noqa: D102
    @property
    def submaps(self) -> int: ...  # noqa: D102
    @property
    def figures(self) -> Mapping[str, float]: ...  # noqa: D102
    @property
    def findings(self) -> tuple[str, ...]: ...  # noqa: D102
    @property
    def warnings(self) -> list[str]: ...  # noqa: D102

    def take(self, message: m.Message, now_ns: int) -> list[Outgoing]:
        """Take one message; the credit that it gives."""

    def dealt(self, done: m.Done) -> bool:
        """Whether everything that a robot's last word speaks of is here."""

    def complete(self, end: m.End) -> bool:
        """Whether everything of the streams that it needs itself is here."""

    def advance(self, roll: Roll) -> list[Outgoing]:
        """The maps that are due."""

    def conclude(self, now_ns: int) -> list[Outgoing]:
        """The last messages, the final map behind all others."""

    def kept(self, robot: str) -> Sequence[m.Message]:
        """What the robot's next life takes over: of each epoch, the latest first, its start, the
        submaps without a gap, the sightings from them.
        """

    def wanted(self, now_ns: int) -> list[m.ReadingsWanted]:
        """Readings that are missing and must be asked for at their source."""


@runtime_checkable
class Refuses(Protocol):
    """A rule on submaps: it acknowledges them one by one, those too that it could not take.

    withdrawn: the robots that the team goes on without.
    """

    @property
    def withdrawn(self) -> tuple[str, ...]: ...  # noqa: D102

    def refuse(self, message: m.Message, why: str, now_ns: int) -> list[Outgoing]:
        """Count a message as refused; the credit that this gives."""


def rule_of(config: CentralConfig, digest: bytes, robots: Sequence[str]) -> Rule:
    """The rule that the configuration names."""
    if config.fusion in FEEDBACK:
        return ExchangeRule(config, digest)
    if config.fusion == "latest":
        return LatestRule(config, digest)
    if config.fusion == "joint-fastslam":
        return JointFastSlamRule(config, digest, robots)
    if config.fusion == "batch":
        return BatchRule(config, digest, robots)
    if config.fusion == "alone":
        return AloneRule(config, digest, robots)
    return submap_rule(config, digest, robots)
