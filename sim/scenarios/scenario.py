"""A scenario: world, robots with models, centre and seed.

Users write TOML (`teamslam.sim.scenarios.document`); processes receive JSON (`dumps`, `loads`).
"""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec

from teamslam.central.config import CentralConfig, TeamConfig
from teamslam.sim.scenarios.document import (
    MAX_ROBOTS,
    TOP_LEVEL,
    Fields,
    ScenarioError,
    builtin_names,
    check_fields,
    checked_count,
    checked_table,
    close,
    named_after,
    named_document,
    plain_error,
    resolve,
    types_of,
)
from teamslam.sim.world.config import (
    FolderWorld,
    GraphWorld,
    LiveWorld,
    Radio,
    SimulatedWorld,
    UnlabelledWorld,
    UtiasWorld,
    World,
    starts_unknown,
)
from teamslam.team.association import AssociationProfile, has_default_lengths, profile_for
from teamslam.team.config import Estimator, Exchange, FusionRule, RobotConfig
from teamslam.team.former_names import with_current_names
from teamslam.team.pairs import ESTIMATORS, PAIRS, RULES, named_pairs, rules_for
from teamslam.team.registry import absence

__all__ = ["ASSUMED_NAME", "Scenario", "ScenarioError", "builtin_names", "dumps", "load", "loads",
           "scenario_warnings", "with_options"]  # fmt: skip

ASSUMED_NAME = "recorded"
"""Built-in scenario for recorded data of uncalibrated robots; the team is named by its data set."""
FAR_M = 10.0  # default end of a sensor's range
PASSED = 0.5
"""Distance, as a share of a sensor's range, from which a robot that drives past a landmark has most
of its information about it.
"""


class Scenario(TeamConfig, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Resolved scenario: team configuration, world, and radio between peers."""

    world: World
    radio: Radio = Radio()

    def config_of(self, robot: str) -> RobotConfig | None:
        """Configuration of a robot, or of newcomers."""
        named = next((config for config in self.robots if config.id == robot), None)
        if named is not None or not isinstance(self.world, LiveWorld) or not self.world.admit:
            return named
        newcomer = self.world.newcomer or RobotConfig("newcomer")
        return msgspec.structs.replace(
            newcomer, id=robot, seed=self.seed, estimator=self.estimator, fusion=self.fusion
        )

    @property
    def is_live(self) -> bool:
        """Whether robots have drivers and no world."""
        return isinstance(self.world, LiveWorld)

    @property
    def admits(self) -> bool:
        """Whether unnamed robots may join."""
        return isinstance(self.world, LiveWorld) and self.world.admit


def load(name_or_path: str | Path) -> Scenario:
    """Load a built-in scenario, or a TOML file; raises ScenarioError."""
    name = str(name_or_path)
    known = list(types_of(Scenario))
    try:
        return _convert(resolve(*named_document(name), known))
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
    peers: bool = False,
    centre: bool = True,
    comm_range_m: float | None = None,
    identities: str | None = None,
    localise: bool = False,
) -> Scenario:
    """Apply command-line changes; None leaves a field; raises ScenarioError.

    robots: number; further ones repeat the scenario's, with new ids or those of the data set's
    folder.
    """
    fields: Fields = msgspec.to_builtins(scenario)
    changes = {"seed": seed, "estimator": estimator, "fusion": fusion}
    fields |= {key: value for key, value in changes.items() if value is not None}
    if comm_range_m is not None:
        fields["radio"]["comm_range_m"] = comm_range_m
    fields["central"]["localise"] = fields["central"]["localise"] or localise
    fields["peers"] = fields["peers"] or peers
    fields["centre"] = fields["centre"] and centre
    if dataset is not None:
        fields["world"] = _world_of(scenario, str(dataset))
        if scenario.name == ASSUMED_NAME:
            fields["name"] = fields["team"] = named_after(Path(dataset)) or ASSUMED_NAME
    world, names = fields["world"], tuple[str, ...]()
    if identities is not None:
        world["identities"] = identities
        if identities == "hidden" and has_default_lengths(scenario.central.association):
            fields["central"]["association"] = msgspec.to_builtins(_profile_of(scenario))
    if world["kind"] == "folder" and world["path"] and (dataset is not None or robots is not None):
        fields["robots"], names = _of_folder(fields["robots"], world["path"], robots)
    if world["kind"] == "folder" and has_default_lengths(scenario.central.association):
        from teamslam.sim.datasets.folder_files import has_detections

        if has_detections(world["path"]):
            fields["central"]["association"] = msgspec.to_builtins(_profile_of(scenario, PASSED))
    if world["kind"] == "graph" and dataset is not None and robots is None:
        from teamslam.sim.datasets.graph import robot_count

        robots = robot_count(world["path"])
    if robots is not None:
        fields["robots"] = _fit_count(fields["robots"], robots, names)
    if world["kind"] in ("unlabelled", "graph"):  # its log is cut into r1, r2, …
        numbered = enumerate(fields["robots"], start=1)
        fields["robots"] = [robot | {"id": f"r{number}"} for number, robot in numbered]
    return _convert(fields)


def _profile_of(scenario: Scenario, share: float = 1.0) -> AssociationProfile:
    """Association thresholds by the coarsest sensor at a share of its range."""
    world = scenario.world
    seen_m = world.visible_to_m if isinstance(world, SimulatedWorld) else None
    far_m = FAR_M if seen_m is None else seen_m
    stated = scenario.central.association
    of_each = [
        profile_for(r.sensor, share * min(r.sensor.max_range, far_m), stated)
        for r in scenario.robots
    ]
    return max(of_each, key=lambda profile: profile.tight, default=stated)


def _world_of(scenario: Scenario, path: str) -> Fields:
    world = scenario.world
    if isinstance(world, SimulatedWorld):
        raise ScenarioError(
            f"{scenario.name}: a simulated world takes no data set; use the scenario `utias` or "
            "`recorded`"
        )
    fields: Fields = msgspec.to_builtins(world)
    kind = _kind_of(path, "utias" if isinstance(world, UtiasWorld) else "folder")
    if kind != fields["kind"]:
        common = set(types_of(WORLDS[kind]))
        common -= {"identities"}  # a data set's identities are its own
        fields = {name: value for name, value in fields.items() if name in common}
    return fields | {"kind": kind, "path": path}


def _kind_of(path: str, otherwise: str) -> str:
    """Kind of a data set, or `otherwise`: reading it reports the fault."""
    from teamslam.sim.datasets.kinds import kind_of
    from teamslam.sim.datasets.tables import DatasetError

    try:
        return kind_of(path)
    except DatasetError:
        return otherwise


def _of_folder(
    robots: Sequence[Fields], path: str, count: int | None
) -> tuple[list[Fields], tuple[str, ...]]:
    from teamslam.sim.datasets.folder_files import robots_of

    names = robots_of(path)
    if count is not None and count > len(names):
        has = f"{Path(path).resolve().name} has {len(names)}: {', '.join(names)}"
        raise ScenarioError(f"--robots {count}: {has}; give at most as many, or none")
    chosen = [robot for robot in robots if robot["id"] in names]
    repeated = [robots[i % len(robots)] | {"id": name} for i, name in enumerate(names)]
    return chosen or repeated, names


def dumps(scenario: Scenario) -> str:
    """Resolved scenario as JSON for `loads`."""
    return msgspec.json.encode(scenario).decode()


def loads(text: str) -> Scenario:
    """Scenario from JSON, also with former names; raises ScenarioError."""
    try:
        fields = msgspec.json.decode(text, type=dict[str, Any])
    except msgspec.DecodeError as error:
        raise ScenarioError(f"not a resolved scenario in JSON: {error}") from None
    return _convert(with_current_names(fields))


def scenario_warnings(scenario: Scenario) -> list[str]:
    """Warn of valid but probably mistaken settings."""
    if not isinstance(scenario.world, SimulatedWorld):
        return []
    return [
        f"{robot.id}: odometry without noise; give it some in [defaults.motion]"
        for robot in scenario.robots
        if robot.motion.is_exact
    ]


def _fit_count(robots: Sequence[Fields], count: int, names: Sequence[str]) -> list[Fields]:
    checked_count(count)
    taken = {robot.get("id") for robot in robots}
    numbered = (f"r{i}" for i in range(1, 2 * MAX_ROBOTS + 1))
    unused = (name for name in (*names, *numbered) if name not in taken)
    further = [robots[i % len(robots)] | {"id": next(unused)} for i in range(len(robots), count)]
    return [*robots[:count], *further]


def _convert(fields: Fields) -> Scenario:
    _check_world(checked_table(fields.get("world", {}), "world"))
    for choice, declared in (
        ("estimator", Estimator),
        ("fusion", FusionRule),
        ("exchange", Exchange),
    ):
        if choice in fields:
            check_fields(fields[choice], declared, choice)
    try:
        return _fill_in(msgspec.convert(fields, Scenario))
    except msgspec.ValidationError as error:
        raise plain_error(error, of=fields) from None


def _fill_in(scenario: Scenario) -> Scenario:
    if (scenario.estimator, scenario.fusion) not in PAIRS:
        raise ScenarioError(
            f"the estimator {scenario.estimator} can not feed the rule {scenario.fusion}, "
            f"but {' or '.join(rules_for(scenario.estimator))}; valid: {named_pairs()}"
        )
    for what, place in (
        (f"the estimator {scenario.estimator}", ESTIMATORS[scenario.estimator].made_by),
        (f"the fusion rule {scenario.fusion}", RULES[scenario.fusion].made_by),
    ):
        absent = absence(place, what)
        if absent is not None:
            raise ScenarioError(absent)
    if scenario.exchange == "rendezvous" and PAIRS[scenario.estimator, scenario.fusion] != "submap":
        raise ScenarioError(
            f"the rule {scenario.fusion} needs a continuous exchange: at a rendezvous submaps are "
            'sent, which the rule "join" takes'
        )
    if scenario.is_live and PAIRS[scenario.estimator, scenario.fusion] != "submap":
        raise ScenarioError(
            f"the rule {scenario.fusion} can not serve a live team, whose robots come and go: "
            'world.kind = "live" needs a rule on submaps, as "join"'
        )
    peers = scenario.peers or not scenario.centre
    if not (peers or scenario.radio.is_perfect):
        raise ScenarioError(
            "a radio is between peers: give `centre = false` (--without-centre), or `peers = true`"
        )
    if peers and (scenario.fusion != "join" or scenario.exchange == "rendezvous"):
        raise ScenarioError(
            f"the rule {scenario.fusion} with exchange {scenario.exchange} needs a centre and no "
            'peers: peers fold a set of submaps (fusion = "join", exchange = "continuous"), and '
            "who meets whom is the radio's"
        )
    _check_team([robot.id for robot in scenario.robots], scenario.world)
    robots = tuple(
        msgspec.structs.replace(
            robot, seed=scenario.seed, estimator=scenario.estimator, fusion=scenario.fusion
        )
        for robot in scenario.robots
    )
    central = msgspec.structs.replace(scenario.central, fusion=scenario.fusion)
    return msgspec.structs.replace(scenario, robots=robots, central=central, peers=peers)


def _check_way_points(robots: int, world: SimulatedWorld) -> None:
    width = world.size_m if world.radius_m is None else 2.0 * world.radius_m
    endless = robots > len(world.paths) and not world.way_point_count
    if endless and world.way_point_tolerance_m > 0.5 * width:
        raise ScenarioError(
            f"world.way_point_tolerance_m is {world.way_point_tolerance_m:g} in a place "
            f"{width:g} m wide: a robot would be at its way-points without moving; "
            "give at most half the width"
        )


def _check_team(ids: list[str], world: World) -> None:
    if not ids and isinstance(world, LiveWorld) and world.admit:
        return
    if not ids:
        raise ScenarioError("no robots: give robot_count, [[robots]], or a base that has some")
    checked_count(len(ids))
    for i, robot in enumerate(ids):
        if robot in ids[:i]:
            raise ScenarioError(f"two robots have the id {robot}: ids must differ")
        if isinstance(world, UtiasWorld) and not re.fullmatch("r[1-9][0-9]?|r100", robot):
            raise ScenarioError(
                f"the robot {robot}: in a UTIAS world robots are r1, r2, …, "
                "the number being the data set's"
            )
    if isinstance(world, SimulatedWorld):
        _check_way_points(len(ids), world)
    for named in () if isinstance(world, LiveWorld) else world.unknown_starts:
        if named != "*" and named.removeprefix("!") not in ids:
            raise ScenarioError(
                f"world.unknown_starts names {named}, no such robot; known: {', '.join(ids)}, "
                'and "*" for all of them'
            )


WORLDS: dict[str, type[World]] = {
    "simulated": SimulatedWorld,
    "utias": UtiasWorld,
    "folder": FolderWorld,
    "live": LiveWorld,
    "unlabelled": UnlabelledWorld,
    "graph": GraphWorld,
}


def _check_world(world: Fields) -> None:
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


def data_set_scenario(scenario: Scenario) -> str:
    """Text with the same robots, as r1, r2, …, and centre for a UTIAS set in its folder."""
    ids = [f"r{i}" for i in range(1, len(scenario.robots) + 1)]
    return _text(scenario, ids, {"kind": "utias"} | _chosen(UtiasWorld(path="."), UtiasWorld, ()))


def folder_scenario(scenario: Scenario) -> str:
    """Text with the same robots and centre for tables in its folder."""
    ids = [robot.id for robot in scenario.robots]
    unknown = [robot for robot in ids if starts_unknown(scenario.world, robot)]
    world: dict[str, Any] = {"kind": "folder", "path": "."}
    return _text(scenario, ids, world | ({"unknown_starts": unknown} if unknown else {}))


def _text(scenario: Scenario, ids: Sequence[str], world: Mapping[str, Any]) -> str:
    import tomli_w  # no process of a team writes such a text

    head = {name: getattr(scenario, name) for name in ("name", *TOP_LEVEL, "exchange")}
    robots = [
        {"id": name} | _chosen(robot, RobotConfig, ("id", *TOP_LEVEL))
        for name, robot in zip(ids, scenario.robots, strict=True)
    ]
    central = _chosen(scenario.central, CentralConfig, TOP_LEVEL)
    document = head | {"world": world} | ({"central": central} if central else {})
    return tomli_w.dumps(document | {"robots": robots})


def _chosen(
    value: msgspec.Struct, declared: type[msgspec.Struct], without: tuple[str, ...]
) -> dict[str, Any]:
    chosen: dict[str, Any] = {}
    for field in msgspec.structs.fields(declared):
        part = getattr(value, field.name)
        if field.name in without or part is None or part == field.default:
            continue
        table = isinstance(part, msgspec.Struct)
        chosen[field.name] = _chosen(part, type(part), ()) if table else part
    return chosen
