"""Compute cases in parallel and store their results by joblib."""

import json
import re
import shutil
import threading
import traceback
import warnings
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from joblib import Memory, Parallel, delayed, parallel_config
from joblib.externals.loky.process_executor import TerminatedWorkerError

from teamslam.sim.studies.experiments.catalogue import Study
from teamslam.sim.studies.experiments.experiment import Task

FOLDER = "cases"
IDLE_S = 5  # timeout [s] of an idle worker
Cached = Callable[..., dict[str, Any]]


@dataclass(frozen=True)
class Done:
    """A finished case: result, or error with traceback."""

    task: Task
    result: dict[str, Any] | None
    error: str = ""
    details: str = ""


class Cases:
    """Stored results, by parameters and program."""

    def __init__(self, folder: Path) -> None:
        self._cached = Memory(folder / FOLDER, verbose=0).cache(_result, ignore=["local"])

    def found(self, task: Task) -> dict[str, Any] | None:
        """Stored result of a case, or None."""
        arguments = _arguments(task)
        if not self._cached.check_call_in_cache(**arguments):
            return None
        result: dict[str, Any] = self._cached(**arguments)
        return result

    def run(self, tasks: Sequence[Task], jobs: int) -> Iterator[Done]:
        """Compute the cases, the longest first; yield each when done.

        Leaving the iterator ends the workers.
        """
        # An idle worker may end just as it gets a case; joblib warns and starts another. As an
        # error
        # the warning would end joblib's thread.
        warnings.filterwarnings("ignore", "A worker stopped while some jobs", UserWarning)
        waiting = {task.name: task for task in sorted(tasks, key=lambda task: -task.cost)}
        with parallel_config("loky", inner_max_num_threads=1, idle_worker_timeout=IDLE_S):
            finished = self._parallel(list(waiting.values()), jobs)
            try:
                for done in finished:
                    del waiting[done.task.name]
                    yield done
            except TerminatedWorkerError:  # each remaining case runs by itself then
                for task in waiting.values():
                    yield self._alone(task)
            finally:
                with _cancelling():
                    finished.close()

    def _parallel(self, tasks: Sequence[Task], jobs: int) -> Generator[Done, None, None]:
        # With one job joblib would run a loop in this process, which a dying case would end.
        parallel = Parallel(
            max(jobs, 2), return_as="generator_unordered", pre_dispatch=jobs, batch_size=1
        )
        done: Generator[Done, None, None] = parallel(
            delayed(_attempt)(self._cached, task) for task in tasks
        )
        return done

    def _alone(self, task: Task) -> Done:
        try:
            (done,) = self._parallel([task], 1)
        except TerminatedWorkerError as error:
            return Done(task, None, f"its process died: {' '.join(str(error).split())}")
        return done


@contextmanager
def _cancelling() -> Iterator[None]:
    """Suppress the pool's message about a cancelled case (joblib/loky, pull request 663)."""
    previous = threading.excepthook

    def hook(error: threading.ExceptHookArgs) -> None:
        ours = type(error.thread).__module__ == TerminatedWorkerError.__module__
        if not (ours and error.exc_type is KeyError):
            previous(error)

    threading.excepthook = hook
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        threading.excepthook = previous


def _attempt(cached: Cached, task: Task) -> Done:
    try:
        return Done(task, cached(**_arguments(task)))
    except Exception as error:  # an error is the case's result
        text = " ".join(str(error).split())
        return Done(task, None, f"{type(error).__name__}: {text}", traceback.format_exc())


def _arguments(task: Task) -> dict[str, Any]:
    return {
        "work": task.work,
        "parameters": dict(task.parameters),
        "program": task.program,
        "local": dict(task.local),
    }


def _result(
    work: str, parameters: dict[str, Any], program: str, local: dict[str, str]
) -> dict[str, Any]:
    return Task(work, parameters, "", local=local).run()


DESCRIPTION = "shard.json"  # file in a shard's folder: study, number, and digests of its program


class ShardError(ValueError):
    """Shards that are not one study."""


@dataclass(frozen=True)
class _Shard:
    number: int
    of: int


def parsed_shard(text: str) -> _Shard:
    """Parse `I/N`; raises ShardError."""
    found = re.fullmatch(r"(\d+)/(\d+)", text)
    if found is None or not 1 <= int(found[1]) <= int(found[2]):
        raise ShardError(f"--shard {text}: give the shard and their number, as 2/8")
    return _Shard(int(found[1]), int(found[2]))


def tasks_of(tasks: Mapping[str, Task], shard: _Shard) -> dict[str, Task]:
    """Every N-th task by falling cost, for shards of equal time."""
    order = sorted(tasks.values(), key=lambda task: (-task.cost, task.name))
    return {task.name: task for task in order[shard.number - 1 :: shard.of]}


def programs_of(tasks: Sequence[Task]) -> dict[str, str]:
    """Digest of the program of each kind of task."""
    return {task.work: task.program for task in {task.work: task for task in tasks}.values()}


def write_shard(folder: Path, shard: _Shard, study: Study, programs: Mapping[str, str]) -> None:
    """Describe the shard in its folder."""
    content = asdict(study) | {
        "program": dict(sorted(programs.items())),
        "of": shard.of,
        "shard": shard.number,
    }
    (folder / DESCRIPTION).write_text(json.dumps(content, indent=1) + "\n", "utf-8")


def study_of(folders: Sequence[Path]) -> tuple[Study, dict[str, str]]:
    """Study of these shards; raises ShardError unless complete."""
    described = {folder: _description(folder) for folder in folders}
    numbers = {folder: int(each.pop("shard")) for folder, each in described.items()}
    first, common = next(iter(described.items()))
    for folder, each in described.items():
        differing = [name for name, value in each.items() if value != common.get(name)]
        if differing:
            raise ShardError(
                f"{folder} and {first} are not of one study: they differ in {', '.join(differing)}"
            )
    program, of = common.pop("program"), common.pop("of")
    lacking = [str(k) for k in range(1, of + 1) if k not in numbers.values()]
    if lacking:
        raise ShardError(f"shard {', '.join(lacking)} of {of} is not among the folders")
    return Study(**common), program


def collect_results(folders: Sequence[Path], output: Path) -> None:
    """Copy the shards' stored results into one folder."""
    for folder in folders:
        if (folder / FOLDER).is_dir():
            shutil.copytree(folder / FOLDER, output / FOLDER, dirs_exist_ok=True)


def _description(folder: Path) -> dict[str, Any]:
    file = folder / DESCRIPTION
    try:
        content: dict[str, Any] = json.loads(file.read_text("utf-8"))
    except (OSError, ValueError):
        raise ShardError(
            f"{folder} is no finished shard: `teamslam experiment NAME --shard I/N -o {folder}` "
            f"writes {DESCRIPTION} at its end"
        ) from None
    return content
