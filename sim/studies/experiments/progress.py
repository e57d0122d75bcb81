"""What a user sees while the runs go on: a bar with the time left, or plain lines elsewhere."""

import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from sim.studies.experiments.task import Task
from sim.studies.experiments.workers import Done

LINE_S = 10.0
"""Wall time between two plain lines."""


@contextmanager
def shown(tasks: Sequence[Task], kept: int) -> Iterator[Callable[[Done], None]]:
    """A function that hears of every finished task; failures are told at once."""
    console = Console(stderr=True)
    of = f"{len(tasks)} runs" + (f", {kept} more are kept from before" if kept else "")
    if not tasks:
        console.print(of, highlight=False)
        yield lambda _: None
    elif console.is_terminal and sys.stderr.isatty():
        with _bar(console) as bar:
            # Runs cost very different times: the bar goes by what they are expected to cost.
            whole = bar.add_task("", total=sum(task.cost for task in tasks), runs=of)
            finished = 0

            def hear(done: Done) -> None:
                nonlocal finished
                finished += 1
                if done.error:
                    bar.console.print(_failure(done), markup=False, highlight=False)
                bar.update(whole, advance=done.task.cost, runs=f"{finished} of {of}")

            yield hear
    else:
        yield _Lines(console, tasks, of).hear


def _bar(console: Console) -> Progress:
    return Progress(
        BarColumn(bar_width=30),
        TextColumn("{task.fields[runs]}"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        console=console,
        transient=True,
    )


class _Lines:
    def __init__(self, console: Console, tasks: Sequence[Task], of: str) -> None:
        self._console = console
        self._of = of
        self._cost = sum(task.cost for task in tasks)
        self._count = len(tasks)
        self._began = time.monotonic()
        self._due = self._began
        self._finished = 0
        self._spent = 0.0

    def hear(self, done: Done) -> None:
        self._finished += 1
        self._spent += done.task.cost
        if done.error:
            self._print(_failure(done))
        now = time.monotonic()
        if now >= self._due or self._finished == self._count:
            self._due = now + LINE_S
            left_s = (now - self._began) * (self._cost / self._spent - 1.0)
            self._print(
                f"[{now - self._began:6.0f} s] {self._finished} of {self._of}, "
                f"about {left_s:.0f} s left"
            )

    def _print(self, text: str) -> None:
        self._console.print(text, markup=False, highlight=False, soft_wrap=True)


def _failure(done: Done) -> str:
    return f"failed: {done.task.label}: {done.error}"
