"""The commands `teamslam experiment NAME`: one per entry of the catalogue, and `all`."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from sim.cli.help import Command, Group
from sim.cli.options import FAILED, WRONG_USE, fail
from sim.studies.experiments.catalogue import ENTRIES, Entry
from team.extras import install_command

app = typer.Typer(
    name="experiment",
    cls=Group,
    epilog="teamslam experiment accuracy --quick",
    help="Reproduce the sources' tables and figures, and measure the team's accuracy.",
    no_args_is_help=True,
)

FOLDER = Path("runs") / "experiments"
FILE_WIDTH = 120
MOST_SEEDS = 100_000
ALL = "all"
Seeds = Annotated[
    int | None,
    typer.Option(help="How many seeds; default: the experiment's own.", min=1, max=MOST_SEEDS),
]
First = Annotated[int, typer.Option(help="The first seed.", min=0)]
JsonFile = Annotated[Path | None, typer.Option("--json", help="Write the figures as JSON, too.")]
Output = Annotated[
    Path,
    typer.Option(
        "--output", "-o", help="Folder of results and pictures; stored results are reused."
    ),
]
Jobs = Annotated[int | None, typer.Option(help="Processes; default: one per core.", min=1)]
Scheduler = Annotated[
    str | None,
    typer.Option(help="Compute the runs on a Dask scheduler's workers.", metavar="tcp://HOST:PORT"),
]
Datasets = Annotated[
    list[Path] | None,
    typer.Option("--dataset", help="A UTIAS data set, folder or zip; repeatable."),
]
Quick = Annotated[bool, typer.Option("--quick", help="Few seeds, and no run beyond a minute.")]
Check = Annotated[bool, typer.Option("--check", help="Exit status 1 if a goal is missed.")]


def _command(name: str, summary: str, entries: Sequence[Entry]) -> None:
    def run(
        seeds: Seeds = None,
        first: First = 1,
        json_file: JsonFile = None,
        output: Output = FOLDER,
        jobs: Jobs = None,
        scheduler: Scheduler = None,
        dataset: Datasets = None,
        quick: Quick = False,
        check: Check = False,
    ) -> None:
        def chosen(entry: Entry) -> tuple[int, ...]:
            own = min(entry.seeds, entry.seeds_in_all) if name == ALL else entry.seeds
            count = seeds or (entry.quick_seeds if quick else own)
            return tuple(range(first, first + count))

        asked = Asked(
            json_file=json_file,
            output=output,
            jobs=jobs,
            scheduler=scheduler,
            paths=dataset or [],
            quick=quick,
            check=check,
        )
        _run(name, entries, chosen, asked)

    app.command(name, cls=Command, help=summary, epilog=f"teamslam experiment {name} --quick")(run)


@dataclass(frozen=True, kw_only=True)
class Asked:
    """Options of a command, except its seeds."""

    json_file: Path | None
    output: Path
    jobs: int | None
    scheduler: str | None
    paths: Sequence[Path]
    quick: bool
    check: bool


def _run(
    name: str,
    entries: Sequence[Entry],
    seeds: Callable[[Entry], tuple[int, ...]],
    asked: Asked,
) -> None:
    import json

    from rich.console import Console

    try:
        import joblib  # noqa: F401 - reported before the work, not after it
    except ModuleNotFoundError:
        fail(f"experiments need joblib: {install_command('studies')}", WRONG_USE)

    from sim.studies.experiments.cases import SchedulerError
    from sim.studies.experiments.experiment import Options, without_datasets
    from sim.studies.experiments.output import printed, to_json, write
    from sim.studies.experiments.progress import shown
    from sim.studies.experiments.runner import FAILURES, computed, cores, dataset, planned
    from team.recording.provenance import provenance

    if asked.json_file is not None and not asked.json_file.absolute().parent.is_dir():
        fail(f"--json {asked.json_file}: no such folder; make it first", WRONG_USE)
    datasets = tuple(dataset(path) for path in asked.paths)
    plans = [planned(entry, Options(seeds(entry), asked.quick, datasets)) for entry in entries]
    if not any(plan.tasks for plan in plans):
        fail(without_datasets(name), WRONG_USE)
    try:
        concluded = computed(plans, asked.output, asked.jobs or cores(), shown, asked.scheduler)
    except SchedulerError as error:
        fail(str(error), WRONG_USE)
    except KeyboardInterrupt:
        fail(
            f"interrupted; results so far are in {asked.output}: repeat the command to continue",
            FAILED,
        )
    origin = provenance()
    console = Console()
    if not console.is_terminal:
        console.width = FILE_WIDTH
    for each in concluded:
        console.print(*printed(each), sep="\n")
    page = write(concluded, asked.output, "index" if name == ALL else name, origin)
    if asked.json_file is not None:
        contents = {each.entry.name: to_json(each, origin) for each in concluded}
        content = contents if name == ALL else contents[name]
        asked.json_file.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n", "utf-8")
    typer.echo(f"{page}: results with pictures; JSON and PNG files beside it")
    failed = sum(len(each.failed) for each in concluded)
    if failed:
        fail(f"{failed} runs failed; {asked.output / FAILURES} has their tracebacks", FAILED)
    missed = sum(goal.passed is False for each in concluded for goal in each.outcome.goals)
    if asked.check and missed:
        fail(f"{missed} goals were missed", FAILED)


for _entry in ENTRIES:
    _command(_entry.name, _entry.summary, [_entry])
_command(ALL, "All experiments, on one page.", ENTRIES)
