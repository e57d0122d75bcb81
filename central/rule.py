"""The interface of fusion rules: a pure function from what the team has sent to its fused map.

A rule folds, and does nothing else. Its intake files what comes (`central.intake`), and the
scheduler says when a map is due (`central.scheduler`). The centre, a peer, a rerun and the
verification call the same function: a recorded map comes out again from the inputs that it names.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Generic, Literal

from central.config import CentralConfig
from central.intake import I, Intake
from team.pairs import RULES
from team.registry import loaded
from team.wire import messages as m
from team.wire.bus import Outgoing

Tail = Literal["final", "closed", "provisional"]
"""The kind of a map: the last one; one with all submaps up to a time; one beyond that."""


class FusionRule(ABC, Generic[I]):
    """A function from inputs to the team's map; inputs that only grow are folded incrementally.

    intake: the class that collects its inputs. unnamed: fields of its maps that depend on more than
    the inputs that a map names. landmarks: number in its newest map. not_folded: number of that
    map's inputs that it refused. warnings: failures in words, the newest last.
    """

    intake: ClassVar[type[Intake[Any]]]
    unnamed: ClassVar[tuple[str, ...]] = ()

    def __init__(self, config: CentralConfig, digest: bytes, robots: Sequence[str] = ()) -> None:
        self.config = config
        self.config_digest = digest
        self.team = tuple(sorted(robots))
        self.landmarks = 0
        self.not_folded = 0
        self.warnings: list[str] = []

    def admit(self, robot: str) -> None:
        """Add a robot to the team."""
        self.team = tuple(sorted({*self.team, robot}))

    @abstractmethod
    def fuse(self, inputs: I, tail: Tail) -> list[Outgoing]:
        """The map of these inputs, after the messages that accompany it."""

    def take(self, inputs: I) -> list[Outgoing]:
        """Fold the closed inputs without making a map; returns messages to publish at once."""
        return []

    @property
    def convicted(self) -> Mapping[str, str]:
        """The robots that the fold has withdrawn, with the reason in words."""
        return {}

    @property
    def suspended(self) -> Mapping[str, str]:
        """The robots that running maps leave out for now, with the reason in words."""
        return {}

    @property
    def figures(self) -> Mapping[str, float]:
        """Figures for people."""
        return {}

    @property
    def findings(self) -> tuple[str, ...]:
        """Warnings for readers of the map."""
        return ()


def final_of(out: Sequence[Outgoing]) -> m.FusedMap:
    """The map that a rule's last messages end with."""
    fused = out[-1].message
    assert isinstance(fused, m.FusedMap)
    return fused


def rule_of(config: CentralConfig, digest: bytes, robots: Sequence[str]) -> FusionRule[Any]:
    """The rule that the configuration names; raises NotInstalledError."""
    made: type[FusionRule[Any]] = loaded(
        RULES[config.fusion].made_by, f"the fusion rule {config.fusion}"
    )
    return made(config, digest, robots)
