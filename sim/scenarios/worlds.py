"""Kinds of world, and the error for an unknown kind."""

from teamslam.sim.scenarios.checks import ScenarioError, check_fields, close, types_of
from teamslam.sim.scenarios.document import Fields, builtin_names
from teamslam.sim.world.config import (
    FolderWorld,
    GraphWorld,
    LiveWorld,
    SimulatedWorld,
    UnlabelledWorld,
    UtiasWorld,
    World,
)

WORLDS: dict[str, type[World]] = {
    "simulated": SimulatedWorld,
    "utias": UtiasWorld,
    "folder": FolderWorld,
    "live": LiveWorld,
    "unlabelled": UnlabelledWorld,
    "graph": GraphWorld,
}


def check_world(world: Fields) -> None:
    """Check a world's kind and field names; raises ScenarioError."""
    kind = world.get("kind")
    if not isinstance(kind, str) or kind not in WORLDS:
        raise ScenarioError(_which(kind))
    for name in world:
        kinds = [each for each, declared in WORLDS.items() if name in types_of(declared)]
        if kinds and kind not in kinds:
            belongs = " or ".join(f'"{each}"' for each in kinds)
            raise ScenarioError(
                f'`{name}` is no field of a world of kind "{kind}", which this file or its base '
                f"has, but of kind = {belongs} at world; known: {', '.join(types_of(WORLDS[kind]))}"
            )
    check_fields(world, WORLDS[kind], "world")


def _which(kind: object) -> str:
    known = ", ".join(f'"{each}"' for each in WORLDS)
    if kind is not None:
        return f"expected one of {known}, got {kind!r} at world.kind{close(kind, WORLDS)}"
    return (
        'no kind of world: put base = "recorded" (or another built-in scenario: '
        f"{', '.join(builtin_names())}) at the top of the file, or a table [world] with kind = "
        f'one of {known}; "live" is for robots with drivers, "folder" for CSV tables'
    )
