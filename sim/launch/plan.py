"""The plan of a launch: the scenario, the files and the options of its processes."""

from dataclasses import dataclass
from pathlib import Path

from sim.scenarios.scenario import Scenario


@dataclass(frozen=True, kw_only=True)
class Plan:
    """The processes of `launch`, with their files and options."""

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

    def set_file(self, node: str) -> Path:
        """The file in which a node stores the set of submaps; node "*": the pattern of all."""
        return self.folder / f"{node}.set"

    def stores(self, node: str) -> list[str]:
        """The option by which a node stores the set: a robot that is a peer, or a centre."""
        scenario = self.scenario
        if not (scenario.peers or (node == "central" and scenario.central.fusion == "join")):
            return []
        return ["--set", str(self.set_file(node))]

    @property
    def earlier_sets(self) -> list[Path]:
        """The sets of an earlier run in this folder, which are not part of this one."""
        return sorted(self.folder.glob(self.set_file("*").name))
