"""Warm template: a single-threaded process with a team's imports and kernels loaded.

Forking from it takes milliseconds instead of two seconds and shares memory. A forked process has
the launch as parent, its own session and output file, no input, and continues as if started by its
command line: docs/decisions/12-processes-forked-from-a-template.md.
"""

import gc
import importlib
import json
import logging
import os
import select
import signal
import socket
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import NoReturn

from sim.launch.ahead import TEMPLATE
from sim.launch.linux import end_with_parent, threads, write_command_line
from sim.launch.processes import KERNELS
from team.shell import PARENT
from team.the_end import SINCE

LARGEST_REQUEST = 65_536
MODULES = (
    "team.keys.roster",
    "team.wire.zenoh.bus",
    "numpy",
    "numba",
    "team.translate",
    "central.main",
    "team.robot.node",
    "sim.in_memory.team",
    "sim.publisher.main",
    "team.keys.credentials",
    "team.recording.own_log",
    "team.recording.provenance",
    "team.recording.shell",
    "team.robot.main",
)
"""Modules of a team's processes in loading order, the router's first.

Between two of them the template checks for the router's request; other processes wait for all.
"""


@dataclass(frozen=True)
class _Request:
    """Command line to start, and its output file."""

    words: list[str]
    output: int


def become_a_process(prepare: Callable[[], object]) -> None:
    """Become the template that sys.argv describes; returns in each forked process, with its
    sys.argv.

    The template ends with its launch. prepare: common initialisation.
    """
    end_with_parent(signal.SIGKILL)
    gc.disable()  # imported modules stay
    launch = os.getppid()
    write_command_line(sys.orig_argv[: sys.orig_argv.index(TEMPLATE) + 1])
    asked = socket.socket(fileno=int(sys.argv[2]))
    prepare()
    pair: list[str] = []
    has_router = False
    for module in MODULES:
        importlib.import_module(module)
        if not pair and _is_asked(asked, 0.0):
            pair = _noted(_received(asked), launch)
        if pair and not has_router and _is_asked(asked, 0.0):
            has_router = True
            if _serve(_received(asked), asked, launch):
                return
    pair = pair or _noted(_received(asked), launch)
    _load_kernels(pair[0], pair[1], asked)
    # Exclude present objects from collection in forked processes.
    gc.freeze()
    while True:
        if _serve(_received(asked), asked, launch):
            return


def _noted(request: _Request, launch: int) -> list[str]:
    """Estimator and rule of the first request, which also names the template's file."""
    kind, estimator, rule, since_ns = request.words
    assert kind == KERNELS
    os.environ |= {PARENT: str(launch), SINCE: since_ns}
    for stream in (1, 2):
        os.dup2(request.output, stream)
    os.close(request.output)
    return [estimator, rule]


def _load_kernels(estimator: str, rule: str, asked: socket.socket) -> None:
    """Load all kernels; uncompiled ones are compiled by three processes with progress reports."""
    from sim.launch import warm_up
    from team.estimation.compiling import compilations

    is_warm = warm_up.is_warm(estimator, rule)
    if not is_warm:
        gc.enable()  # compiling creates much garbage
    with compilations(lambda done, of: asked.sendall(f"compiled {of}".encode()), warm_up.FORMS):
        if (estimator, rule) == ("hybrid", "join") and not is_warm:
            # Each compiles kernels that the others need late.
            others = [
                _forked(warm_up.fold_made_up_submaps),
                _forked(warm_up.follow_made_up_submaps),
            ]
            warm_up.run_to_the_first_submap(estimator, rule)
            for other in others:
                os.waitpid(other, 0)
        warm_up.run_small_team(estimator, rule)
    warm_up.note_warm(estimator, rule)


def _forked(run: Callable[[], object]) -> int:
    """Process id of a child that runs this and ends; failures are left to others."""
    template = os.getpid()
    if child := os.fork():
        return child
    end_with_parent(signal.SIGKILL)  # as an interrupted launch ends the template
    with suppress(Exception):
        if os.getppid() == template:
            run()
    os._exit(0)


def end_by(run: Callable[[], None]) -> NoReturn:
    """Call `run` and end this forked process like Python, but without freeing its modules.

    Freeing would copy every shared page: 0.2 s and 100 MB each.
    """
    status: object = None
    try:
        run()
    except SystemExit as ended:
        status = ended.code
    except BaseException:
        sys.excepthook(*sys.exc_info())
        status = 1
    logging.shutdown()
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    os._exit(status if isinstance(status, int) else int(status is not None))


def _is_asked(asked: socket.socket, patience_s: float) -> bool:
    return bool(select.select([asked], [], [], patience_s)[0])


def _serve(request: _Request, asked: socket.socket, launch: int) -> bool:
    """Fork the requested process; returns True in it."""
    if threads() != 1:
        sys.exit(f"the template has {threads()} threads: a fork would not be safe")
    read, write = os.pipe()
    between = os.fork()
    if between == 0:
        _fork_again(write, launch)
        asked.close()
        os.close(read)
        _begin(request)
        return True
    os.close(write)
    os.close(request.output)
    os.waitpid(between, 0)  # now the launch becomes the parent
    with open(read, "rb") as pipe:
        asked.sendall(pipe.read())
    return False


def _received(asked: socket.socket) -> _Request:
    payload, files, _, _ = socket.recv_fds(asked, LARGEST_REQUEST, 1)
    if not payload:
        os._exit(0)  # the launch has ended
    return _Request(json.loads(payload), files[0])


def _fork_again(write: int, launch: int) -> None:
    """Return in a grandchild, whose parent becomes the launch."""
    between = os.getpid()
    child = os.fork()
    if child:
        os.write(write, f"started {child}".encode())
        os._exit(0)
    os.close(write)
    while os.getppid() == between:
        time.sleep(0.001)
    if os.getppid() != launch:  # ended meanwhile
        os._exit(1)


def _begin(request: _Request) -> None:
    """Become the requested process: session, streams, command line."""
    gc.enable()
    os.setsid()
    nothing = os.open(os.devnull, os.O_RDONLY)
    for source, target in ((nothing, 0), (request.output, 1), (request.output, 2)):
        os.dup2(source, target)
    os.close(nothing)
    os.close(request.output)
    sys.argv[1:] = request.words
    write_command_line([*sys.orig_argv[: sys.orig_argv.index(TEMPLATE)], *request.words])
