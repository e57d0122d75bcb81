"""Real processes under test: started, watched, ended by their ids, and none left."""

import asyncio
import codecs
import contextlib
import os
import signal
import sys
import termios
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Self

import pytest

PROGRAM = (sys.executable, "-P", "-m", "teamslam")
_PROC = Path("/proc")


async def until(condition: Callable[[], object], what: str, timeout_s: float = 180.0) -> None:
    end = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < end, f"not within {timeout_s:g} s: {what}"
        await asyncio.sleep(0.005)


class Process:
    def __init__(self, name: str, process: asyncio.subprocess.Process, output: Path) -> None:
        self.name = name
        self.output = output
        self._process = process

    @property
    def pid(self) -> int:
        return self._process.pid

    @property
    def exit(self) -> int | None:
        return self._process.returncode

    def said(self) -> str:
        return self.output.read_text("utf-8", "replace")

    def signal(self, number: signal.Signals) -> None:
        self._process.send_signal(number)

    async def says(self, text: str) -> None:
        await until(lambda: text in self.said() or self.exit is not None, f"{self.name}: {text}")
        assert text in self.said(), f"{self.name} ended with {self.exit}:\n{self.said()}"

    async def ended(self, timeout_s: float = 300.0) -> int:
        try:
            return await asyncio.wait_for(self._process.wait(), timeout_s)
        except TimeoutError:
            pytest.fail(f"{self.name} has not ended within {timeout_s:g} s:\n{self.said()}")

    async def end(self) -> None:
        if self.exit is None:
            self._process.kill()
        await self._process.wait()


class Terminal:
    """A terminal of 200 columns: `end` is for the process, `shown` is the text written there."""

    def __init__(self) -> None:
        self._mine, self.end = os.openpty()
        termios.tcsetwinsize(self.end, (50, 200))
        self.shown = ""
        self._reader = threading.Thread(target=self._read)
        self._reader.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        os.close(self.end)
        self._reader.join()
        os.close(self._mine)

    def _read(self) -> None:
        decoder = codecs.getincrementaldecoder("utf-8")("replace")
        with contextlib.suppress(OSError):  # the terminal's other end is closed
            while written := os.read(self._mine, 65_536):
                self.shown += decoder.decode(written)


class Processes:
    def __init__(self, folder: Path) -> None:
        self.folder = folder.resolve()
        self._started: list[Process] = []

    async def run(
        self, name: str, command: Sequence[str | Path], errors: int = asyncio.subprocess.STDOUT
    ) -> Process:
        output = self.folder / f"{name}.said"
        with output.open("wb") as file:
            process = await asyncio.create_subprocess_exec(
                *command,
                stdin=asyncio.subprocess.DEVNULL,
                stdout=file,
                stderr=errors,
                cwd=self.folder,
                env={**os.environ, "PYTHONUNBUFFERED": "1", "COLUMNS": "200"},
            )
        started = Process(name, process, output)
        self._started.append(started)
        return started

    async def start(self, *arguments: str | Path, name: str = "") -> Process:
        number = len(self._started)
        return await self.run(name or f"{number}-{arguments[0]}", [*PROGRAM, *arguments])

    async def router(self) -> str:
        process = await self.start("router", "--listen", "tcp/127.0.0.1:0")
        await process.says("listening at tcp/127.0.0.1:")
        await process.says("\n")
        return process.said().split()[-1]

    def alive(self) -> dict[int, list[str]]:
        found = {}
        for entry in _PROC.iterdir():
            if entry.name.isdigit():
                # Not readable, or ended: a zombie has no working folder.
                with contextlib.suppress(PermissionError, FileNotFoundError, ProcessLookupError):
                    if (entry / "cwd").readlink().is_relative_to(self.folder):
                        command = (entry / "cmdline").read_bytes().decode()
                        found[int(entry.name)] = command.rstrip("\0").split("\0")
        return found

    async def pid(self, *words: str) -> int:
        """Id of the process whose command line has all these words, once it lives."""

        found: list[int] = []

        def alone() -> bool:
            # Before its exec a child has its parent's command line.
            lines = self.alive().items()
            found[:] = [pid for pid, line in lines if {"teamslam", *words} <= set(line)]
            return len(found) == 1

        await until(alone, f"one process `{' '.join(words)}`")
        return found[0]

    async def none_left(self, timeout_s: float = 10.0) -> None:
        try:
            await until(lambda: not self.alive(), "no process is left", timeout_s)
        except AssertionError:
            pytest.fail(f"left behind: {self.alive()}")

    async def close(self) -> None:
        for process in reversed(self._started):
            await process.end()
        try:
            await self.none_left()
        finally:
            for pid in self.alive():
                os.kill(pid, signal.SIGKILL)
