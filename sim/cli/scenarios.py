"""Commands on scenarios: scenarios, simulate."""

import re
import shutil
import textwrap
from itertools import takewhile
from pathlib import Path
from typing import Annotated

import click

from teamslam.sim.cli import options as opt
from teamslam.sim.cli.commands import Group, option, output_option, refuse
from teamslam.sim.scenarios.document import builtin_text
from teamslam.sim.scenarios.scenario import builtin_names, load, with_options

app = Group()
_PARENTHESES = re.compile(r"\s*\([^()]*\)")
_CLAUSE_END = re.compile(r"[:;]|(?<!\b[A-Z])\.(?=\s|$)")


@app.declare("teamslam scenarios --show waypoints > mine.toml")
def scenarios(
    show: Annotated[str | None, option("Print this one as TOML, to read or to begin with.")] = None,
) -> None:
    """List the built-in scenarios, or show one."""
    if show is not None:
        if show not in builtin_names():
            known = ", ".join(builtin_names())
            refuse(f"--show {show}: no built-in scenario; known: {known}")
        click.echo(builtin_text(show), nl=False)
        return
    width = shutil.get_terminal_size().columns
    for name in builtin_names():
        team = opt.count_noun(len(load(name).robots), "robot")
        start = f"{name:14} {team:10} "
        click.echo(start + textwrap.shorten(_summary(name), width - len(start), placeholder=" …"))


def _summary(name: str) -> str:
    """First clause of the opening comment, without parentheses."""
    lines = takewhile(lambda line: line.startswith("#"), builtin_text(name).splitlines())
    comment = " ".join(line.lstrip("# ") for line in lines)
    while comment != (comment := _PARENTHESES.sub("", comment)):
        pass
    return _CLAUSE_END.split(comment)[0]


@app.declare("teamslam simulate waypoints -o my_world")
def simulate(
    scenario: opt.ScenarioArgument,
    output: Annotated[Path, output_option("Folder for the data set.")],
    robots: opt.Robots = None,
    seed: opt.Seed = None,
    identities: opt.IdentitiesOption = None,
) -> None:
    """Write a scenario's world as a data set, with a scenario that runs it.

    In the UTIAS format; as CSV tables if that lacks the measurements: motions,
    points, covariances, detections without identities (their labels are in a
    separate file).
    """
    from teamslam.sim.datasets.folder_writer import write_folder
    from teamslam.sim.datasets.utias import beyond_utias, write_utias
    from teamslam.sim.scenarios.scenario import data_set_scenario, folder_scenario
    from teamslam.sim.scenarios.source import streams_of

    if output.exists() and any(output.iterdir()):
        refuse(f"{output} is not empty: give a new folder")
    resolved = with_options(
        opt.scenario_of(scenario), robots=robots, seed=seed, identities=identities
    )
    streams = streams_of(resolved)
    tables = bool(beyond_utias(streams))
    (write_folder if tables else write_utias)(streams, output)
    scenario_file = output / "scenario.toml"
    text = folder_scenario(resolved) if tables else data_set_scenario(resolved)
    scenario_file.write_text(text, encoding="utf-8")
    click.echo(f"wrote {output}; `teamslam launch {scenario_file}` runs the team on it")
