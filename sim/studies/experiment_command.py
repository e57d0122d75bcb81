"""Commands `teamslam experiment NAME`: one per catalogue entry, `all`, and `merge`."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from teamslam.sim.cli.help import Command, Group
from teamslam.sim.cli.options import FAILED, WRONG_USE, fail, failing
from teamslam.sim.studies.experiments.catalogue import ENTRIES, Entry
from teamslam.team.extras import install_command

if TYPE_CHECKING:
    from teamslam.sim.studies.experiments.runner import Plan

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
Datasets = Annotated[
    list[Path] | None,
    typer.Option("--dataset", help="A UTIAS data set, folder or zip; repeatable."),
]
ShardText = Annotated[
    str | None,
    typer.Option(
        help="Compute the I-th of N parts of the runs only; `experiment merge` joins them.",
        metavar="I/N",
    ),
]
Quick = Annotated[bool, typer.Option("--quick", help="Few seeds, and no run beyond a minute.")]
Check = Annotated[bool, typer.Option("--check", help="Exit status 1 if a goal is missed.")]


def _command(name: str, summary: str) -> None:
    def run(
        seeds: Seeds = None,
        first: First = 1,
        quick: Quick = False,
        dataset: Datasets = None,
        output: Output = FOLDER,
        jobs: Jobs = None,
        shard: ShardText = None,
        check: Check = False,
        json_file: JsonFile = None,
    ) -> None:
        asked = Asked(
            name=name,
            seeds=seeds,
            first=first,
            quick=quick,
            paths=dataset or [],
            output=output,
            jobs=jobs,
            check=check,
            json_file=json_file,
        )
        if shard is None:
            _run(asked)
        else:
            _run_shard(asked, shard)

    app.command(name, cls=Command, help=summary, epilog=f"teamslam experiment {name} --quick")(run)


@app.command(
    "merge",
    cls=Command,
    epilog="teamslam experiment merge shard-1 shard-2 shard-3 -o runs/accuracy",
)
def merge(
    shards: Annotated[list[Path], typer.Argument(help="Folders of all shards of one experiment.")],
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder of results and pictures.", metavar="DIR")
    ],
    dataset: Datasets = None,
    jobs: Jobs = None,
    check: Check = False,
    json_file: JsonFile = None,
) -> None:
    """Merge the shards of an experiment: its page and figures, as if one computer had made them.

    Runs that failed in a shard are computed again.
    """
    _require_joblib()
    from teamslam.sim.studies.experiments.cases import (
        ShardError,
        collect_results,
        programs_of,
        study_of,
    )
    from teamslam.sim.studies.experiments.runner import tasks_by_name

    with failing(WRONG_USE, ShardError):
        study, program = study_of(shards)
    asked = Asked(
        name=study.name,
        seeds=study.seeds,
        first=study.first,
        quick=study.quick,
        paths=dataset or [Path(path) for path in study.datasets],
        output=output,
        jobs=jobs,
        check=check,
        json_file=json_file,
    )
    tasks = tasks_by_name(asked.plans())
    if programs_of(list(tasks.values())) != program:
        fail("the shards were computed by another version of the program or libraries", WRONG_USE)
    collect_results(shards, output)
    _run(asked)


@dataclass(frozen=True, kw_only=True)
class Asked:
    """Name of an experiment and options of its command."""

    name: str
    seeds: int | None
    first: int
    quick: bool
    paths: Sequence[Path]
    output: Path
    jobs: int | None
    check: bool
    json_file: Path | None

    def plans(self) -> "list[Plan]":
        """Plans of the experiment, or of all."""
        from teamslam.sim.studies.experiments.experiment import Options
        from teamslam.sim.studies.experiments.runner import dataset, plan_runs

        datasets = tuple(dataset(path) for path in self.paths)
        entries = [entry for entry in ENTRIES if self.name in (entry.name, ALL)]
        return [
            plan_runs(entry, Options(self._seeds_of(entry), self.quick, datasets))
            for entry in entries
        ]

    def _seeds_of(self, entry: Entry) -> tuple[int, ...]:
        own = min(entry.seeds, entry.seeds_in_all) if self.name == ALL else entry.seeds
        count = self.seeds or (entry.quick_seeds if self.quick else own)
        return tuple(range(self.first, self.first + count))


def _require_joblib() -> None:
    try:
        import joblib  # noqa: F401 - reported before the work, not after it
    except ModuleNotFoundError:
        fail(f"experiments need joblib: {install_command('studies')}", WRONG_USE)


@contextmanager
def _stoppable(output: Path) -> Iterator[None]:
    try:
        yield
    except KeyboardInterrupt:
        fail(f"interrupted; results so far are in {output}: repeat the command to continue", FAILED)


def _run_shard(asked: Asked, text: str) -> None:
    _require_joblib()

    from teamslam.sim.studies.experiments.cases import (
        ShardError,
        Study,
        parsed_shard,
        programs_of,
        tasks_of,
        write_shard,
    )
    from teamslam.sim.studies.experiments.experiment import without_datasets
    from teamslam.sim.studies.experiments.output import show_progress
    from teamslam.sim.studies.experiments.runner import FAILURES, compute_runs, cores, tasks_by_name

    with failing(WRONG_USE, ShardError):
        shard = parsed_shard(text)
    tasks = tasks_by_name(asked.plans())
    if not tasks:
        fail(without_datasets(asked.name), WRONG_USE)
    part = tasks_of(tasks, shard)
    with _stoppable(asked.output):
        _, failed = compute_runs(part, asked.output, asked.jobs or cores(), show_progress)
    study = Study(
        name=asked.name,
        seeds=asked.seeds,
        first=asked.first,
        quick=asked.quick,
        datasets=[str(path.resolve()) for path in asked.paths],
    )
    write_shard(asked.output, shard, study, programs_of(list(tasks.values())))
    typer.echo(
        f"{asked.output}: {len(part) - len(failed)} of {len(tasks)} runs; with the other shards: "
        "teamslam experiment merge FOLDER… -o DIR"
    )
    if failed:
        fail(f"{len(failed)} runs failed; {asked.output / FAILURES} has their tracebacks", FAILED)


def _run(asked: Asked) -> None:
    import json

    from rich.console import Console

    _require_joblib()

    from teamslam.sim.studies.experiments.experiment import without_datasets
    from teamslam.sim.studies.experiments.output import (
        render_outcome,
        show_progress,
        to_json,
        write,
    )
    from teamslam.sim.studies.experiments.runner import FAILURES, compute_outcomes, cores
    from teamslam.team.recording.provenance import provenance

    name = asked.name
    if asked.json_file is not None and not asked.json_file.absolute().parent.is_dir():
        fail(f"--json {asked.json_file}: no such folder; make it first", WRONG_USE)
    plans = asked.plans()
    if not any(plan.tasks for plan in plans):
        fail(without_datasets(name), WRONG_USE)
    with _stoppable(asked.output):
        concluded = compute_outcomes(plans, asked.output, asked.jobs or cores(), show_progress)
    origin = provenance()
    console = Console()
    if not console.is_terminal:
        console.width = FILE_WIDTH
    for each in concluded:
        console.print(*render_outcome(each), sep="\n")
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
    _command(_entry.name, _entry.summary)
_command(ALL, "All experiments, on one page.")
