"""How much there is to read: lines by wing, and what is longer than a reader takes in at once.

python -m tests.sizes          Markdown, with the reason for each long one from the table below
python -m tests.sizes --bare   those without a reason alone; exit status 1 if there are any
"""

import ast
import sys
from collections.abc import Iterator
from pathlib import Path

from tests.support import ROOT

WINGS = ("team", "central", "sim", "tests", "benchmarks", "examples")
PRODUCTION = WINGS[:3]
LONG_MODULE, LONG_FUNCTION = 300, 60
KERNEL = "compiled: an inner loop, whose locals Numba keeps in registers"
STUDY = "reproduces one source's tables: read beside that source"
COMMAND = "commands: typer reads their options from signatures"
REASONS = {
    "team/robot/main.py": "the robot's process: how it resumes, and what it asks for",
    "team/robot/node.py": "the node: its parts are modules of their own, here is who hears what",
    "team/translate.py": "both directions of each message side by side",
    "team/ros2_driver.py": "a robot's topics: their intake, order and warnings",
    "team/driver/driver.py": "a user's face: a method for each kind of measurement",
    "team/library.py": "a user's face: what `from team import …` gives",
    "team/config.py": "tables of fields with their meaning",
    "team/shell.py": "the one process loop",
    "team/wire/bus.py": "the interface of a bus and the one in memory",
    "team/wire/zenoh/bus.py": "the same interface over Zenoh",
    "team/recording/shell.py": "the recorder's process: what it fetches, and when it leaves",
    "team/peers/replica.py": "a peer's set: all its sorts of members",
    "team/estimation/elementary.py": KERNEL,
    "team/estimation/map_joining/associating.py": "one island: its pairs, their checks and merges",
    "team/estimation/models.py": "the models of motion and of the sensor, with their Jacobians",
    "team/estimation/hybrid_slam/keyframes.py": "one cut of the stream into keyframes",
    "team/estimation/hybrid_slam/landmarks_along_paths.py": KERNEL,
    "team/estimation/hybrid_slam/innovation.py": "one innovation: what is predicted, and its test",
    "team/estimation/hybrid_slam/window.py": "one window from its opening to its moments",
    "team/estimation/map_joining/submap_graph.py": "one graph: its index arithmetic is one table",
    "team/estimation/map_joining/gauss_newton.py": "one cost with its robust weights",
    "team/estimation/map_joining/joining.py": "one fold",
    "team/estimation/map_joining/marginals.py": "what is read off a fold",
    "team/estimation/map_joining/association/closing.py": "one test of a closure, step by step",
    "team/estimation/map_joining/map_matching.py": "one search for a place by the maps alone",
    "team/estimation/association/tracking.py": "one tracker of unnamed landmarks in a window",
    "team/estimation/map_joining/minima.py": "one search for other minima",
    "sim/studies/estimators/batch.py": "the batch estimate; baseline",
    "sim/studies/estimators/batch_factors.py": "its residuals and their places; baseline",
    "central/tick_fold.py": "one fold by ticks, with its way back",
    "central/desk/evaluation/association.py": "one score, from the counts to what a map shows",
    "central/desk/evaluation/evaluation.py": "a log's figures, one record a section",
    "central/desk/report/page.py": "one page, section after section",
    "central/desk/pictures/run.py": "a run's pictures, one a function",
    "central/desk/pictures/time.py": "pictures over time, one a function",
    "central/desk/view/node.py": "the viewer's node: one view a method",
    "sim/publisher/node.py": "one node: its pace, credit, and how it goes on after a death",
    "sim/calibration/sensor.py": "one likelihood and its search",
    "sim/datasets/unlabelled.py": "data sets without labels, a reader each",
    "sim/world/simulator.py": "the simulator, in the order of what it draws",
    "sim/world/streams.py": "what a sensor stream is, to worlds and logs alike",
    "sim/scenarios/scenario.py": "the scenario and how its parts fit",
}
"""Why a long module is one; a function is long in it for the same reason."""


def modules(wings: tuple[str, ...] = WINGS) -> Iterator[tuple[str, str]]:
    """Each module's place and text."""
    for wing in wings:
        for path in sorted((ROOT / wing).rglob("*.py")):
            yield path.relative_to(ROOT).as_posix(), path.read_text("utf-8")


def long_functions(source: str) -> Iterator[tuple[str, int]]:
    """The functions of more than LONG_FUNCTION lines, with their lines."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            lines = (node.end_lineno or node.lineno) - node.lineno + 1
            if lines > LONG_FUNCTION:
                yield node.name, lines


def reason(place: str) -> str:
    """Why what is here is long; empty: nobody has said."""
    if Path(place).stem.endswith("kernel"):
        return KERNEL
    folders = {"sim/studies": STUDY, "sim/cli": COMMAND}
    general = [why for folder, why in folders.items() if place.startswith(folder)]
    return next(iter(general), REASONS.get(place, ""))


def rows() -> Iterator[tuple[str, int, str]]:
    """Long modules and functions of production code: name, lines, reason."""
    for place, source in modules(PRODUCTION):
        lines = source.count("\n")
        if lines > LONG_MODULE:
            yield place, lines, reason(place)
        for name, long in long_functions(source):
            yield f"{place}: {name}", long, reason(place)


def main() -> int:
    """Print the tables."""
    found = list(rows())
    bare = [row for row in found if not row[2]]
    if "--bare" in sys.argv:
        for name, lines, _ in bare:
            print(f"{name}: {lines} lines")
        return int(bool(bare))
    print("| wing | lines | modules |\n|---|---|---|")
    for wing in WINGS:
        texts = [source for _, source in modules((wing,))]
        print(f"| {wing} | {sum(t.count(chr(10)) for t in texts)} | {len(texts)} |")
    print(f"\n| longer than {LONG_MODULE}, {LONG_FUNCTION} lines | lines | why |\n|---|---|---|")
    for name, lines, why in sorted(found, key=lambda row: -row[1]):
        print(f"| `{name}` | {lines} | {why} |")
    return 0


if __name__ == "__main__":
    sys.exit(main())
