"""UTIAS sets judged with what was learnt from the others: `leave_one_out.py SET SET SET`.

For each set, everything that `teamslam calibrate` learns comes from the others (about six minutes
of a processor each); then the team runs on it in memory. A table, and with --json FILE its figures:
FILE is written after each set, and what it has is not run again. With --learnt FOLDER what was
learnt is kept there as a scenario, and is not learnt again.
"""

import argparse
import json
import sys
import tempfile
from pathlib import Path

import msgspec

from sim.calibration.calibrate import calibrate_models
from sim.calibration.scenario import scenario_toml
from sim.calibration.source import measurements_of
from sim.scenarios.scenario import load
from sim.studies.experiments.accuracy_utias import set_figures
from sim.studies.experiments.team_runs import Figures, team_run

SHOWN = ("aligned", "shape_nees", "coverage", "raw", "nees", "trajectory_raw")


def left_out(path: Path, others: list[Path], folder: Path) -> Figures:
    """The figures of a set under the models learnt from the others."""
    scenario = folder / f"without-{path.stem}.toml"
    if not scenario.exists():
        _learn(others, scenario)
    figures = team_run(msgspec.to_builtins(load(str(scenario))), batch=False, path=str(path))
    return set_figures(figures)


def _learn(others: list[Path], scenario: Path) -> None:
    """Write what `teamslam calibrate` learns from these sets."""
    read = [(other.name, *measurements_of(other)) for other in others]
    worlds = [(name, world) for name, world, _ in read]
    start = read[0][2]
    found = calibrate_models(worlds, start, lambda said: print(f"  {said}", file=sys.stderr))
    scenario.write_text(scenario_toml(found, start, [name for name, _ in worlds]), "utf-8")


def main() -> int:
    """Print the table; 2 where there are fewer than two sets."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sets", nargs="*", type=Path)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--learnt", type=Path, metavar="FOLDER")
    asked = parser.parse_args()
    sets = [path for path in asked.sets if path.exists()]
    for path in asked.sets:
        if path not in sets:
            print(f"skipped: {path} is not there", file=sys.stderr)
    if len(sets) < 2:
        print("two UTIAS sets or more are needed, each a zip or a folder", file=sys.stderr)
        return 2
    table: dict[str, Figures] = {}
    if asked.json is not None and asked.json.exists():
        table = json.loads(asked.json.read_text("utf-8"))
    with tempfile.TemporaryDirectory() as temporary:
        folder = asked.learnt or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        for path in sets:
            if path.name not in table:
                print(f"{path.name}, learnt from the others", file=sys.stderr)
                others = [other for other in sets if other != path]
                table[path.name] = left_out(path, others, folder)
            print(path.name, *(f"{name} {table[path.name][name]:.4f}" for name in SHOWN))
            if asked.json is not None:
                asked.json.write_text(json.dumps(table, indent=2) + "\n", "utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
