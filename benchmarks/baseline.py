"""Compare the figures of a benchmark with its committed baseline.

`benchmarks/NAME.json`: `command`, place of measurement, and for each of its `figures` the `value`,
the `better` direction ("less" or "more") and `tolerance`, the share by which it may be worse.
"""

import argparse
import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

HERE = Path(__file__).parent


class Held(NamedTuple):
    """A figure with its baseline; `bound` is the worst allowed."""

    name: str
    value: float
    was: float
    bound: float
    better: str

    @property
    def is_worse(self) -> bool:
        """Whether the figure is beyond its bound, or NaN."""
        within = self.value <= self.bound if self.better == "less" else self.value >= self.bound
        return not within


def baselines() -> dict[str, dict[str, Any]]:
    read = {path.stem: json.loads(path.read_text()) for path in sorted(HERE.glob("*.json"))}
    return {name: told for name, told in read.items() if "figures" in told}


def compare_figures(figures: Mapping[str, float], baseline: Mapping[str, Any]) -> list[Held]:
    rows = []
    for name, of in baseline["figures"].items():
        sign = 1.0 if of["better"] == "less" else -1.0
        bound = of["value"] * (1.0 + sign * of["tolerance"])
        rows.append(Held(name, float(figures[name]), of["value"], bound, of["better"]))
    return rows


def find_worse(figures: Mapping[str, float], name: str) -> list[str]:
    return [
        f"{row.name} is {row.value:.4g}, it was {row.was:.4g} and may be {row.bound:.4g}"
        for row in compare_figures(figures, baselines()[name])
        if row.is_worse
    ]


def parser_of(doc: str | None) -> argparse.ArgumentParser:
    """Make a parser with the first line of a docstring as its description, and --json."""
    parser = argparse.ArgumentParser(description=(doc or "").partition("\n")[0])
    parser.add_argument("--json", type=Path)
    return parser


def conclude(figures: Mapping[str, Any], name: str | None, file: Path | None, *wrong: str) -> int:
    """Print the figures, write them to `file`, compare them with the baseline of this name, if any.

    wrong: further faults. Returns the exit status, 1 for any fault.
    """
    text = json.dumps(figures, indent=1)
    print(text)
    if file is not None:
        file.write_text(text + "\n")
    judged = figures.get("figures", figures)
    problems = [*wrong, *(find_worse(judged, name) if name else [])]
    print("\n".join(problems) or "nothing worse", file=sys.stderr)
    return 1 if problems else 0
