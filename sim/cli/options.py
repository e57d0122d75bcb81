"""Common options of commands, their parsing, and errors with exit status."""

import json
import logging
import math
import os
import re
import threading
from collections.abc import Sequence
from errno import EACCES
from ipaddress import ip_address
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, get_args

import click

from teamslam.sim.cli.commands import argument, fail, network, option, rare, refuse, refusing
from teamslam.sim.scenarios.document import ScenarioError
from teamslam.sim.scenarios.scenario import ASSUMED_NAME, Scenario, load, loads
from teamslam.sim.world.config import GraphWorld, UnlabelledWorld
from teamslam.team.config import MAP, Estimator, FusionRule
from teamslam.team.wire.logs import one_line

if TYPE_CHECKING:
    from teamslam.team.keys.credentials import Credentials
    from teamslam.team.keys.signing import Signer
    from teamslam.team.recording.check import Finding
    from teamslam.team.recording.reader import Log
    from teamslam.team.wire.messages import SavedMap
    from teamslam.team.wire.zenoh.bus import ZenohBus


def check_folder(path: Path) -> None:
    """Refuse a folder that can not be made or written."""
    try:
        path.mkdir(parents=True, exist_ok=True)
        if not os.access(path, os.W_OK):
            raise PermissionError(EACCES, os.strerror(EACCES))
    except OSError as error:
        refuse(f"-o {path}: {error.strerror}; give a folder to write in")


def _either(names: object) -> str:
    *first, last = get_args(names)
    return f"{', '.join(first)} or {last}."


ScenarioArgument = Annotated[
    str, argument("A built-in scenario, a .toml file, or a resolved .json.")
]
LogArgument = Annotated[Path, argument("An MCAP log of a team, or the folder of its run.")]
MapFiles = Annotated[
    list[Path] | None,
    option(
        "A saved map of an earlier day, which the team's map joins; repeatable.", "--map", "FILE"
    ),
]
Localise = Annotated[
    bool, rare("Localise robots in the map of --map, which stays as it is.", "--localise")
]
JsonFile = Annotated[Path | None, rare("Write the figures as JSON, too.", "--json", "FILE")]
Connect = Annotated[str, network("The router's endpoint, as tcp/HOST:PORT.", "ENDPOINT")]
Keys = Annotated[
    Path | None,
    network("Folder with the certificate of this process, as `teamslam keys` makes them.", "DIR"),
]
ASSUMED = (
    "the built-in one `recorded` is taken. It assumes odometry that is off by 5 cm and 2° after a "
    "metre and by 6° after a radian, ranges by 5 cm and 2 %, bearings by 1.7°"
)
LOOPBACK = "tcp/127.0.0.1:7447"
ANY_PORT = "tcp/127.0.0.1:0"
TeamOption = Annotated[str, option("The team's name; a scenario's own if not set there.", "NAME")]
Seed = Annotated[int | None, option("Seed of the world and of every estimator.", "N", least=0)]
Robots = Annotated[int | None, option("How many robots, 1 to 1000.", "N")]
Peers = Annotated[bool, rare("Each robot keeps the team's set and folds it by itself.", "--peers")]
Pieces = Annotated[
    int | None,
    rare(
        "Cut the log of a data set of one robot into this many robots with unknown initial poses.",
        "N",
        least=1,
        most=100,
    ),
]
IdentitiesOption = Annotated[
    str | None,
    option(
        "hidden: run any world or data set as if its landmarks had no names; or known.", "WHICH"
    ),
]
EstimatorOption = Annotated[str | None, rare(_either(Estimator), "NAME")]
FusionOption = Annotated[str | None, rare(_either(FusionRule), "RULE")]
Dataset = Annotated[
    Path | None,
    option(
        "A data set: a folder of CSV tables, a ROS 2 bag, a UTIAS set, or a graph (isam, "
        "g2o, pyfg).",
        "SET",
    ),
]
SpeedText = Annotated[
    str, option("Multiple of real time, or max: as fast as the measurements are taken.", "X")
]


def check_pieces(scenario: Scenario) -> None:
    """Refuse worlds that are no data set of one robot with detections."""
    if not isinstance(scenario.world, UnlabelledWorld | GraphWorld):
        refuse(
            "--pieces cuts the log of a data set of one robot with detections.csv: give it with "
            "--dataset, or --robots for other worlds"
        )


def connect_bus(
    team: str, connect: str, keys: Path | None, node: str, stop: threading.Event | None = None
) -> "ZenohBus":
    """Connect to the router, with keys by TLS; stop: ends the wait for it."""
    from teamslam.team.wire.zenoh.bus import ZenohBus

    own = None if keys is None else own_keys(keys, node, team)
    return ZenohBus(team, over_tls(connect) if keys else connect, keys=own, stop=stop)


def own_keys(folder: Path, node: str, team: str | None = None) -> "Credentials":
    """Checked credentials of a node; warns of near expiry."""
    from teamslam.team.keys.credentials import credentials_of

    own = credentials_of(folder, node, team)
    for warning in own.warnings():
        logging.getLogger("teamslam").warning("%s", warning)
    return own


def over_tls(endpoint: str) -> str:
    """Endpoint over TLS if it is a default one."""
    return endpoint.replace("tcp/", "tls/", 1) if endpoint in (LOOPBACK, ANY_PORT) else endpoint


def is_loopback(endpoint: str) -> bool:
    """Whether an endpoint is local."""
    protocol, _, address = endpoint.partition("/")
    if protocol.startswith("unix"):
        return True
    host = re.sub(r":\d+([?#].*)?$", "", address).strip("[]")
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def refuse_open_door(listen: str, *, keys: bool, insecure: bool) -> None:
    """Refuse a router that admits every stranger."""
    if "/" not in listen:
        refuse(f"can not listen at {listen}: not an endpoint, as tcp/HOST:PORT")
    if not (keys or insecure or is_loopback(listen)):
        refuse(
            f"--listen {listen}: any process that reaches it could end the run or forge its map: "
            "give --keys DIR (see `teamslam keys`), or --insecure where nobody else can reach it"
        )


def write_json(path: Path | None, figures: object) -> None:
    """Write figures to a --json file, if given."""
    if path is None:
        return
    is_device = path.exists() and not path.is_file()  # such as /dev/stdout
    part = path if is_device else path.with_name(f".{path.name}.part")
    part.write_text(json.dumps(figures, indent=2) + "\n", "utf-8")
    if not is_device:
        part.replace(path)


def refuse_existing(path: Path) -> None:
    """Refuse an existing path."""
    if path.exists():
        refuse(f"{path} exists: choose another name or remove it")


def open_log(path: Path) -> "Log":
    """Open a log, and warn of messages that it lacks."""
    from teamslam.team.recording import reader

    log = reader.open_log(path)
    warn_of_holes(log)
    return log


def warn_of_holes(log: "Log") -> "Sequence[Finding]":
    """Warn of messages that the log lacks; return all findings."""
    from teamslam.team.recording.check import MOST_HOLES, holes

    found = holes(log)
    for finding in found[:MOST_HOLES]:
        click.echo(f"warning: {log.path} is not whole, {one_line(str(finding))}", err=True)
    if len(found) > MOST_HOLES:
        more = count_noun(len(found) - MOST_HOLES, "more finding")
        click.echo(f"warning: {more}: `teamslam log check {log.path}` names all", err=True)
    return found


def fail_if_cut(log: "Log", thing: str) -> None:
    """Fail for a log whose end is missing."""
    if not log.complete:
        fail(
            f"{log.path} is cut, so the {thing} is of the part before the cut: `teamslam repair "
            f"{log.path} -o FIXED.mcap` completes the log"
        )


def set_aside(file: Path) -> Path:
    """Rename a file to the first free number."""
    number = 1
    while (aside := file.with_name(f"{file.name}.{number}")).exists():
        number += 1
    file.rename(aside)
    click.echo(f"{file} was there already: it is now {aside}", err=True)
    return aside


def count_noun(count: int, what: str) -> str:
    """Count with noun: `1 robot`, `3 robots`."""
    return f"{count:,} {what}{'' if count == 1 else 's'}"


def parse_speed(text: str) -> float:
    """Multiple of real time; infinite for `max`."""
    speed = math.inf if text == "max" else number_in(text)
    if not 0.0 < speed < math.inf and text != "max":
        refuse(f"--speed {text}: give a positive number, or max")
    return speed


def number_in(text: str) -> float:
    """Number of a text, or NaN."""
    try:
        return float(text)
    except ValueError:
        return math.nan


def parse_start(text: str) -> tuple[str, tuple[float, ...]]:
    """Robot (may be empty) and numbers of `[ROBOT:]x,y,theta[,sigma,sigma]`."""
    robot, colon, numbers = text.rpartition(":")
    pose = tuple(map(number_in, numbers.split(",")))
    if len(pose) not in (3, 5) or any(map(math.isnan, pose)) or (colon and not robot):
        refuse(f"--start {text}: give x,y,theta in m and rad, as 0,0,1.57 or r1:0,0,1.57")
    if abs(pose[2]) > 2.0 * math.pi:
        refuse(f"--start {text}: theta is in radians, in one turn: {pose[2]:g} is not")
    return robot, pose


def scenario_for(dataset: Path) -> str:
    """Scenario for a data set without one; prints its name."""
    from teamslam.sim.scenarios.source import scenario_beside

    name = scenario_beside(dataset)
    if name == ASSUMED_NAME:
        click.echo(f"no scenario given, and no scenario.toml in {dataset}: {ASSUMED}", err=True)
    elif name != "utias":
        click.echo(f"scenario: {name}", err=True)
    return name


def scenario_of(name: str) -> Scenario:
    """Scenario by name, TOML file, or launch's JSON."""
    path = Path(name)
    if path.suffix == ".json" and path.is_file():
        try:
            return loads(path.read_text("utf-8"))
        except ScenarioError as error:
            raise ScenarioError(f"{name}: {error}") from None
    return load(name)


def saved_maps(paths: "Sequence[Path] | None") -> "list[SavedMap]":
    """Read saved maps of different names, without measurements in common."""
    if not paths:
        return []
    # A log's reader comes with it.
    from teamslam.team.saved_map import SavedMapError, find_overlap, read_map

    with refusing(SavedMapError):
        found = [read_map(path) for path in paths]
    names = sorted(each.name for each in found)
    twice = next((a for a, b in pairwise(names) if a == b), None)
    if twice is not None:
        refuse(f"two maps have the name {twice}: save one of them by another --name")
    overlap = find_overlap(dict(zip(map(str, paths), found, strict=True)))
    if overlap is not None:
        refuse(f"--map: {overlap}")
    return found


def check_joins(scenario: "Scenario", maps: "Sequence[SavedMap]") -> None:
    """Refuse maps for a rule that joins no submaps."""
    if maps and scenario.central.fusion != "join":
        refuse(f"--map: the fusion rule {scenario.central.fusion} joins no saved map")


def check_localises(maps: "Sequence[Path] | None", scenario: "Scenario | None" = None) -> None:
    """Refuse to localise but in one map, by a centre."""
    if len(maps or ()) != 1:
        refuse("--localise: give one saved map by --map")
    if scenario is not None and (scenario.peers or not scenario.centre):
        refuse("--localise: a team without a centre extends its map; launch it with one")


def check_names(team: str, robot: str | None = None) -> None:
    """Refuse an invalid name of a team, robot or saved map."""
    from teamslam.team.keys.roster import ROBOT, TEAM

    if robot is not None and not ROBOT.fullmatch(robot.removeprefix(MAP)):
        refuse(f"{robot!r} is no robot's name")
    if not TEAM.fullmatch(team):
        refuse(f"{team!r} is no team's name")


def signer_of(keys: Path | None, node: str, team: str) -> "Signer | None":
    """Signer of a node; None without keys."""
    from teamslam.team.keys.signing import Signer

    return None if keys is None else Signer(own_keys(keys, node, team))
