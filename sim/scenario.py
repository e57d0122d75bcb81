"""A scenario: the world, the team's robots with their models, the centre and the seed.

Users write TOML; processes hand the resolved scenario on as JSON (`dumps`, `loads`). In TOML:

    base = "thesis"            # optional: a built-in scenario that this file changes
    name, team, seed, estimator, fusion
    [world]      kind = "simulated" | "utias", then the fields of sim.worlds
    [defaults]   fields of every robot (team.config.RobotConfig)
    [[robots]]   what is different for one robot; or robot_count = N for r1 … rN
    [central]    fields of central.config.CentralConfig
"""

import re
import tomllib
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from central.config import CentralConfig
from sim.scenario_checks import ScenarioError, check_fields, check_known, plain
from sim.worlds import SimulatedWorld, UtiasWorld, World
from team.config import Estimator, FusionRule, RobotConfig
from team.robot.pairs import PAIRS, named_pairs

MAX_ROBOTS = 100
UTIAS_ROBOTS = 5
WORLDS: dict[str, type[World]] = {"simulated": SimulatedWorld, "utias": UtiasWorld}

KeyChunk = Annotated[str, Meta(pattern="^[A-Za-z0-9_.-]{1,64}$")]


class Scenario(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A resolved scenario: the robots and the centre carry the seed, the estimator and the rule.

    team: the chunk of the keys `team/<team>/…` that keeps two teams on one network apart.
    """

    name: KeyChunk
    team: KeyChunk
    world: World
    robots: tuple[RobotConfig, ...]
    central: CentralConfig = CentralConfig()
    seed: Annotated[int, Meta(ge=0, le=2**63 - 1)] = 1
    estimator: Estimator = "hybrid"
    fusion: FusionRule = "join"


def builtin_names() -> tuple[str, ...]:
    """The names of the scenarios that are installed with the package."""
    found = (entry.name for entry in files("sim.scenarios").iterdir())
    return tuple(sorted(name[:-5] for name in found if name.endswith(".toml")))


def load(name_or_path: str | Path) -> Scenario:
    """A built-in scenario by its name, or a user's TOML file; raises ScenarioError."""
    name = str(name_or_path)
    if name in builtin_names():
        document, folder, stem = _builtin(name), None, name
    else:
        path = Path(name)
        if not path.is_file():
            raise ScenarioError(
                f"{name}: no such scenario; built in: {', '.join(builtin_names())}; "
                "or give a path to a .toml file"
            )
        document, folder, stem = _parsed(_text_of(path), name), path.parent, path.stem
    try:
        return _resolved(_based(document), stem, folder)
    except ScenarioError as error:
        raise ScenarioError(f"{name}: {error}") from error.__cause__


def with_options(
    scenario: Scenario,
    *,
    robots: int | None = None,
    seed: int | None = None,
    estimator: str | None = None,
    fusion: str | None = None,
    dataset: str | Path | None = None,
) -> Scenario:
    """The scenario with what a command line changes; None leaves it as it is.

    robots: the first so many; further ones repeat the scenario's robots in turn, with new ids.
    Raises ScenarioError.
    """
    fields: dict[str, Any] = msgspec.to_builtins(scenario)
    changes = {"seed": seed, "estimator": estimator, "fusion": fusion}
    fields |= {key: value for key, value in changes.items() if value is not None}
    if robots is not None:
        fields["robots"] = _counted(fields["robots"], robots)
    if dataset is not None:
        if not isinstance(scenario.world, UtiasWorld):
            raise ScenarioError(
                f"{scenario.name}: a simulated world takes no data set; use the scenario `utias`"
            )
        fields["world"]["path"] = str(dataset)
    return _converted(fields)


def dumps(scenario: Scenario) -> str:
    """The resolved scenario as JSON; `loads` gives an equal one."""
    return msgspec.json.encode(scenario).decode()


def loads(text: str) -> Scenario:
    """A resolved scenario from its JSON; raises ScenarioError."""
    try:
        fields = msgspec.json.decode(text, type=dict[str, Any])
    except msgspec.DecodeError as error:
        raise ScenarioError(f"not a resolved scenario in JSON: {error}") from None
    return _converted(fields)


def _builtin(name: str) -> dict[str, Any]:
    return _parsed(files("sim.scenarios").joinpath(f"{name}.toml").read_text("utf-8"), name)


def _text_of(path: Path) -> str:
    try:
        return path.read_text("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ScenarioError(f"{path}: can not be read as UTF-8 text: {error}") from None


def _parsed(text: str, name: str) -> dict[str, Any]:
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ScenarioError(f"{name}: not valid TOML: {error}") from None


def _based(document: dict[str, Any]) -> dict[str, Any]:
    """The document laid over the built-in scenario that it names as its base."""
    if "base" not in document:
        return document
    own = {key: value for key, value in document.items() if key != "base"}
    base = document["base"]
    if base not in builtin_names():
        known = ", ".join(builtin_names())
        raise ScenarioError(f"expected a built-in scenario, got {base!r} at base; known: {known}")
    below = _based(_builtin(base))
    if "robot_count" in own:
        below.pop("robots", None)
    return _merged(below, own)


def _merged(below: Mapping[str, Any], above: Mapping[str, Any]) -> dict[str, Any]:
    """Tables are merged at every depth; all else is replaced by what lies above."""
    merged = dict(below)
    for key, value in above.items():
        old = merged.get(key)
        both = isinstance(old, dict) and isinstance(value, dict)
        merged[key] = _merged(old, value) if both and old is not None else value
    return merged


def _resolved(document: dict[str, Any], stem: str, folder: Path | None) -> Scenario:
    """A user's document → a resolved scenario. A data set's path is relative to the file."""
    top = [field.name for field in msgspec.structs.fields(Scenario)]
    for name in document:
        check_known(name, [*top, "base", "defaults", "robot_count"], "")
    document = {"name": re.sub(r"[^A-Za-z0-9_.-]", "-", stem)[:64]} | document
    defaults = _table(document.pop("defaults", {}), "defaults")
    _check_table(defaults, RobotConfig, "defaults", {"id": "r1"})
    if "id" in defaults:
        raise ScenarioError("`id` at defaults would be every robot's: give it in [[robots]]")
    count = document.pop("robot_count", None)
    if count is not None and "robots" in document:
        raise ScenarioError("robot_count and [[robots]] exclude each other: leave one away")
    robots = document.get("robots")
    if robots is None:
        if count is None and _table(document.get("world", {}), "world").get("kind") == "utias":
            count = UTIAS_ROBOTS
        robots = [{} for _ in range(_checked_count(1 if count is None else count))]
    if not isinstance(robots, list):
        raise ScenarioError("expected [[robots]], an array of tables, at robots")
    for i, robot in enumerate(robots):
        _check_table(_table(robot, f"robots[{i}]"), RobotConfig, f"robots[{i}]", {"id": "r1"})
    document["robots"] = [
        _merged({"id": f"r{i}"} | defaults, robot) for i, robot in enumerate(robots, 1)
    ]
    _check_table(_table(document.get("central", {}), "central"), CentralConfig, "central", {})
    scenario = _converted({"team": document["name"]} | document)
    world = scenario.world
    if folder is not None and isinstance(world, UtiasWorld) and world.path:
        world = msgspec.structs.replace(world, path=str(folder / world.path))
    return msgspec.structs.replace(scenario, world=world)


def _table(value: object, at: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise ScenarioError(f"expected a table, got {type(value).__name__} at {at}")
    return value


def _check_table(
    value: dict[str, Any], declared: type[msgspec.Struct], at: str, needed: dict[str, Any]
) -> None:
    """Check a part of the document alone, so that an error names where the user wrote it."""
    check_fields(value, declared, at)
    try:
        msgspec.convert(needed | value, declared)
    except msgspec.ValidationError as error:
        raise plain(error, at) from None


def _checked_count(count: object) -> int:
    if not isinstance(count, int) or isinstance(count, bool):
        raise ScenarioError(f"expected a number of robots from 1 to {MAX_ROBOTS}, got {count!r}")
    if not 1 <= count <= MAX_ROBOTS:
        raise ScenarioError(f"{count} robots: a team has 1 to {MAX_ROBOTS}")
    return count


def _counted(robots: Sequence[dict[str, Any]], count: int) -> list[dict[str, Any]]:
    """So many robots: the first ones as they are, further ones after their pattern in turn."""
    _checked_count(count)
    taken = {robot.get("id") for robot in robots}
    spare = (f"r{i}" for i in range(1, 2 * MAX_ROBOTS + 1) if f"r{i}" not in taken)
    further = [robots[i % len(robots)] | {"id": next(spare)} for i in range(len(robots), count)]
    return [*robots[:count], *further]


def _converted(fields: dict[str, Any]) -> Scenario:
    """Plain fields → a scenario whose parts fit together; raises ScenarioError."""
    world = _table(fields.get("world", {}), "world")
    if world.get("kind") not in WORLDS:
        kinds = ", ".join(f'"{kind}"' for kind in WORLDS)
        raise ScenarioError(f"expected one of {kinds}, got {world.get('kind')!r} at world.kind")
    check_fields(world, WORLDS[world["kind"]], "world")
    for choice, declared in (("estimator", Estimator), ("fusion", FusionRule)):
        if choice in fields:
            check_fields(fields[choice], declared, choice)
    try:
        return _filled(msgspec.convert(fields, Scenario))
    except msgspec.ValidationError as error:
        raise plain(error) from None


def _filled(scenario: Scenario) -> Scenario:
    """The seed, the estimator and the rule handed to the robots and the centre; all of it valid."""
    if (scenario.estimator, scenario.fusion) not in PAIRS:
        raise ScenarioError(
            f"the estimator {scenario.estimator} can not feed the rule {scenario.fusion}; "
            f"valid: {named_pairs()}"
        )
    _check_team([robot.id for robot in scenario.robots], scenario.world)
    robots = tuple(
        msgspec.structs.replace(
            robot, seed=scenario.seed, estimator=scenario.estimator, fusion=scenario.fusion
        )
        for robot in scenario.robots
    )
    central = msgspec.structs.replace(scenario.central, fusion=scenario.fusion)
    return msgspec.structs.replace(scenario, robots=robots, central=central)


def _check_team(ids: list[str], world: World) -> None:
    _checked_count(len(ids))
    for i, robot in enumerate(ids):
        if robot in ids[:i]:
            raise ScenarioError(f"two robots have the id {robot}: ids must differ")
        if isinstance(world, UtiasWorld) and not re.fullmatch("r[1-9][0-9]?|r100", robot):
            raise ScenarioError(
                f"the robot {robot}: in a UTIAS world robots are r1, r2, …, "
                "the number being the data set's"
            )
    if isinstance(world, SimulatedWorld):
        for robot in world.unknown_starts:
            if robot not in ids:
                raise ScenarioError(
                    f"world.unknown_starts names {robot}, no such robot; known: {', '.join(ids)}"
                )
