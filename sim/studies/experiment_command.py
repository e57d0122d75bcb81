"""Commands `teamslam experiment NAME`: one per catalogue entry, `all`, and `merge`."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import click

from teamslam.sim.cli.commands import Group, argument, fail, option, refuse, refusing
from teamslam.sim.studies.experiments.catalogue import ENTRIES, Entry, Study
from teamslam.team.extras import install_command

if TYPE_CHECKING:
    from teamslam.sim.studies.experiments.runner import Plan

app = Group(
    "experiment",
    epilog="teamslam experiment accuracy --quick",
    help="Reproduce the sources' tables and figures, and measure the team's accuracy.",
)

FOLDER = Path("runs") / "experiments"
FILE_WIDTH = 120
MOST_SEEDS = 100_000
ALL = "all"
Seeds = Annotated[
    int | None, option("How many seeds; default: the experiment's own.", least=1, most=MOST_SEEDS)
]
First = Annotated[int, option("The first seed.", least=0)]
JsonFile = Annotated[Path | None, option("Write the figures as JSON, too.", "--json")]
Output = Annotated[
    Path, option("Folder of results and pictures; stored results are reused.", "--output", "-o")
]
Jobs = Annotated[int | None, option("Processes; default: one per core.", least=1)]
Datasets = Annotated[
    list[Path] | None, option("A UTIAS data set, folder or zip; repeatable.", "--dataset")
]
ShardText = Annotated[
    str | None,
    option("Compute the I-th of N parts of the runs only; `experiment merge` joins them.", "I/N"),
]
Quick = Annotated[bool, option("Few seeds, and no run beyond a minute.", "--quick")]
Check = Annotated[bool, option("Exit status 1 if a goal is missed.", "--check")]


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
        study = Study(name, seeds, first, quick, [str(path) for path in dataset or ()])
        if shard is None:
            _run(study, output, jobs, json_file, check=check)
        else:
            _run_shard(study, shard, output, jobs)

    app.declare(f"teamslam experiment {name} --quick", name, summary)(run)


@app.declare("teamslam experiment merge shard-1 shard-2 shard-3 -o runs/accuracy", name="merge")
def merge(
    shards: Annotated[list[Path], argument("Folders of all shards of one experiment.")],
    output: Annotated[Path, option("Folder of results and pictures.", "--output", "-o", "DIR")],
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

    with refusing(ShardError):
        study, program = study_of(shards)
    if dataset:
        study = replace(study, datasets=[str(path) for path in dataset])
    tasks = tasks_by_name(_plans(study))
    if programs_of(list(tasks.values())) != program:
        refuse("the shards were computed by another version of the program or libraries")
    collect_results(shards, output)
    _run(study, output, jobs, json_file, check=check)


def _plans(study: Study) -> "list[Plan]":
    from teamslam.sim.studies.experiments.experiment import Options
    from teamslam.sim.studies.experiments.runner import dataset, plan_runs

    datasets = tuple(dataset(Path(path)) for path in study.datasets)
    entries = [entry for entry in ENTRIES if study.experiment in (entry.name, ALL)]
    return [
        plan_runs(entry, Options(_seeds_of(entry, study), study.quick, datasets))
        for entry in entries
    ]


def _seeds_of(entry: Entry, study: Study) -> tuple[int, ...]:
    in_all = study.experiment == ALL
    own = min(entry.seeds, entry.seeds_in_all) if in_all else entry.seeds
    count = study.seeds or (entry.quick_seeds if study.quick else own)
    return tuple(range(study.first, study.first + count))


def _require_joblib() -> None:
    try:
        import joblib  # noqa: F401 - reported before the work, not after it
    except ModuleNotFoundError:
        refuse(f"experiments need joblib: {install_command('studies')}")


@contextmanager
def _stoppable(output: Path) -> Iterator[None]:
    try:
        yield
    except KeyboardInterrupt:
        fail(f"interrupted; results so far are in {output}: repeat the command to continue")


def _run_shard(study: Study, text: str, output: Path, jobs: int | None) -> None:
    _require_joblib()

    from teamslam.sim.studies.experiments.cases import (
        ShardError,
        parsed_shard,
        programs_of,
        tasks_of,
        write_shard,
    )
    from teamslam.sim.studies.experiments.experiment import without_datasets
    from teamslam.sim.studies.experiments.output import show_progress
    from teamslam.sim.studies.experiments.runner import FAILURES, compute_runs, cores, tasks_by_name

    with refusing(ShardError):
        shard = parsed_shard(text)
    tasks = tasks_by_name(_plans(study))
    if not tasks:
        refuse(without_datasets(study.experiment))
    part = tasks_of(tasks, shard)
    with _stoppable(output):
        _, failed = compute_runs(part, output, jobs or cores(), show_progress)
    found = replace(study, datasets=[str(Path(path).resolve()) for path in study.datasets])
    write_shard(output, shard, found, programs_of(list(tasks.values())))
    click.echo(
        f"{output}: {len(part) - len(failed)} of {len(tasks)} runs; with the other shards: "
        "teamslam experiment merge FOLDER… -o DIR"
    )
    if failed:
        fail(f"{len(failed)} runs failed; {output / FAILURES} has their tracebacks")


def _run(
    study: Study, output: Path, jobs: int | None, json_file: Path | None, *, check: bool
) -> None:
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

    name = study.experiment
    if json_file is not None and not json_file.absolute().parent.is_dir():
        refuse(f"--json {json_file}: no such folder; make it first")
    plans = _plans(study)
    if not any(plan.tasks for plan in plans):
        refuse(without_datasets(name))
    with _stoppable(output):
        concluded = compute_outcomes(plans, output, jobs or cores(), show_progress)
    origin = provenance()
    console = Console()
    if not console.is_terminal:
        console.width = FILE_WIDTH
    for each in concluded:
        console.print(*render_outcome(each), sep="\n")
    page = write(concluded, output, "index" if name == ALL else name, origin)
    if json_file is not None:
        contents = {each.entry.name: to_json(each, origin) for each in concluded}
        content = contents if name == ALL else contents[name]
        json_file.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n", "utf-8")
    click.echo(f"{page}: results with pictures; JSON and PNG files beside it")
    failed = sum(len(each.failed) for each in concluded)
    if failed:
        fail(f"{failed} runs failed; {output / FAILURES} has their tracebacks")
    missed = sum(goal.passed is False for each in concluded for goal in each.outcome.goals)
    if check and missed:
        fail(f"{missed} goals were missed")


for _entry in ENTRIES:
    _command(_entry.name, _entry.summary)
_command(ALL, "All experiments, on one page.")
