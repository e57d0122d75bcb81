"""What is to be launched."""

from dataclasses import dataclass
from pathlib import Path

from sim.scenarios.scenario import Scenario


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What is to be launched."""

    scenario: Scenario
    folder: Path
    log: Path
    speed: float
    listen: str
    views: bool = True
    end_silent_s: float | None = None
    keys: Path | None = None
    insecure: bool = False

    @property
    def door(self) -> list[str]:
        """How every process gets in: the option, or nothing where the door is open."""
        return [] if self.keys is None else ["--keys", str(self.keys)]
