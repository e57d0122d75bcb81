"""One data set by seven ways into the program: one final map, or how far apart the maps are.

    python -m tests.trials.ways_in UTIAS.zip [--seconds 240] [--speed 8] [--keep FOLDER] [--only …]

zip      the data set as it is
csv      a folder of tables
mcap, db3  ROS 2 bags of it (odometry as twists, detections as points), imported
rmw, bridge  the bag's bytes on rmw_zenoh's and on zenoh-bridge-ros2dds' keys, from an independent
         process, to a `teamslam driver` per robot and a live team of processes
log      the log of such a live team, imported

A range and bearing become a point in a bag, which costs the last bit: the first two maps must be
equal byte for byte, and so must the other five. Ends with 1 where maps differ.
"""

import argparse
import contextlib
import hashlib
import json
import os
import shutil
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import zenoh

from teamslam.sim.datasets.folder_writer import write_folder
from teamslam.sim.in_memory.team import final_map, run_team
from teamslam.sim.scenarios.scenario import Scenario, folder_scenario, load, with_options
from teamslam.sim.scenarios.source import streams_of
from teamslam.sim.world.streams import RobotStream
from teamslam.team.recording.reader import open_log
from teamslam.team.ros2.bags import opened_bag
from teamslam.team.wire import channels as ch
from teamslam.team.wire.bus import opened
from teamslam.team.wire.messages import FusedMap
from tests.ros2 import messages as ros
from tests.trials.kills import PROGRAM

EXACT = ("zip", "csv")
BY_POINTS = ("mcap", "db3", "rmw", "bridge", "log")
STORE = ros.STORE
ODOMETRY, TAGS = "nav_msgs/msg/Odometry", "vision_msgs/msg/Detection3DArray"
START_SIGMAS = (0.05, 0.03)  # as the UTIAS reader has them [m, rad]
QUIET_S = 10.0
ONE_THREAD = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"), "1")


# The bag.


def of_robot(stream: RobotStream) -> list[ros.Message]:
    found: list[ros.Message] = []
    intervals = stream.intervals
    begins = (intervals.end_ns - intervals.duration_ns).tolist()
    rows = zip(begins, intervals.forward.tolist(), intervals.yaw_rate.tolist(), strict=True)
    for at, v, w in [*rows, (int(intervals.end_ns[-1]), 0.0, 0.0)]:
        found.append((at, f"/{stream.robot}/odom", ODOMETRY, ros.odometry(at, ros.pose(), v, w)))
    seen: dict[int, list[tuple[str, Any]]] = {}
    for scans, mates in ((stream.landmark_detections, False), (stream.teammate_detections, True)):
        for k, at in enumerate(scans.stamps_ns.tolist()):
            for i in range(scans.offsets[k], scans.offsets[k + 1]):
                tag = int(stream.teammates[scans.ids[i]][1:]) if mates else int(scans.ids[i])
                r, b = float(scans.ranges[i]), float(scans.bearings[i])
                at_tag = ros.pose(float(r * np.cos(b)), float(r * np.sin(b)))
                seen.setdefault(at, []).append((str(tag), at_tag))
    topic = f"/{stream.robot}/detections"
    return found + [
        (at, topic, TAGS, ros.detections(at, "base_link", tags)) for at, tags in seen.items()
    ]


def write_bags(streams: tuple[RobotStream, ...], folder: Path) -> None:
    messages = sorted((m for s in streams for m in of_robot(s)), key=lambda m: m[0])
    for name in ("mcap", "db3"):
        ros.write_bag(folder / name, messages, db3=name == "db3")
    lines = []
    for s in streams:
        lines += [f"[robots.{s.robot}]", f'odometry = "/{s.robot}/odom"', 'use = "twist"']
        lines += [f'detections = ["/{s.robot}/detections"]', f"[robots.{s.robot}.teammates]"]
        lines += [f'{mate[1:]} = "{mate}"' for mate in s.teammates if mate != s.robot]
    (folder / "topics.toml").write_text("\n".join(lines) + "\n")


def starts(streams: tuple[RobotStream, ...]) -> dict[str, str]:
    found = {}
    for s in streams:
        x, y, theta = (repr(float(v)) for v in s.start.pose)
        sigmas = np.diag([START_SIGMAS[0] ** 2, START_SIGMAS[0] ** 2, START_SIGMAS[1] ** 2])
        assert np.array_equal(sigmas, s.start.covariance), "other sigmas than the reader's"
        found[s.robot] = ",".join([x, y, theta, *map(repr, START_SIGMAS)])
    return found


# The publisher: a process with the bag's reader alone.


def publish(mode: str, bag: Path, port: int, speed: float) -> None:
    with opened_bag(bag) as there:
        kinds = {topic.name: topic.kind for topic in there.topics}
        messages = [(m.arrival_ns, m.topic, bytes(m.data)) for m in there.messages(list(kinds))]
    robots = sorted({topic.split("/")[1] for topic in kinds})
    first, sent = messages[0][0], threading.Barrier(len(robots) + 1)

    def run(robot: str) -> None:
        config = zenoh.Config()
        config.insert_json5("mode", '"client"')
        config.insert_json5("connect/endpoints", f'["tcp/127.0.0.1:{port}"]')
        config.insert_json5("scouting/multicast/enabled", "false")
        session = zenoh.open(config)
        publishers, tokens, numbers = {}, [], Counter[str]()
        for topic in (topic for topic in kinds if topic.split("/")[1] == robot):
            package, _, name = kinds[topic].split("/")
            key = topic.strip("/")
            if mode == "rmw":
                key = f"0/{key}/{package}::msg::dds_::{name}_/{STORE.hash_rihs01(kinds[topic])}"
            else:
                told = "/".join(t.strip("/").replace("/", "§") for t in (topic, kinds[topic]))
                token = f"@/beef/@ros2_lv/MP/{told}/:::"
                tokens.append(session.liveliness().declare_token(token))
            publishers[topic] = session.declare_publisher(
                key, congestion_control=zenoh.CongestionControl.BLOCK
            )
        sent.wait()
        began = time.monotonic()
        for at, topic, data in messages:
            if topic not in publishers:
                continue
            time.sleep(max(0.0, began + 1e-9 * (at - first) / speed - time.monotonic()))
            attached = None
            if mode == "rmw":  # as rmw_zenoh numbers a publisher's samples
                numbers[topic] += 1
                gid = topic[-16:].encode().ljust(16)
                attached = struct.pack("<qqB16s", numbers[topic], at, 16, gid)
            publishers[topic].put(data, attachment=attached)
        sent.wait()

    for robot in robots:
        threading.Thread(target=run, args=(robot,), daemon=True).start()
    print("ready", flush=True)
    sys.stdin.readline()
    sent.wait()
    sent.wait()
    print(f"sent {len(messages)}", flush=True)
    sys.stdin.readline()


# The ways.


def of_data_set(scenario: Scenario) -> tuple[bytes, bytes, bytes]:
    found = final_map(list(run_team(scenario, streams_of(scenario))))
    return bytes(found.ids), bytes(found.means), bytes(found.covariance)


def of_log(log: Path) -> tuple[bytes, bytes, bytes]:
    last = list(open_log(log).samples([ch.FINAL_MAP]))[-1]
    found = opened(last)[2]
    assert isinstance(found, FusedMap)
    return bytes(found.ids), bytes(found.means), bytes(found.covariance)


def typed(*words: object) -> str:
    done = subprocess.run([*PROGRAM, *map(str, words)], capture_output=True, text=True, check=False,
                          env={**os.environ, **ONE_THREAD})  # fmt: skip
    if done.returncode:
        raise RuntimeError(f"{words}: {done.stdout}{done.stderr}")
    return done.stdout


def imported(source: Path, folder: Path, *options: object) -> Scenario:
    shutil.rmtree(folder, ignore_errors=True)
    print(typed("import", source, "-o", folder, *options).strip().splitlines()[-2], flush=True)
    return with_options(load(folder / "scenario.toml"), dataset=folder)


def live(way: str, place: Path, speed: float, at: dict[str, str]) -> Path:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    router, run = f"tcp/127.0.0.1:{port}", place / f"run_{way}"
    shutil.rmtree(run, ignore_errors=True)
    run.mkdir()
    env = {**os.environ, **ONE_THREAD}
    started: list[subprocess.Popen[str]] = []

    def begin(words: list[object], log: str, **options: object) -> "subprocess.Popen[str]":
        process = subprocess.Popen([str(w) for w in words], stderr=(run / log).open("w"), text=True,
                                   env=env, **options)  # type: ignore[call-overload] # fmt: skip
        started.append(process)
        return process  # type: ignore[no-any-return]

    try:
        words = ["launch", place / "live.toml", "--listen", router, "-o", run / "out"]
        words += ["--no-report", "--no-views"]
        team = begin([*PROGRAM, *words], "launch.log", stdout=subprocess.DEVNULL)
        awaited(run / "launch.log", "reach the team by", team)
        drivers = [
            begin([*PROGRAM, "driver", robot, "--ros2", place / "topics.toml", "--team", "live",
                   "--connect", router, "--start", start, "--latency", "30",
                   "--file", run / f"{robot}.stream"], f"driver_{robot}.log")
            for robot, start in at.items()
        ]  # fmt: skip
        publisher = begin(
            [sys.executable, "-m", "tests.trials.ways_in", "--publish", way,
             str(place / "mcap"), str(port), str(speed)],
            "publisher.log", stdin=subprocess.PIPE, stdout=subprocess.PIPE,
        )  # fmt: skip
        publisher.stdout.readline()
        logs = [run / f"driver_{robot}.log" for robot in at]
        for log in logs:
            awaited(log, "listening to", team)
        time.sleep(1.0)
        publisher.stdin.write("go\n")
        publisher.stdin.flush()
        print(publisher.stdout.readline().strip(), flush=True)
        settled(run, list(at))
        for driver in drivers:
            driver.send_signal(signal.SIGINT)
        team.wait(3600.0)
        for driver in drivers:
            driver.wait(60.0)
        for log in logs:
            for line in log.read_text().splitlines():
                if "never came" in line or "wait, the oldest" in line or "refused" in line:
                    print(f"{log.name}: {line}", flush=True)
    finally:
        for process in started:
            if process.poll() is None:
                process.terminate()
    return next(run.glob("out/**/*.mcap"))


def awaited(log: Path, text: str, team: "subprocess.Popen[str]") -> None:
    until = time.monotonic() + 400.0
    while text not in log.read_text():
        if time.monotonic() > until or team.poll() is not None:
            raise RuntimeError(f"{log}: {log.read_text()[-500:]}")
        time.sleep(0.2)


def settled(run: Path, robots: list[str]) -> None:
    """Return when the drivers' files stop growing."""
    sizes, since = [0], time.monotonic()
    while time.monotonic() - since < QUIET_S:
        time.sleep(0.5)
        now = [(run / f"{robot}.stream").stat().st_size for robot in robots]
        if now != sizes:
            sizes, since = now, time.monotonic()


def one(way: str, source: Scenario, place: Path, speed: float) -> tuple[bytes, bytes, bytes]:
    streams = streams_of(source)
    if way == "zip":
        return of_data_set(source)
    if way == "csv":
        folder = place / "tables"
        shutil.rmtree(folder, ignore_errors=True)
        write_folder(streams, folder)
        (folder / "scenario.toml").write_text(folder_scenario(source), "utf-8")
        return of_data_set(with_options(load(folder / "scenario.toml"), dataset=folder))
    if not (place / "topics.toml").exists():
        write_bags(streams.streams, place)
    at = starts(streams.streams)
    if way in ("mcap", "db3"):
        there = [word for robot, start in at.items() for word in ("--start", f"{robot}:{start}")]
        of_bag = place / f"of_{way}"
        shutil.rmtree(of_bag, ignore_errors=True)
        typed("import", place / way, "-o", of_bag, "--ros2", place / "topics.toml", *there)
        (of_bag / "scenario.toml").write_text(folder_scenario(source), "utf-8")
        return of_data_set(with_options(load(of_bag / "scenario.toml"), dataset=of_bag))
    if way == "log":
        driven = next(each for each in ("rmw", "bridge") if (place / f"{each}.map.json").exists())
        log = next((place / f"run_{driven}").glob("out/**/*.mcap"))
        return of_data_set(imported(log, place / "of_log"))
    text = folder_scenario(source).replace('kind = "folder"', 'kind = "live"')
    text = text.replace('path = "."\n', "").replace(f'name = "{source.name}"', 'name = "live"')
    (place / "live.toml").write_text(text, "utf-8")
    return of_log(live(way, place, speed, at))


def main() -> int:
    if sys.argv[1] == "--publish":
        publish(sys.argv[2], Path(sys.argv[3]), int(sys.argv[4]), float(sys.argv[5]))
        return 0
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data_set", type=Path)
    parser.add_argument("--seconds", type=float, default=240.0, help="of the set; 0: all of it")
    parser.add_argument("--speed", type=float, default=8.0, help="of the live ones")
    parser.add_argument("--keep", type=Path)
    parser.add_argument("--only", nargs="*", default=[*EXACT, *BY_POINTS])
    options = parser.parse_args()
    source = with_options(load("utias"), dataset=options.data_set)
    if options.seconds:
        world = msgspec.structs.replace(source.world, duration_s=options.seconds)
        source = msgspec.structs.replace(source, world=world)
    maps: dict[str, tuple[bytes, bytes, bytes]] = {}
    with contextlib.ExitStack() as stack:
        place = options.keep or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        place.mkdir(parents=True, exist_ok=True)
        for way in (*EXACT, *BY_POINTS):
            kept = place / f"{way}.map.json"
            if way in options.only:
                began = time.monotonic()
                found = one(way, source, place.resolve(), options.speed)
                kept.write_text(json.dumps([part.hex() for part in found]))
                print(f"{way}: {time.monotonic() - began:.0f} s", flush=True)
            if kept.exists():
                ids, means, covariance = map(bytes.fromhex, json.loads(kept.read_text()))
                maps[way] = ids, means, covariance
    return int(not judged(maps))


def judged(maps: dict[str, tuple[bytes, bytes, bytes]]) -> bool:
    right = True
    zero = maps.get("zip")
    for group in (EXACT, BY_POINTS):
        there = [way for way in group if way in maps]
        for way in there:
            equal = maps[way] == maps[there[0]]
            right &= equal
            line = f"{way:6} {hashlib.sha256(b''.join(maps[way])).hexdigest()[:12]}"
            line += f" {len(maps[way][0]) // 4} landmarks"
            if way != there[0]:
                line += f", equal to {there[0]}'s" if equal else f", NOT {there[0]}'s"
            if zero is not None and way != "zip":
                line += f"; from zip's: {apart(maps[way], zero)}"
            print(line)
    return right


def apart(one: tuple[bytes, bytes, bytes], other: tuple[bytes, bytes, bytes]) -> str:
    if one[0] != other[0]:
        return "other landmarks"
    means, covariances = (
        float(np.abs(np.frombuffer(a, "<f8") - np.frombuffer(b, "<f8")).max())
        for a, b in zip(one[1:], other[1:], strict=True)
    )
    return f"means {means:.2g} m, covariances {covariances:.2g}"


if __name__ == "__main__":
    sys.exit(main())
