"""Two robots' drivers at real-time pace: processes killed, links cut, and the final map.

    python -m tests.trials.drivers [--runs 1] [--seconds 60] [--kills 5] [--cuts 5] [--json FILE]

As `cuts`, with a live team: each driver is examples/robot.py on the tables of examples/own_data.py,
in a namespace of its own. Robots' and drivers' processes are killed at random, too, and started
again as they were. The final map must be, byte for byte, that of the same tables run as a data set,
in memory.
"""

import subprocess
import sys
from pathlib import Path

from teamslam.sim.scenarios.scenario import load, with_options
from tests.trials.cuts import ROUTER, Run, options_of, play, play_all
from tests.trials.kills import PROGRAM, expected_of

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
ROBOTS = ("r1", "r2")
STEP_S = 0.1
TEAM = """
base = "recorded"
name = "lab"
robot_count = 2

[world]
kind = "live"
"""


def write_tables(folder: Path, seconds: float) -> None:
    """Both robots' tables up to a time, and the live team's scenario."""
    subprocess.run([sys.executable, EXAMPLES / "own_data.py", folder / "data"], check=True)
    for table in folder.glob("data/*/o*.csv"):
        header, *rows = table.read_text().splitlines()
        kept = [row for row in rows if float(row.partition(",")[0]) <= seconds]
        table.write_text("\n".join([header, *kept]) + "\n")
    (folder / "lab.toml").write_text(TEAM)


def commands(folder: Path) -> dict[str, list[str]]:
    """The processes in each namespace."""
    there, lab = ["--connect", ROUTER], str(folder / "lab.toml")
    found = {
        "recorder": [*PROGRAM, "record", lab, "--output", "run/log.mcap", *there],
        "central": [*PROGRAM, "central", lab, *there],
    }
    for robot in ROBOTS:
        example = [sys.executable, str(EXAMPLES / "robot.py"), robot, str(folder / "data" / robot)]
        found[robot] = [*PROGRAM, "robot", lab, robot, *there]
        found[f"driver-{robot}"] = [*example, "lab", ROUTER, str(STEP_S)]
    return found


def main() -> int:
    parser = options_of(__doc__, kills=5)
    parser.set_defaults(runs=1)
    parser.add_argument("--seconds", type=float, default=60.0, help="of data, and of its drive")
    options = parser.parse_args()
    options.span = options.seconds
    mortal = [*ROBOTS, *(f"driver-{robot}" for robot in ROBOTS)]

    def one(number: int, folder: Path) -> Run:
        write_tables(folder, options.seconds)
        scenario = with_options(load(folder / "lab.toml"), dataset=folder / "data")
        told = commands(folder)
        return play(number, folder, told, expected_of(scenario), options, mortal)

    return play_all(one, options)


if __name__ == "__main__":
    sys.exit(main())
