"""Run the benchmarks that have a committed baseline, and report figures worse than it allows.

    python -m benchmarks.every [NAME …] [--output DIR]        or `make bench`

Figures are written to DIR/NAME.json. Exit status 1 if a figure is worse or a benchmark failed.
"""

import argparse
import json
import shlex
import subprocess
import sys
from pathlib import Path

from benchmarks.baseline import Held, baselines, compare_figures


def run_benchmark(name: str, command: str, output: Path) -> dict[str, float]:
    page = output / f"{name}.json"
    page.unlink(missing_ok=True)
    program, *options = shlex.split(command)
    assert program == "python"
    subprocess.run([sys.executable, *options, "--json", page], check=False, stdout=sys.stderr)
    told: dict[str, float] = json.loads(page.read_text())
    figures = told.get("figures", told)
    assert isinstance(figures, dict)
    return figures


def line(name: str, row: Held) -> str:
    sign = "≤" if row.better == "less" else "≥"
    verdict = "WORSE" if row.is_worse else "ok"
    return (
        f"{name:10} {row.name:22} {row.value:12.4g} {row.was:12.4g}  {sign} {row.bound:<11.4g} "
        f"{verdict}"
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("names", nargs="*", help="All that have a baseline if none is given.")
    parser.add_argument("--output", type=Path, default=Path("runs/benchmarks"))
    told = parser.parse_args()
    known = baselines()
    unknown = sorted(set(told.names) - set(known))
    if unknown:
        parser.error(f"no baseline of {', '.join(unknown)}; there are {', '.join(known)}")
    told.output.mkdir(parents=True, exist_ok=True)
    lines, is_worse = [], False
    for name in told.names or known:
        command = known[name]["command"]
        print(f"{name}: {command}", file=sys.stderr)
        try:
            rows = compare_figures(run_benchmark(name, command, told.output), known[name])
        except (OSError, ValueError, KeyError) as error:
            lines.append(f"{name:10} failed: {error}")
            is_worse = True
            continue
        lines += [line(name, row) for row in rows]
        is_worse |= any(row.is_worse for row in rows)
    print(f"{'benchmark':10} {'figure':22} {'now':>12} {'committed':>12}  at worst")
    print("\n".join(lines))
    return int(is_worse)


if __name__ == "__main__":
    sys.exit(main())
