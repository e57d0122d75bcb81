"""Progress of the runs: a bar, or lines outside a terminal."""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from teamslam.sim.studies.experiments.cases import Done
from teamslam.sim.studies.experiments.task import Task

LINE_S = 10.0


@contextmanager
def show_progress(tasks: Sequence[Task], found: int) -> Iterator[Callable[[Done], None]]:
    """Yield a function to call with every finished task."""
    console = Console(stderr=True)
    of = f"{len(tasks)} runs" + (f", {found} more are stored" if found else "")
    # The bar advances by expected cost, which differs widely between runs.
    cost = sum(task.cost for task in tasks)
    bar = Progress(
        BarColumn(bar_width=30),
        TextColumn("{task.fields[runs]}"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        console=console,
        transient=True,
        disable=not (tasks and console.is_terminal),
    )
    finished, due = 0, time.monotonic()

    def hear(done: Done) -> None:
        nonlocal finished, due
        finished += 1
        bar.update(whole, advance=done.task.cost, runs=f"{finished} of {of}")
        if done.error:
            text = f"failed: {done.task.label}: {done.error}"
            console.print(text, markup=False, highlight=False, soft_wrap=True)
        if bar.disable and (time.monotonic() >= due or finished == len(tasks)):
            due = time.monotonic() + LINE_S
            console.print(f"{finished} of {of}", highlight=False, soft_wrap=True)

    if not tasks:
        console.print(of, highlight=False)
    with bar:
        whole = bar.add_task("", total=cost, runs=of)
        yield hear
