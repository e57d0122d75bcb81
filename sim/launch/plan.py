"""The plan of a launch: the scenario, the files and the options of its processes."""

from dataclasses import dataclass
from pathlib import Path

from sim.scenarios.scenario import Scenario


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What `launch` starts, with which files and options."""

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
        """The option by which every process connects with its certificate; empty where no keys are
        used.
        """
        return [] if self.keys is None else ["--keys", str(self.keys)]
