"""Commands that order a running team: withdraw, verdict, end."""

from typing import Annotated

import typer

from teamslam.sim.cli.help import Command
from teamslam.sim.cli.options import (
    FAILED,
    LOOPBACK,
    WRONG_USE,
    Connect,
    Keys,
    TeamOption,
    check_names,
    connect_bus,
    fail,
    failing,
    signer_of,
)
from teamslam.team.wire.arrays import ids

Reason = Annotated[str, typer.Option(help="Why, for the log.")]

app = typer.Typer()


@app.command(cls=Command, epilog="teamslam withdraw r3 --team waypoints --reason 'wheel is loose'")
def withdraw(
    robot: Annotated[str, typer.Argument(help="The robot's name, as r3.")],
    team: TeamOption,
    connect: Connect = LOOPBACK,
    keys: Keys = None,
    reason: Reason = "ordered",
    patience: Annotated[
        float, typer.Option(help="Seconds to wait for a map without it.", min=0.0)
    ] = 60.0,
) -> None:
    """Withdraw a robot from a running team: the map becomes that of a team without it.

    The order is recorded and cannot be undone.
    """
    from teamslam.central.desk.orders import WithdrawError
    from teamslam.central.desk.orders import withdraw as order

    check_names(team, robot)
    with connect_bus(team, connect, keys, "operator") as bus, failing(FAILED, WithdrawError):
        fused = order(bus, robot, reason, patience, signer_of(keys, "operator", team))
    landmarks = len(ids(fused.ids, "ids"))
    typer.echo(f"{robot} is withdrawn; the map of {landmarks} landmarks goes without it")


@app.command(cls=Command, epilog="teamslam verdict same r1/1/12/7 r2/1/4/3 --team waypoints")
def verdict(
    word: Annotated[str, typer.Argument(help="same: they are one landmark; different: two.")],
    first: Annotated[str, typer.Argument(help="robot/incarnation/submap/landmark, as r1/1/12/7.")],
    second: Annotated[str, typer.Argument(help="The other one, likewise.")],
    team: TeamOption,
    connect: Connect = LOOPBACK,
    keys: Keys = None,
    reason: Reason = "seen by an operator",
    withdraw: Annotated[
        bool, typer.Option("--withdraw", help="Withdraw this verdict, for good.")
    ] = False,
    patience: Annotated[
        float, typer.Option(help="Seconds to wait for a map that takes it into account.", min=0.0)
    ] = 60.0,
) -> None:
    """Give a running team the verdict that two unnamed landmarks are one, or two.

    The page of `teamslam view` shows their names at a click. The verdict is
    recorded and holds until it is withdrawn.
    """
    from teamslam.central.desk.evaluation.verdicts import contradicting, describe_verdict
    from teamslam.central.desk.orders import NoRobotError, WithdrawError, judge, local_landmark
    from teamslam.team.wire.messages import Judgement

    if word not in ("same", "different"):
        fail(f"{word!r} is no verdict: same or different", WRONG_USE)
    check_names(team)
    with failing(WRONG_USE, ValueError):
        one, two = local_landmark(first), local_landmark(second)
    if one == two:
        fail(f"{first} is one landmark, and needs no verdict", WRONG_USE)
    with connect_bus(team, connect, keys, "operator") as bus:
        try:
            judgement = Judgement(first=one, second=two, same=word == "same")
            signer = signer_of(keys, "operator", team)
            fused = judge(bus, judgement, reason, patience, signer, withdrawn=withdraw)
        except WithdrawError as error:
            fail(str(error), WRONG_USE if isinstance(error, NoRobotError) else FAILED)
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
            "`teamslam verdict … --withdraw`",
            FAILED,
        )
    if chain:
        remedy = f"`teamslam verdict {opposite} {first} {second} --withdraw` withdraws that"
        contradiction = f"{first} and {second} have an earlier verdict, {opposite}"
        if word == "same":
            fail(f"{contradiction}, which is what holds; {remedy}", FAILED)
        typer.echo(f"warning: {contradiction}; different is what holds; {remedy}", err=True)
    landmarks = len(ids(fused.ids, "ids"))
    are = "no longer have the verdict that they are" if withdraw else "are"
    typer.echo(f"{first} and {second} {are} {word}; the map of {landmarks} landmarks rests on it")


@app.command(
    cls=Command,
    epilog=("teamslam end --team waypoints\nteamslam end --team waypoints --without r3"),
)
def end(
    team: TeamOption,
    without: Annotated[
        str | None, typer.Option(help="A lost robot, for which the team no longer waits.")
    ] = None,
    connect: Connect = LOOPBACK,
    keys: Keys = None,
    reason: Reason = "ordered",
    patience: Annotated[
        float, typer.Option(help="Seconds to wait for the centre to follow.", min=0.0)
    ] = 60.0,
) -> None:
    """End a live team: every driver ends its stream, and the centre publishes the final map.

    With --without: end a running team without a lost robot. Its submaps stay in
    the map, which names it as lost and is provisional, and every process ends
    with status 1. The router keeps the order until the end of the run, for a
    restarted centre.
    """
    from teamslam.central.desk.orders import WithdrawError, end_team, give_up

    check_names(team, without)
    with connect_bus(team, connect, keys, "operator") as bus, failing(FAILED, WithdrawError):
        if without is None:
            end_team(bus, reason, patience)
        else:
            give_up(bus, without, reason, patience, signer_of(keys, "operator", team))
    typer.echo(f"the team no longer waits for {without}" if without else "the team ends")
