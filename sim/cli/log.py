"""Commands `teamslam log`: inspect, check, repair, cut, merge and export."""

from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import click
from click.exceptions import Exit

from teamslam.sim.cli import options as opt
from teamslam.sim.cli.commands import FAILED, Group, argument, option, output_option, refuse
from teamslam.sim.cli.recorded import repair
from teamslam.team.extras import install_command
from teamslam.team.wire.logs import one_line

if TYPE_CHECKING:
    from rich.table import Table

    from teamslam.team.recording.editing import KeySummary
    from teamslam.team.recording.reader import Log
    from teamslam.team.wire.channels import Channel

NewLog = Annotated[Path, output_option("The new log.", "FILE")]
ChannelNames = Annotated[str | None, option("Channels, as odometry,submap; all without.", "NAMES")]

Form = Literal["csv", "parquet", "tum", "utias", "rosbag2", "g2o", "isam", "pyfg"]
NOT_FINISHED = "not finished by its recorder"
app = Group(
    "log",
    help="Inspect, check, repair, cut, merge or export a log.",
    epilog="teamslam log info runs/first\nteamslam log export runs/first -o bag --format rosbag2",
)
app.declare("teamslam log repair team.mcap -o whole.mcap")(repair)


@app.declare("teamslam log info runs/first")
def info(
    log: opt.LogArgument,
    keys: Annotated[bool, option("A row per key, not per channel.", "--keys")] = False,
    json_file: opt.JsonFile = None,
) -> None:
    """Show the contents of a log: channels, messages, bytes, rates, span in team time, metadata."""
    from dataclasses import asdict

    from rich.console import Console
    from rich.text import Text

    from teamslam.team.recording.editing import summarise_log
    from teamslam.team.recording.reader import open_log

    opened = open_log(log)
    lacks = opt.warn_of_holes(opened)
    summary = summarise_log(opened)
    span = summary.span_ns()
    console = Console()
    messages, size = (sum(getattr(k, name) for k in summary.keys) for name in ("messages", "bytes"))
    state = "complete" if not lacks else "not whole" if opened.complete else NOT_FINISHED
    click.echo(
        f"{log}\nteam {one_line(opened.team)}, {state}: {messages:,} messages, "
        f"{size:,} payload bytes"
    )
    if span is not None:
        first, last = (ns * 1e-9 for ns in span)
        click.echo(
            f"measurements over {last - first:.3f} s of team time, {first:.3f} to {last:.3f} s"
        )
        console.print(_key_table(summary.keys, span[0], by_key=keys))
    for name, value in opened.metadata.items():
        console.print(Text(one_line(f"{name}: {value}")), no_wrap=True, overflow="ellipsis")
    figures = {
        "log": str(log),
        "team": opened.team,
        "complete": opened.complete,
        "lacks": [str(each) for each in lacks],
        "span_ns": span,
        "keys": [{**asdict(each), "rate_hz": each.rate_hz} for each in summary.keys],
        "metadata": opened.metadata,
        "damaged": summary.damaged,
    }
    opt.write_json(json_file, figures)


@app.declare("teamslam log check runs/first")
def check(log: opt.LogArgument) -> None:
    """Check that a log is whole and valid: checksums, schemas, counters, order, every message.

    Exit status 1 if anything is wrong; each finding is one line.
    """
    from teamslam.team.recording.check import check_log
    from teamslam.team.recording.reader import open_log

    findings = check_log(open_log(log))
    for finding in findings:
        click.echo(one_line(str(finding)))
    if findings:
        raise Exit(FAILED)
    click.echo(f"{log}: nothing wrong")


@app.declare("teamslam log cut runs/first --from 60 --to 120 -o minute.mcap")
def cut(
    log: opt.LogArgument,
    output: NewLog,
    from_s: Annotated[
        float | None, option("Seconds after the first measurement.", "--from")
    ] = None,
    to_s: Annotated[
        float | None, option("Seconds after the first measurement, excluded.", "--to")
    ] = None,
    channels: ChannelNames = None,
) -> None:
    """Write an interval of team time, or some channels, as a log of its own.

    Earlier configurations and true landmarks are kept, since they stay valid.
    """
    import math

    from teamslam.team.recording.editing import cut as cut_log

    bounds = (-math.inf if from_s is None else from_s, math.inf if to_s is None else to_s)
    given = [s for s in (from_s, to_s) if s is not None]
    if not (all(abs(s) < 4e9 for s in given) and bounds[0] < bounds[1]):
        refuse(f"--from {from_s} --to {to_s}: give seconds, the first before the second")
    chosen = _channels(channels)
    opt.refuse_existing(output)
    opened = opt.open_log(log)
    click.echo(f"{output}: {cut_log(opened, output, from_s, to_s, chosen)} messages")


@app.declare("teamslam log merge r1.mcap r2.mcap -o team.mcap")
def merge(
    logs: Annotated[list[Path], argument("Logs of one team: of robots, or parts.")], output: NewLog
) -> None:
    """Merge logs by team time; messages that several logs have are written once."""
    from teamslam.team.recording.editing import merge as merge_logs
    from teamslam.team.recording.reader import open_log

    opt.refuse_existing(output)
    merged = merge_logs([open_log(log) for log in logs], output)
    click.echo(f"{output}: {merged.messages} messages; {merged.duplicates} duplicates left out")
    opt.open_log(output)


@app.declare("teamslam log export runs/first -o paths --format tum")
def export(
    log: opt.LogArgument,
    output: Annotated[Path, output_option("A new folder.")],
    form: Annotated[
        Form,
        option(
            "A table per channel (csv, parquet), the robots' paths (tum), a data set (utias), "
            "a ROS 2 bag of poses, paths and maps (rosbag2), a landmark graph (g2o, isam, pyfg).",
            "--format",
        ),
    ] = "csv",
    channels: ChannelNames = None,
) -> None:
    """Write a log as tables, its paths for evo, or its measurements as a data set or graph."""
    from teamslam.central.desk.export.rosbag2 import export_rosbag2
    from teamslam.central.desk.export.take_home import export_tum
    from teamslam.sim.recorded.export import export_graph, export_utias

    opened = opt.open_log(log)
    chosen = _channels(channels)
    if output.exists() and (not output.is_dir() or any(output.iterdir())):
        refuse(f"{output} is there and not an empty folder: give a new one")
    if form in ("csv", "parquet"):
        lines = _export_tables(opened, output, chosen, parquet=form == "parquet")
    elif channels is not None:
        refuse(f"--channels is for tables: {form} is of all that the format has")
    elif form == "rosbag2":
        topics = sorted(export_rosbag2(opened, output).items())
        lines = [f"{output}: {topic}: {opt.count_noun(n, 'message')}" for topic, n in topics]
    elif form == "utias":
        robots = enumerate(export_utias(opened, output), 1)
        lines = [f"{output / f'Robot{number}_*.dat'}: {robot}" for number, robot in robots]
    else:
        paths = export_tum(opened, output) if form == "tum" else export_graph(opened, output, form)
        lines = [str(path) for path in paths]
    for line in lines:
        click.echo(line)


def _export_tables(
    log: "Log", folder: Path, channels: "list[Channel] | None", *, parquet: bool
) -> list[str]:
    from teamslam.team.recording.tables import CsvTable, ParquetTable, export_tables

    if parquet and find_spec("pyarrow") is None:
        refuse(f"--format parquet needs pyarrow: {install_command('parquet')}")
    exported = export_tables(log, folder, channels, ParquetTable if parquet else CsvTable)
    if exported.unsound:
        click.echo(f"left out: {exported.unsound} unsound messages", err=True)
    return [f"{path}: {opt.count_noun(rows, 'row')}" for path, rows in exported.rows.items()]


def _channels(names: str | None) -> "list[Channel] | None":
    if names is None:
        return None
    from teamslam.team.wire.channels import CHANNELS

    known = {channel.name: channel for channel in CHANNELS if channel.recorded}
    given = [name.strip() for name in names.split(",")]
    unknown = [name for name in given if name not in known]
    if unknown:
        refuse(f"--channels: no channel {unknown[0]!r}; there are {', '.join(known)}")
    return [known[name] for name in dict.fromkeys(given)]


def _key_table(keys: "Sequence[KeySummary]", start_ns: int, *, by_key: bool) -> "Table":
    """Rates [Hz] and spans [s after start_ns] by key, or by channel: means over keys that begin
    after start_ns.
    """
    from rich.table import Table
    from rich.text import Text

    groups: dict[str, list[KeySummary]] = {}
    for each in keys:
        groups.setdefault(each.key if by_key else each.channel, []).append(each)
    table = Table("key" if by_key else "channel")
    for title in ("keys", "messages", "bytes", "Hz", "from s", "to s"):
        table.add_column(title, justify="right")
    for name, of in groups.items():
        running = [each.rate_hz for each in of if each.first_ns >= start_ns]
        rates = [rate for rate in running if rate is not None]
        table.add_row(
            Text(one_line(name)),
            str(len(of)),
            f"{sum(each.messages for each in of):,}",
            f"{sum(each.bytes for each in of):,}",
            f"{sum(rates) / len(rates):.3g}" if rates else "",
            _after(min(each.first_ns for each in of), start_ns),
            _after(max(each.last_ns for each in of), start_ns),
        )
    return table


def _after(stamp_ns: int, start_ns: int) -> str:
    return "before" if stamp_ns < start_ns else f"{(stamp_ns - start_ns) * 1e-9:.1f}"
