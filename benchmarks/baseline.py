"""Compare the figures of a benchmark with its committed baseline.

`benchmarks/NAME.json` has the `command`, where it was `measured`, and for each of its `figures` the
`value`, the direction that is `better` ("less" or "more"), and the `tolerance`: the share by which
it may be worse. Ratios within one run hold on any machine.
"""

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
        """Beyond its bound, or NaN."""
        within = self.value <= self.bound if self.better == "less" else self.value >= self.bound
        return not within


def baselines() -> dict[str, dict[str, Any]]:
    read = {path.stem: json.loads(path.read_text()) for path in sorted(HERE.glob("*.json"))}
    return {name: told for name, told in read.items() if "figures" in told}


def held(figures: Mapping[str, float], baseline: Mapping[str, Any]) -> list[Held]:
    rows = []
    for name, of in baseline["figures"].items():
        sign = 1.0 if of["better"] == "less" else -1.0
        bound = of["value"] * (1.0 + sign * of["tolerance"])
        rows.append(Held(name, float(figures[name]), of["value"], bound, of["better"]))
    return rows


def worse(figures: Mapping[str, float], name: str) -> list[str]:
    return [
        f"{row.name} is {row.value:.4g}, it was {row.was:.4g} and may be {row.bound:.4g}"
        for row in held(figures, baselines()[name])
        if row.is_worse
    ]


def concluded(figures: Mapping[str, Any], name: str, file: Path | None, *wrong: str) -> int:
    """Print the figures, write them to `file` if given, and compare them with the baseline.

    wrong: further faults. Returns the exit status: 1 for any fault.
    """
    text = json.dumps(figures, indent=1)
    print(text)
    if file is not None:
        file.write_text(text + "\n")
    problems = [*wrong, *worse(figures, name)]
    print("\n".join(problems) or "nothing worse", file=sys.stderr)
    return 1 if problems else 0
