"""Results on disk, one JSON line each, appended as they come: an interrupted command goes on."""

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from sim.studies.experiments.task import Task, program_of

FILE = "runs.jsonl"


class Store:
    """The results in a folder. A line counts for a task of the same name and the same program."""

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.path = folder / FILE
        self._whole_lines()

    def found(self, tasks: Iterable[Task]) -> dict[str, dict[str, Any]]:
        """The results of those tasks that are there, by name."""
        wanted = {task.name: _program(task) for task in tasks}
        results = {}
        if self.path.exists():
            with self.path.open(encoding="utf-8") as lines:
                for line in lines:
                    # The name stands first in the line: most lines need not be decoded.
                    if line[10:42] in wanted and (kept := _decoded(line)) is not None:
                        name = kept["task"]
                        if kept["program"] == wanted.get(name):
                            results[name] = kept["result"]
        return results

    def keep(self, task: Task, result: dict[str, Any], seconds: float) -> None:
        """Append one result; it is on its way to the disk when this returns."""
        line = {
            "task": task.name,
            "program": _program(task),
            "label": task.label,
            "seconds": round(seconds, 3),
            "result": result,
        }
        with self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(line) + "\n")

    def _whole_lines(self) -> None:
        """Ends a last line that was cut off, so that the next one stands alone."""
        if not self.path.exists():
            return
        with self.path.open("rb+") as file:
            if file.seek(0, 2) and (file.seek(-1, 2), file.read(1))[1] != b"\n":
                file.write(b"\n")


def _program(task: Task) -> str:
    return program_of(task.work.partition(":")[0])


def _decoded(line: str) -> dict[str, Any] | None:
    """The line's content; None if it was cut off."""
    try:
        content: dict[str, Any] = json.loads(line)
    except json.JSONDecodeError:
        return None
    return content if content.keys() >= {"task", "program", "result"} else None
