from dataclasses import dataclass
from pathlib import Path

TEAM = "mixed"


@dataclass(frozen=True)
class Folders:
    """own: of the team. strange: the same names by another authority. ended: expired ones."""

    own: Path
    strange: Path
    ended: Path
