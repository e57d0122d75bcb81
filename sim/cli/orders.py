"""Commands on a running team: withdraw, verdict, end, status, keys."""

from pathlib import Path
from typing import Annotated, Any

import click

from teamslam.central.desk.names import in_order
from teamslam.sim.cli import options as opt
from teamslam.sim.cli.commands import (
    Group,
    argument,
    fail,
    failing,
    option,
    output_option,
    refuse,
    refusing,
)
from teamslam.sim.cli.results import print_table
from teamslam.sim.scenarios.scenario import with_options
from teamslam.team.wire.arrays import ids

Reason = Annotated[str, option("Why, for the log.")]

app = Group()


@app.declare("teamslam withdraw r3 --team waypoints --reason 'wheel is loose'")
def withdraw(
    robot: Annotated[str, argument("The robot's name, as r3.")],
    team: opt.TeamOption,
    connect: opt.Connect = opt.LOOPBACK,
    keys: opt.Keys = None,
    reason: Reason = "ordered",
    patience: Annotated[float, option("Seconds to wait for a map without it.", least=0.0)] = 60.0,
) -> None:
    """Withdraw a robot from a running team: the map becomes that of a team without it.

    The order is recorded and cannot be undone.
    """
    from teamslam.central.desk.orders import WithdrawError, withdraw as order

    opt.check_names(team, robot)
    with opt.connect_bus(team, connect, keys, "operator") as bus, failing(WithdrawError):
        fused = order(bus, robot, reason, patience, opt.signer_of(keys, "operator", team))
    landmarks = len(ids(fused.ids, "ids"))
    click.echo(f"{robot} is withdrawn; the map of {landmarks} landmarks goes without it")


@app.declare("teamslam verdict same r1/1/12/7 r2/1/4/3 --team waypoints")
def verdict(
    word: Annotated[str, argument("same: they are one landmark; different: two.")],
    first: Annotated[str, argument("robot/incarnation/submap/landmark, as r1/1/12/7.")],
    second: Annotated[str, argument("The other one, likewise.")],
    team: opt.TeamOption,
    connect: opt.Connect = opt.LOOPBACK,
    keys: opt.Keys = None,
    reason: Reason = "seen by an operator",
    withdraw: Annotated[bool, option("Withdraw this verdict, for good.", "--withdraw")] = False,
    patience: Annotated[
        float, option("Seconds to wait for a map that takes it into account.", least=0.0)
    ] = 60.0,
) -> None:
    """Give a running team the verdict that two unnamed landmarks are one, or two.

    The page of `teamslam view` shows their names at a click. The verdict is
    recorded and holds until it is withdrawn.
    """
    from teamslam.central.desk.evaluation.states import contradicting, describe_verdict
    from teamslam.central.desk.orders import NoRobotError, WithdrawError, judge, local_landmark
    from teamslam.team.wire.messages import Judgement

    if word not in ("same", "different"):
        refuse(f"{word!r} is no verdict: same or different")
    opt.check_names(team)
    with refusing(ValueError):
        one, two = local_landmark(first), local_landmark(second)
    if one == two:
        refuse(f"{first} is one landmark, and needs no verdict")
    with opt.connect_bus(team, connect, keys, "operator") as bus:
        try:
            judgement = Judgement(first=one, second=two, same=word == "same")
            signer = opt.signer_of(keys, "operator", team)
            fused = judge(bus, judgement, reason, patience, signer, withdrawn=withdraw)
        except NoRobotError as error:
            refuse(str(error))
        except WithdrawError as error:
            fail(str(error))
    opposite = "different" if word == "same" else "same"
    chain = () if withdraw else contradicting(judgement, fused.verdicts)
    if len(chain) > 1:
        every = "; ".join(
            map(describe_verdict, (*chain[:-1], judgement) if word == "same" else chain)
        )
        apart = chain[-1] if word == "same" else judgement
        fail(
            f"these verdicts contradict each other: {every}; yet {describe_verdict(apart)}, which "
            "is what holds, so that one of the others has no effect: withdraw what is wrong by "
            "`teamslam verdict … --withdraw`"
        )
    if chain:
        remedy = f"`teamslam verdict {opposite} {first} {second} --withdraw` withdraws that"
        contradiction = f"{first} and {second} have an earlier verdict, {opposite}"
        if word == "same":
            fail(f"{contradiction}, which is what holds; {remedy}")
        click.echo(f"warning: {contradiction}; different is what holds; {remedy}", err=True)
    landmarks = len(ids(fused.ids, "ids"))
    are = "no longer have the verdict that they are" if withdraw else "are"
    click.echo(f"{first} and {second} {are} {word}; the map of {landmarks} landmarks rests on it")


@app.declare("teamslam end --team waypoints\nteamslam end --team waypoints --without r3")
def end(
    team: opt.TeamOption,
    without: Annotated[
        str | None, option("A lost robot, for which the team no longer waits.")
    ] = None,
    connect: opt.Connect = opt.LOOPBACK,
    keys: opt.Keys = None,
    reason: Reason = "ordered",
    patience: Annotated[
        float, option("Seconds to wait for the centre to follow.", least=0.0)
    ] = 60.0,
) -> None:
    """End a live team: every driver ends its stream, and the centre publishes the final map.

    With --without: end a running team without a lost robot. Its submaps stay in
    the map, which names it as lost and is provisional, and every process ends
    with status 1. The router keeps the order until the end of the run, for a
    restarted centre.
    """
    from teamslam.central.desk.orders import WithdrawError, end_team, give_up

    opt.check_names(team, without)
    with opt.connect_bus(team, connect, keys, "operator") as bus, failing(WithdrawError):
        if without is None:
            end_team(bus, reason, patience)
        else:
            give_up(bus, without, reason, patience, opt.signer_of(keys, "operator", team))
    click.echo(f"the team no longer waits for {without}" if without else "the team ends")


@app.declare("teamslam status --team waypoints")
def status(
    team: opt.TeamOption,
    connect: opt.Connect = opt.LOOPBACK,
    keys: opt.Keys = None,
    seconds: Annotated[float, option("Seconds for which the team is observed.", least=0.5)] = 3.0,
    json_file: opt.JsonFile = None,
) -> None:
    """Show the nodes of a running team: rates, clocks, dependencies, and remedies."""
    from rich.table import Table

    from teamslam.central.desk.presence import Presence

    opt.check_names(team)
    presence = Presence()
    with opt.connect_bus(team, connect, keys, "operator") as bus:
        presence.take(bus, seconds)
        others = [] if presence.members else bus.other_teams()
    if not presence.members:
        but = f", but of {', '.join(others)}" if others else ""
        fail(f"no node of the team {team} is at {connect}{but}: see --team, --connect")
    rows = _rows(presence)
    table = Table("node", "there", "state", "measured", "per s", "taken", "clock [s]")
    for row in rows:
        table.add_row(*(_cell(row[name]) for name in row if name != "warnings"))
    print_table(table)
    advice = presence.advice()
    for line in advice:
        click.echo(f"- {line}")
    opt.write_json(json_file, {"nodes": rows, "advice": advice})


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


@app.declare("teamslam keys waypoints -o keys --scenario waypoints --router 192.168.1.5")
def keys(
    team: Annotated[str, argument("The team's name, as its scenario has it.")],
    output: Annotated[Path, output_option("The folder; it holds the authority, too.")],
    scenario: Annotated[str | None, option("For every robot of a scenario.", "SCENARIO")] = None,
    robots: opt.Robots = None,
    robot: Annotated[
        list[str] | None, option("For a robot by name, too; again and again.", "NAME")
    ] = None,
    router: Annotated[
        list[str] | None, option("Name or address by which robots reach the router.", "HOST")
    ] = None,
    days: Annotated[float, option("How long new certificates are good.")] = 90.0,
    renew: Annotated[
        list[str] | None, option("A new certificate for a node, as robot-r1, or all.", "NODE")
    ] = None,
    revoke: Annotated[list[str] | None, option("Revoke this node's certificate.", "NODE")] = None,
    replay: Annotated[
        bool, option("One for `teamslam replay`, which may publish on all keys.", "--replay")
    ] = False,
) -> None:
    """Make a team's certificates: an authority, and one for each process and robot.

    Existing certificates are kept, so a robot is added by naming it.
    docs/security.md lists which files go where.
    """
    from teamslam.team.keys.authority import make_keys
    from teamslam.team.keys.roster import REPLAY, ROBOT, TEAM, nodes_of

    if not TEAM.fullmatch(team):
        refuse(f"{team!r} is no team's name: letters, digits, dot, dash and underscore")
    if not days > 0.0:
        refuse(f"--days {days:g}: give a positive number")
    names = list(robot or ())
    if scenario is not None:
        resolved = with_options(opt.scenario_of(scenario), robots=robots)
        names += [each.id for each in resolved.robots]
        if resolved.team != team:
            click.echo(
                f"warning: {scenario} is of the team {resolved.team!r}, these keys of {team!r}",
                err=True,
            )
    for name in names:
        if not ROBOT.fullmatch(name):
            refuse(f"{name!r} is no robot's name")
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
            click.echo(f"{what:8} {', '.join(nodes)}")
    if made.made:
        click.echo(f"good until {made.ends:%Y-%m-%d %H:%M} UTC")
        click.echo("copy to each computer ca.pem and NODE.pem, NODE.key of its processes;")
        click.echo("to the router's, roster.json too; ca.key stays here")
    if made.revoked or made.made:
        click.echo("a router that runs takes the roster when it is started again")
