"""Commands about maps: save the final map of a run, show a saved one, request that of a peer."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import click
import msgspec

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
from teamslam.team.wire.arrays import ids

if TYPE_CHECKING:
    from teamslam.team.wire.messages import SavedMap

app = Group(
    "map",
    help="Save the final map of a run, show a saved map, or request a peer's.",
    epilog="teamslam map save runs/first -o site.map\nteamslam launch waypoints --map site.map",
)


@app.declare("teamslam map save runs/first -o site.map")
def save(
    log: Annotated[
        Path | None, argument("A log, or the folder of its run; without --team.")
    ] = None,
    *,
    output: Annotated[Path, output_option("The file to write.", "FILE")],
    name: Annotated[
        str | None, option("Name of the map, as site; default: that of the file.", "NAME")
    ] = None,
    team: Annotated[
        str | None, option("A running team, whose centre is asked for its map.", "NAME")
    ] = None,
    connect: opt.Connect = opt.LOOPBACK,
    keys: opt.Keys = None,
    patience: Annotated[float, option("Seconds to wait for the running centre.", least=0.1)] = 60.0,
) -> None:
    """Save the final map of a run as one Gaussian, for the teams of later days.

    The map is solved again from the recorded submaps, or by the centre of a
    running team (--team) from those that it has. If the run has loaded a saved
    map, the new one contains it. A later team loads the file with --map.
    """
    from teamslam.team.saved_map import SavedMapError, map_name, write_map

    if (log is None) == (team is None):
        refuse("give either a log or, for a running team, --team NAME")
    with refusing(SavedMapError):
        named = map_name(name or output.stem)
        found = _map_of_log(log) if log is not None else _map_of_team(team, connect, keys, patience)
        saved = msgspec.structs.replace(found, name=named)
        write_map(output, saved)
    count, days = len(ids(saved.ids, "ids")), len(saved.sets)
    size = output.stat().st_size / 1e3
    click.echo(
        f"wrote {output}: the map {saved.name} of {count} landmarks, {days} set"
        f"{'' if days == 1 else 's'}, {size:,.0f} kB"
    )


def _map_of_log(log: Path) -> "SavedMap":
    from teamslam.central.desk.verification.centre import recorded_map
    from teamslam.central.desk.verification.recorded import RerunError, index_log
    from teamslam.central.diagnosis import describe
    from teamslam.central.saved_maps import NothingToSaveError
    from teamslam.team.recording.reader import open_log
    from teamslam.team.wire.channels import FINAL_MAP, TEAM_FINAL
    from teamslam.team.wire.messages import FusedMap

    with failing(RerunError, NothingToSaveError, at=log):
        recorded = index_log(open_log(log))
        saved = recorded_map(recorded, "site")
    finals = recorded.of(FusedMap, FINAL_MAP) or recorded.of(FusedMap, TEAM_FINAL)
    for each in finals[-1].diagnosis:
        if each.cause == "landmark_moved":
            click.echo(f"note: {describe(each)}")
    return saved


def _map_of_team(team: str | None, connect: str, keys: Path | None, patience: float) -> "SavedMap":
    from teamslam.team.wire.bus import BusError
    from teamslam.team.wire.channels import SITE
    from teamslam.team.wire.codec import decoded
    from teamslam.team.wire.messages import FoldRequest, SavedMap

    with opt.connect_bus(str(team), connect, keys, "operator") as bus, failing(BusError):
        replies = bus.ask(SITE, "", FoldRequest(stamp_ns=0), patience)
    if not replies:
        fail(f"no centre of the team {team} is running at {connect}: save from its log")
    return decoded(replies[-1], SavedMap)


@app.declare("teamslam map show site.map")
def show(file: Annotated[Path, argument("A saved map.")], json_file: opt.JsonFile = None) -> None:
    """Show a saved map: where it comes from, and its landmarks as CSV."""
    from teamslam.team.saved_map import map_figures

    saved = opt.saved_maps([file])[0]
    figures = map_figures(saved)
    opt.write_json(json_file, figures)
    landmarks, own = figures.pop("landmarks"), figures.pop("own")
    for key, value in figures.items():
        if value or not isinstance(value, list | tuple):
            is_list = isinstance(value, list | tuple)
            click.echo(f"# {key}: {', '.join(map(str, value)) if is_list else value}")
    for each in own:
        value, sigma = (f"{each[key]:.4g}" for key in ("value", "sigma"))
        click.echo(f"# {each['bias']} of {each['robot']}: {value} ± {sigma}")
    placed = "latitude_deg" in landmarks[0]
    click.echo("landmark,x,y,sigma_x,sigma_y,submaps" + ",latitude,longitude" * placed)
    for each in landmarks:
        place = f",{each['latitude_deg']:.9f},{each['longitude_deg']:.9f}" if placed else ""
        click.echo(
            f"{each['landmark']},{each['x_m']:.4f},{each['y_m']:.4f},"
            f"{each['sigma_x_m']:.4f},{each['sigma_y_m']:.4f},{each['submaps']}{place}"
        )


@app.declare("teamslam map peer r3 --team waypoints")
def peer(
    robot: Annotated[str, argument("The peer that is to fold, as r3.")],
    team: opt.TeamOption,
    connect: opt.Connect = opt.LOOPBACK,
    keys: opt.Keys = None,
    patience: Annotated[float, option("Seconds to wait for the answer.", least=0.1)] = 60.0,
) -> None:
    """Request a peer's fold of its present set (`--fold request`), and print the map as CSV."""
    from teamslam.team.wire.arrays import floats
    from teamslam.team.wire.bus import BusError
    from teamslam.team.wire.channels import FOLD
    from teamslam.team.wire.codec import decoded
    from teamslam.team.wire.messages import FoldRequest, FusedMap

    with opt.connect_bus(team, connect, keys, "operator") as bus, failing(BusError):
        replies = bus.ask(FOLD, robot, FoldRequest(stamp_ns=0), patience)
    if not replies:
        fail(f"{robot} has no map to give: is it a peer of {team} that is running?")
    fused = decoded(replies[-1], FusedMap)
    click.echo("landmark,x,y")
    means = floats(fused.means, "means").reshape(-1, 2)
    for landmark, (x, y) in zip(ids(fused.ids, "ids").tolist(), means, strict=True):
        click.echo(f"{landmark},{x:.4f},{y:.4f}")
