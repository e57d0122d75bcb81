"""What the commands have in common: options, their parsing, and errors with their exit status."""

import math
from pathlib import Path
from typing import Annotated, NoReturn, get_args

import typer

from sim.scenario.checks import ScenarioError
from sim.scenario.scenario import Scenario, load, loads
from team.config import Estimator, FusionRule

WRONG_USE = 2
FAILED = 1


def _either(names: object) -> str:
    """The values of a Literal as a sentence: `a, b or c.`"""
    *first, last = get_args(names)
    return f"{', '.join(first)} or {last}."


ScenarioArgument = Annotated[
    str, typer.Argument(help="A built-in scenario, a .toml file, or a resolved .json.")
]
Connect = Annotated[
    str, typer.Option(help="The router's endpoint, as tcp/HOST:PORT.", metavar="ENDPOINT")
]
Seed = Annotated[
    int | None, typer.Option(help="Seed of the world and of every estimator.", min=0, metavar="N")
]
Robots = Annotated[int | None, typer.Option(help="How many robots, 1 to 100.", metavar="N")]
EstimatorOption = Annotated[str | None, typer.Option(help=_either(Estimator), metavar="NAME")]
FusionOption = Annotated[str | None, typer.Option(help=_either(FusionRule), metavar="RULE")]
Dataset = Annotated[
    Path | None,
    typer.Option(help="A UTIAS data set: folder, or zip as distributed.", metavar="SET"),
]
SpeedText = Annotated[
    str,
    typer.Option(help="Multiple of real time, or max: as fast as everyone keeps up.", metavar="X"),
]


def fail(message: str, status: int) -> NoReturn:
    """Print an error and end with its status."""
    typer.secho(f"error: {message}", fg="red", err=True)
    raise typer.Exit(status)


def refuse_existing(path: Path) -> None:
    """End with an error where there is something already."""
    if path.exists():
        fail(f"{path} exists: choose another name or remove it", WRONG_USE)


def counted(count: int, what: str) -> str:
    """A count with its noun: `1 robot`, `3 robots`."""
    return f"{count:,} {what}{'' if count == 1 else 's'}"


def parsed_speed(text: str) -> float:
    """A positive multiple of real time; infinite for `max`."""
    if text == "max":
        return math.inf
    try:
        speed = float(text)
    except ValueError:
        speed = math.nan
    if not (speed > 0.0 and math.isfinite(speed)):
        fail(f"--speed {text}: give a positive number, or max", WRONG_USE)
    return speed


def scenario_of(name: str) -> Scenario:
    """The scenario by name, from TOML, or from the JSON that launch hands to its processes."""
    path = Path(name)
    if path.suffix == ".json" and path.is_file():
        try:
            return loads(path.read_text("utf-8"))
        except ScenarioError as error:
            raise ScenarioError(f"{name}: {error}") from None
    return load(name)
