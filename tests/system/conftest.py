import json
import signal
import threading
from collections.abc import AsyncIterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import pytest_asyncio

from tests.system.processes import Processes
from tests.system.scenarios import short

# A shell's background jobs, and their children, ignore Ctrl-C.
if threading.current_thread() is threading.main_thread():
    signal.signal(signal.SIGINT, signal.default_int_handler)


@dataclass(frozen=True)
class Launched:
    scenario: Path
    exit: int
    result: dict[str, Any]
    log: Path
    said: str


@pytest_asyncio.fixture
async def team(tmp_path: Path) -> AsyncIterator[Processes]:
    processes = Processes(tmp_path)
    try:
        yield processes
    finally:
        await processes.close()


@pytest_asyncio.fixture(scope="session", loop_scope="session")
async def launched(tmp_path_factory: pytest.TempPathFactory) -> Launched:
    folder = tmp_path_factory.mktemp("launched")
    processes = Processes(folder)
    scenario = short(folder)
    try:
        process = await processes.start(
            *("launch", scenario, "--speed", "max", "--output", folder / "run"),
            *("--json", folder / "result.json"),
        )
        status = await process.ended()
        await processes.none_left(0.0)
    finally:
        await processes.close()
    result = json.loads((folder / "result.json").read_text())
    return Launched(scenario, status, result, folder / "run" / "log.mcap", process.said())
