"""Every form of measurement through every command: a table of what came of it.

    python benchmarks/forms.py [--seconds 400] [--only NAME]

A simulated team tells its odometry as speeds, as increments (without and with covariances) or as a
car's encoders; it sees landmarks as ranges or as points, without and with covariances, from the
base or from a mounted sensor. Each world is written as a folder of tables; then `rerun`,
`calibrate`, `batch-reference` and `batch-reference --g2o` are called on the folder as a user would,
and `import` makes another folder of it, whose tables are the same bytes. A cell is the figure that
tells whether the command did its work: landmark RMSE, NEES per dof and joint cost per dof of the
final map, those of the batch, the learnt factor or scale of the odometry. Exit status 1 where a
command fails, tables differ, NEES per dof of either map is not between 0.4 and 2, or a learnt
figure is more than 25 % from 1.
"""

import argparse
import contextlib
import io
import json
import sys
import tempfile
from pathlib import Path

import msgspec

from sim.cli.main import app
from sim.datasets.folder_writer import write_folder
from sim.scenarios.scenario import Scenario, load, with_options
from sim.scenarios.source import streams_of
from sim.scenarios.toml import folder_scenario
from team.config import MotionModel, MotionNoise

MOTION = MotionModel(
    forward=MotionNoise(0.02, 0.04), turn=MotionNoise(0.01, 0.02), lateral=MotionNoise(0.01, 0.03)
)
CAR = MotionModel(
    "ackermann", turn=MotionNoise(0.002), lateral=MotionNoise(0.01), forward=MotionNoise(0.01),
    wheel_base=2.83, wheel_offset=0.76, shares=(0.08, 0.06, 0.01), shares_interval_s=1.0,
)  # fmt: skip
MOUNT = (3.78, 0.5, -0.4)
INCREMENTS = {"odometry": "increments"}
CLAIMED = {"odometry": "increments", "odometry_claims": True, "odometry_correlation": 0.6}
CASES = {
    "speeds, ranges": ({}, MOTION, None),
    "increments, ranges": (INCREMENTS, MOTION, None),
    "increments with covariances, points": (CLAIMED | {"landmark_form": "points"}, MOTION, None),
    "speeds, points with covariances": (
        {"landmark_form": "points", "landmark_claims": (0.5, 2.0)}, MOTION, None,
    ),
    "speeds, ranges with covariances": ({"landmark_claims": (0.5, 2.0)}, MOTION, None),
    "all claimed, mounted": (
        CLAIMED | {"landmark_form": "points", "landmark_claims": (0.5, 2.0)}, MOTION, MOUNT,
    ),
    "car, mounted": ({"odometry": "steering", "speed_m_s": 2.0}, CAR, MOUNT),
}  # fmt: skip


def scenario_of(name: str, seconds: int) -> Scenario:
    """The world of a case."""
    world, motion, mount = CASES[name]
    base = with_options(load("waypoints"), robots=2)
    robots = tuple(
        msgspec.structs.replace(
            base.robots[0],
            id=f"r{k}",
            motion=motion,
            sensor=msgspec.structs.replace(
                base.robots[0].sensor, range_sigma=0.1, mount=mount or (0.0, 0.0, 0.0)
            ),
        )
        for k in (1, 2)
    )
    of = msgspec.structs.replace(base.world, steps=seconds, size_m=50.0, **world)
    return msgspec.structs.replace(base, world=of, robots=robots)


def typed(*words: object) -> str:
    """What a command prints; raises SystemExit where it fails."""
    out = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(io.StringIO()):
        app([str(word) for word in words], standalone_mode=False)
    return out.getvalue()


def row(name: str, seconds: int, place: Path) -> tuple[str, bool]:
    """One line of the table, and whether all of it is right."""
    of = scenario_of(name, seconds)
    streams = streams_of(of)
    folder = place / "set"
    write_folder(streams, folder)
    (folder / "scenario.toml").write_text(folder_scenario(of), "utf-8")
    again = place / "again"
    typed("import", folder, "-o", again)
    tables = sorted(path.relative_to(folder) for path in folder.rglob("*.csv"))
    bits = all((folder / each).read_bytes() == (again / each).read_bytes() for each in tables)
    json_file = place / "figures.json"
    typed("rerun", folder, "--json", json_file)
    told = json.loads(json_file.read_text())
    run = told.get("recomputed", told)
    typed("batch-reference", folder, "--json", json_file)
    batch = json.loads(json_file.read_text())
    typed("batch-reference", folder, "--g2o", place / "problem.g2o")
    edges = sum(line.startswith("EDGE") for line in (place / "problem.g2o").open())
    typed("calibrate", folder, "--json", json_file, "-o", place / "learnt.toml")
    learnt = json.loads(json_file.read_text())
    load(place / "learnt.toml")
    figures = {f["name"]: f["value"] for f in (*learnt["motion"], *learnt["sensor"])}
    factor = figures.get("covariance_factor", figures.get("forward_scale", float("nan")))
    words = [
        f"{name:38}",
        "bits" if bits else "BITS DIFFER",
        f"rerun {run['landmark_rmse_m']:.3f} m, NEES/dof {run['map_nees_per_dof']:.2f},",
        f"cost {run['joint_cost_per_dof']:.2f}; batch {batch['landmark_rmse_m']:.3f} m,",
        f"NEES/dof {batch['map_nees_per_dof']:.2f}; g2o {edges} edges; learnt {factor:.3f}",
    ]
    sound = all(0.4 < each["map_nees_per_dof"] < 2.0 for each in (run, batch))
    return " ".join(words), bits and sound and abs(factor - 1.0) < 0.25


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=int, default=400)
    parser.add_argument("--only", default="")
    options = parser.parse_args()
    failed = 0
    for name in CASES:
        if not name.startswith(options.only):
            continue
        with tempfile.TemporaryDirectory() as place:
            line, right = row(name, options.seconds, Path(place))
        failed += not right
        print(line + ("" if right else "   WRONG"), flush=True)
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
