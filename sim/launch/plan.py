"""Plan of a launch: scenario, files and process options."""

from dataclasses import dataclass
from pathlib import Path

from teamslam.sim.scenarios.scenario import Scenario


@dataclass(frozen=True, kw_only=True)
class Plan:
    """Processes of `launch`, with files and options."""

    scenario: Scenario
    folder: Path
    log: Path
    speed: float
    listen: str
    views: bool = True
    end_silent_s: float | None = None
    keys: Path | None = None
    insecure: bool = False
    maps: tuple[Path, ...] = ()

    @property
    def door(self) -> list[str]:
        """Certificate option of every process; empty without keys."""
        return [] if self.keys is None else ["--keys", str(self.keys)]

    def maps_of(self, node: str) -> list[str]:
        """Options of the saved maps that a peer or centre loads."""
        if not (self.scenario.peers or node == "central"):
            return []
        return [word for path in self.maps for word in ("--map", str(path.resolve()))]

    def set_file(self, node: str) -> Path:
        """File of a node's set of submaps; node "*": pattern of all."""
        return self.folder / f"{node}.set"

    def stores(self, node: str) -> list[str]:
        """Storage option of a peer or centre."""
        scenario = self.scenario
        if not (scenario.peers or (node == "central" and scenario.central.fusion == "join")):
            return []
        return ["--set", str(self.set_file(node))]

    @property
    def earlier_sets(self) -> list[Path]:
        """Sets of an earlier run in this folder."""
        return sorted(self.folder.glob(self.set_file("*").name))
