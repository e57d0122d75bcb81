"""Commands of a team's processes are parsed without Typer, and as by Typer."""

import pytest
import typer

from teamslam.sim.cli import nodes
from teamslam.sim.cli.entry import PROCESSES
from teamslam.sim.cli.main import app
from teamslam.sim.cli.plain import parse_plainly

WHOLE = typer.main.get_command(app)


@pytest.mark.parametrize(
    "words",
    [
        "router",
        "router --listen tcp/0.0.0.0:7447 --insecure",
        "router --insecure --no-insecure --keys=keys",
        "world waypoints --speed max --no-recorder",
        "world --dataset folder/set utias --connect tcp/h:1",
        "robot s.json r1 --keys k --log own.mcap",
        "robot s.json r1 --peers --set=r1.set --fold end",
        "central s.json --peers --keys keys",
        "record s.json -o a.mcap --no-join",
        "record s.json --output a.mcap --resume",
    ],
)
def test_what_is_parsed_is_as_by_typer(words: str) -> None:
    name, *rest = words.split()
    command = WHOLE.commands[name]  # type: ignore[attr-defined]
    parsed = command.make_context(name, list(rest)).params
    assert parse_plainly(getattr(nodes, name), rest) == parsed


@pytest.mark.parametrize(
    "words",
    [
        "robot", "robot s.json", "robot s.json r1 r2", "robot s.json r1 --help",
        "robot s.json r1 --conect a", "robot s.json r1 --connect", "world s --seed 3",
        "central s --patience 3", "central s --map a.toml", "record s", "record s -ofile",
        "router --listen --insecure",
    ],
)  # fmt: skip
def test_help_mistakes_and_numbers_are_left_to_typer(words: str) -> None:
    name, *rest = words.split()
    assert name in PROCESSES
    assert parse_plainly(getattr(nodes, name), rest) is None
