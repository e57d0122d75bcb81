"""Command `teamslam keys`."""

from pathlib import Path
from typing import Annotated

import typer

from teamslam.sim.cli.help import Command, output_option
from teamslam.sim.cli.options import WRONG_USE, Robots, fail, scenario_of
from teamslam.sim.scenarios.scenario import with_options

app = typer.Typer()


@app.command(
    cls=Command,
    epilog="teamslam keys waypoints -o keys --scenario waypoints --router 192.168.1.5",
)
def keys(
    team: Annotated[str, typer.Argument(help="The team's name, as its scenario has it.")],
    output: Annotated[Path, output_option("The folder; it holds the authority, too.")],
    scenario: Annotated[
        str | None, typer.Option(help="For every robot of a scenario.", metavar="SCENARIO")
    ] = None,
    robots: Robots = None,
    robot: Annotated[
        list[str] | None, typer.Option(help="For a robot by name, too; again and again.")
    ] = None,
    router: Annotated[
        list[str] | None,
        typer.Option(help="Name or address by which robots reach the router.", metavar="HOST"),
    ] = None,
    days: Annotated[float, typer.Option(help="How long new certificates are good.")] = 90.0,
    renew: Annotated[
        list[str] | None,
        typer.Option(help="A new certificate for a node, as robot-r1, or all.", metavar="NODE"),
    ] = None,
    revoke: Annotated[
        list[str] | None, typer.Option(help="Revoke this node's certificate.", metavar="NODE")
    ] = None,
    replay: Annotated[
        bool,
        typer.Option("--replay", help="One for `teamslam replay`, which may publish on all keys."),
    ] = False,
) -> None:
    """Make a team's certificates: an authority, and one for each process and robot.

    Existing certificates are kept, so a robot is added by naming it.
    docs/security.md lists which files go where.
    """
    from teamslam.team.keys.authority import make_keys
    from teamslam.team.keys.roster import REPLAY, ROBOT, TEAM, nodes_of

    if not TEAM.fullmatch(team):
        fail(f"{team!r} is no team's name: letters, digits, dot, dash and underscore", WRONG_USE)
    if not days > 0.0:
        fail(f"--days {days:g}: give a positive number", WRONG_USE)
    names = list(robot or ())
    if scenario is not None:
        resolved = with_options(scenario_of(scenario), robots=robots)
        names += [each.id for each in resolved.robots]
        if resolved.team != team:
            typer.echo(
                f"warning: {scenario} is of the team {resolved.team!r}, these keys of {team!r}",
                err=True,
            )
    for name in names:
        if not ROBOT.fullmatch(name):
            fail(f"{name!r} is no robot's name", WRONG_USE)
    made = make_keys(
        output,
        team,
        [*nodes_of(dict.fromkeys(names)), *([REPLAY] if replay else [])],
        hosts=router or (),
        days=days,
        renew=renew or (),
        revoke=revoke or (),
    )
    for what, nodes in (("made", made.made), ("kept", made.unchanged), ("revoked", made.revoked)):
        if nodes:
            typer.echo(f"{what:8} {', '.join(nodes)}")
    if made.made:
        typer.echo(f"good until {made.ends:%Y-%m-%d %H:%M} UTC")
        typer.echo("copy to each computer ca.pem and NODE.pem, NODE.key of its processes;")
        typer.echo("to the router's, roster.json too; ca.key stays here")
    if made.revoked or made.made:
        typer.echo("a router that runs takes the roster when it is started again")
