"""Runs tasks in processes of their own: one that fails or dies loses its own task only.

Processes are spawned, never forked: a fork would take over the threads of Zenoh and of the compiled
kernels in whatever state they are.
"""

import os
import signal
import threading
import time
import traceback
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any

from sim.studies.experiments.task import Task

_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
_GRACE_S = 5.0


@dataclass(frozen=True)
class Done:
    """A finished task: its result, or else the error in a line and the traceback.

    seconds: of the processor, whatever else it computes meanwhile; 0 where the process died.
    """

    task: Task
    result: dict[str, Any] | None
    seconds: float
    error: str = ""
    details: str = ""


@dataclass
class _Worker:
    process: BaseProcess
    pipe: Connection
    task: Task | None = None

    def give(self, task: Task) -> None:
        self.task = task
        self.pipe.send(task)

    def end(self) -> None:
        self.pipe.close()
        self.process.kill()
        self.process.join(_GRACE_S)


def run(tasks: Sequence[Task], jobs: int) -> Iterator[Done]:
    """Run the tasks in at most `jobs` processes at a time; each as it is done, in no fixed order.

    Long tasks begin first. Leaving the iterator early ends the processes.
    """
    waiting = sorted(tasks, key=lambda task: task.cost)
    workers: list[_Worker] = []
    try:
        while waiting or workers:
            while waiting and len(workers) < jobs:
                workers.append(_started())
                workers[-1].give(waiting.pop())
            ready = wait([worker.pipe for worker in workers])
            for worker in [w for w in workers if w.pipe in ready]:
                done, alive = _received(worker)
                if alive and waiting:
                    worker.give(waiting.pop())
                else:
                    workers.remove(worker)
                    worker.end()
                yield done
    finally:
        for worker in workers:
            worker.end()


def _started() -> _Worker:
    for variable in _ONE_THREAD:
        os.environ.setdefault(variable, "1")
    context = get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_work, args=(theirs,), daemon=True)
    process.start()
    theirs.close()
    return _Worker(process, ours)


def _received(worker: _Worker) -> tuple[Done, bool]:
    """What became of the worker's task, and whether the worker can take another one."""
    task = worker.task
    assert task is not None
    try:
        result, error, details, seconds = worker.pipe.recv()
    except EOFError:
        worker.process.join(_GRACE_S)
        how = f"its process ended with exit status {worker.process.exitcode}"
        return Done(task, None, 0.0, how), False
    return Done(task, result, seconds, error, details), True


def _work(pipe: Connection) -> None:
    """A worker's life: tasks come, results go, until the pipe is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's: it ends the workers
    threading.Thread(target=_end_without, args=(os.getppid(),), daemon=True).start()
    while True:
        try:
            task: Task = pipe.recv()
        except EOFError:
            return
        begin = time.process_time()
        try:
            answer: tuple[dict[str, Any] | None, str, str] = (task.run(), "", "")
        except Exception as error:  # whatever a run raises is that run's result
            text = " ".join(str(error).split())
            answer = (None, f"{type(error).__name__}: {text}", traceback.format_exc())
        pipe.send((*answer, time.process_time() - begin))


def _end_without(parent: int) -> None:
    """End this process when its parent was killed and could not do it."""
    while os.getppid() == parent:
        time.sleep(0.5)
    os._exit(1)
