"""Command `teamslam status`."""

from typing import Annotated, Any

import typer

from teamslam.central.desk.names import in_order
from teamslam.sim.cli.help import Command
from teamslam.sim.cli.options import (
    FAILED,
    LOOPBACK,
    Connect,
    JsonFile,
    Keys,
    TeamOption,
    check_names,
    connect_bus,
    fail,
    write_json,
)

app = typer.Typer()


@app.command(cls=Command, epilog="teamslam status --team waypoints")
def status(
    team: TeamOption,
    connect: Connect = LOOPBACK,
    keys: Keys = None,
    seconds: Annotated[
        float, typer.Option(help="Seconds for which the team is observed.", min=0.5)
    ] = 3.0,
    json_file: JsonFile = None,
) -> None:
    """Show the nodes of a running team: rates, clocks, dependencies, and remedies."""
    from rich.console import Console
    from rich.table import Table

    from teamslam.central.desk.presence import Presence

    check_names(team)
    presence = Presence()
    with connect_bus(team, connect, keys, "operator") as bus:
        presence.take(bus, seconds)
        others = [] if presence.members else bus.other_teams()
    if not presence.members:
        but = f", but of {', '.join(others)}" if others else ""
        fail(f"no node of the team {team} is at {connect}{but}: see --team, --connect", FAILED)
    rows = _rows(presence)
    table = Table("node", "there", "state", "measured", "per s", "taken", "clock [s]")
    for row in rows:
        table.add_row(*(_cell(row[name]) for name in row if name != "warnings"))
    console = Console()
    console.print(table)
    advice = presence.advice()
    for line in advice:
        console.print(f"- {line}", markup=False, highlight=False, soft_wrap=True)
    write_json(json_file, {"nodes": rows, "advice": advice})


def _rows(presence: Any) -> list[dict[str, Any]]:
    clocks = presence.clocks()
    rows = []
    for node in in_order(presence.members):
        member = presence.members[node]
        figures = {} if member.status is None else member.status.figures
        rows.append(
            {
                "node": node,
                "there": member.alive,
                "state": None if member.status is None else member.status.state,
                "measured": figures.get("measurements"),
                "per_s": member.rate if "measurements" in figures else None,
                "taken": figures.get("delivered"),
                "clock_s": clocks.get(node),
                "warnings": [] if member.status is None else list(member.status.warnings),
            }
        )
    return rows


def _cell(value: object) -> str:
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:,.1f}".removesuffix(".0") if isinstance(value, float) else str(value)
