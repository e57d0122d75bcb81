"""Measure the import rate of ROS 2 bags against plain reading, and decode damaged payloads.

    python -m benchmarks.importing [--messages 40000] [--damaged 1000000] [--json FILE]

A bag is written as .mcap and .db3, deserialised by rosbags, and imported. Damaged payloads must be
refused or sound. Exit status 1 for another error or a figure worse than benchmarks/importing.json
allows.
"""

import random
import sys
import tempfile
import time
from pathlib import Path

from rosbags.highlevel import AnyReader

from benchmarks.baseline import conclude, parser_of
from teamslam.sim.importing.bag import import_bag
from teamslam.team.ros2.decoding import READERS, DamagedError, decode, types
from tests.ros2 import messages as ros
from tests.ros2.test_decoding import SAMPLES

ODOMETRY, TAGS = "nav_msgs/msg/Odometry", "vision_msgs/msg/Detection3DArray"
PERIOD_NS = 10_000_000
ODOMETRY_PER_SCAN = 9


def drive(count: int) -> list[ros.Message]:
    found: list[ros.Message] = []
    for k in range(count):
        at = (k + 1) * PERIOD_NS
        if k % (ODOMETRY_PER_SCAN + 1) == ODOMETRY_PER_SCAN:
            seen = [(str(i), ros.pose(1.0 + i, 0.1 * i)) for i in range(4)]
            found.append((at, "/tags", TAGS, ros.detections(at, "base_link", seen)))
        else:
            found.append((at, "/odom", ODOMETRY, ros.odometry(at, ros.pose(0.01 * k), 1.0)))
    return found


def plain_s(bag: Path) -> float:
    began = time.perf_counter()
    with AnyReader([bag], default_typestore=types()) as reader:
        for connection, _, data in reader.messages():
            reader.deserialize(data, connection.msgtype)
    return time.perf_counter() - began


def imported_s(bag: Path, folder: Path) -> float:
    began = time.perf_counter()
    for robot in import_bag(bag, None, None).tables:
        robot.write(folder)
    return time.perf_counter() - began


def damaged(count: int) -> tuple[int, int, float]:
    """Count refused payloads and other errors, and measure the seconds."""
    chance = random.Random(0)
    sound = [(kind, ros.cdr(kind, SAMPLES[kind])) for kind in READERS]
    refused = wrong = 0
    began = time.perf_counter()
    for k in range(count):
        kind, data = sound[k % len(sound)]
        spoilt = bytearray(data)
        for _ in range(chance.randint(1, 4)):
            spoilt[chance.randrange(len(spoilt))] = chance.randrange(256)
        if chance.random() < 0.5:
            spoilt = spoilt[: chance.randrange(len(spoilt))]
        try:
            decode(kind, bytes(spoilt))
        except DamagedError:
            refused += 1
        except Exception as error:
            wrong += 1
            print(f"{kind}: {type(error).__name__}: {error}: {bytes(spoilt).hex()}")
    return refused, wrong, time.perf_counter() - began


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--messages", type=int, default=40_000)
    parser.add_argument("--damaged", type=int, default=1_000_000)
    asked = parser.parse_args()
    figures: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as place:
        messages = drive(asked.messages)
        for name in ("mcap", "db3"):
            bag = ros.write_bag(Path(place) / name, messages, db3=name == "db3")
            plain = min(plain_s(bag) for _ in range(2))
            took = min(imported_s(bag, Path(place) / f"{name}-{k}") for k in range(2))
            figures[f"{name}_plain_per_s"] = round(len(messages) / plain)
            figures[f"{name}_imported_per_s"] = round(len(messages) / took)
            figures[f"{name}_times_plain"] = round(took / plain, 2)
    refused, wrong, seconds = damaged(asked.damaged)
    figures |= {"damaged": asked.damaged, "refused": refused, "raised": wrong}
    figures["damaged_per_s"] = round(asked.damaged / seconds)
    return conclude(figures, "importing", asked.json)


if __name__ == "__main__":
    sys.exit(main())
