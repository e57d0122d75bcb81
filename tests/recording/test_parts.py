import os
import random
import resource
import threading
import time
from pathlib import Path

import msgspec
import pytest
from mcap.opcode import Opcode

from teamslam.sim.scenarios.scenario import dumps, load
from teamslam.team.recording.check import check_log, holes
from teamslam.team.recording.editing import merge, read_undamaged
from teamslam.team.recording.inventory import Inventory
from teamslam.team.recording.parts import check_continues, join_parts, next_part, own_log
from teamslam.team.recording.reader import LogError, open_log, part_of, parts_of
from teamslam.team.recording.recorder import Recorder, RecorderError
from teamslam.team.recording.records import read_frames
from teamslam.team.recording.shell import RecordLoop
from teamslam.team.wire import channels as c, messages as m
from teamslam.team.wire.bus import MemoryBus, MemoryNetwork, Outgoing, Sample
from teamslam.team.wire.codec import decoded, encoded
from teamslam.team.wire.zenoh.bus import ZenohBus
from teamslam.team.wire.zenoh.router import router
from tests import build
from tests.commands import output_of, run
from tests.recording.test_shell import FINAL, POSE, Team, logged
from tests.support import odometry, received, submap, wait_until


def killed_part(path: Path, samples: list[Sample]) -> Path:
    """Write samples to the log's next part, whose recorder never completes it."""
    recorder, _ = next_part(path, "t", {"scenario": "s"})
    recorder.write(samples)
    wait_until(lambda: logged(recorder.path, c.ODOMETRY) == len(samples))
    return recorder.path


def test_a_recorder_that_is_killed_and_started_again_has_the_whole_run(path):
    with router() as at, ZenohBus("t", at) as source:
        team = Team(source)
        source.declare_alive("robot/alpha")
        source.watch_alive("recorder")
        team.says(50)
        first = ZenohBus("t", at)
        killed = RecordLoop(first, Recorder(path, "t", {"scenario": "s"}), ())
        received(source, 1)
        wait_until(lambda: bool(killed.take(first.receive(0.02)) or logged(path, c.ODOMETRY) >= 0))
        team.says(50)

        def flushed() -> bool:
            killed.take(first.receive(0.02))
            return logged(path, c.ODOMETRY) == 50 and logged(path, c.OWN_POSE) == 10

        wait_until(flushed)
        first.close()  # and nothing is completed
        team.says(60)
        assert check_continues(path, "t", {"scenario": "s"})
        recorder, inventory = next_part(path, "t", {"scenario": "s"})
        second = ZenohBus("t", at)
        loop, stop = RecordLoop(second, recorder, (), inventory), threading.Event()
        thread = threading.Thread(target=loop.run, args=(stop,))
        thread.start()
        part = part_of(path, 2)
        team.says(10)
        team.ends(lambda: logged(part, c.ODOMETRY) == 120 and logged(part, c.OWN_POSE) == 7)
        thread.join(60.0)
        second.close()
    assert parts_of(path) == [path, part]
    assert join_parts(path) == [path]
    log = open_log(path)
    assert log.complete
    measurements = [decoded(s.payload, m.Odometry) for s in log.samples([c.ODOMETRY])]
    assert sorted(measurements, key=lambda x: x.number) == team.published
    assert sorted(s.counter for s in log.samples([c.OWN_POSE])) == list(range(17))
    assert holes(log) == []


def samples_of(count: int) -> list[Sample]:
    return [
        Sample(c.ODOMETRY.key("alpha"), encoded(odometry(i)), i, 10**18 + i, i)
        for i in range(count)
    ]


@pytest.mark.parametrize("wrong", ["another scenario", "finished", "no log", "old"])
def test_a_log_that_is_not_of_this_run_is_not_continued(wrong, path, monkeypatch):
    if wrong == "no log":
        path.write_bytes(b"my thesis")
    elif wrong == "finished":
        final_part(path, 1, [])
    else:
        killed_part(path, samples_of(1))
    if wrong == "old":
        monkeypatch.setattr("teamslam.team.recording.parts.LONGEST_AWAY_S", -1.0)
    scenario = "another" if wrong == "another scenario" else "s"
    with pytest.raises(LogError, match=r"exists.*choose another name or remove it"):
        check_continues(path, "t", {"scenario": scenario})


def final_part(path: Path, part: int, samples: list[Sample], final: str = "central/final") -> None:
    recorder, _ = next_part(path, "t", {"scenario": "s"})
    with recorder:
        recorder.write([*samples, Sample(final, encoded(FINAL), 0, 0, 0)])
    assert recorder.path == part_of(path, part)


def in_two_parts(path: Path) -> None:
    killed_part(path, samples_of(10)[:5])
    final_part(path, 2, samples_of(10)[5:])


def numbers(path: Path) -> list[int]:
    return [decoded(s.payload, m.Odometry).number for s in open_log(path).samples([c.ODOMETRY])]


def test_the_parts_of_a_log_are_read_as_one(path):
    in_two_parts(path)
    assert numbers(path) == list(range(10))
    log = open_log(path)
    assert log.complete
    assert len(log.files) == 2
    assert not [each for each in check_log(log) if each.where == "file"]


def test_a_robots_final_map_ends_the_log_of_a_team_without_a_centre_only(path: Path) -> None:
    final_part(path, 1, [], c.TEAM_FINAL.key("r1"))
    assert check_continues(path, "t", {"scenario": "s"})
    with pytest.raises(LogError, match="exists, with the final map of its run"):
        check_continues(path, "t", {"scenario": "s"}, ends=(c.FINAL_MAP, c.TEAM_FINAL))


@pytest.mark.parametrize("removed", [0, 1])
def test_a_joining_that_was_killed_while_it_removed_the_parts_adds_nothing_twice(
    path, removed, monkeypatch
):
    killed_part(path, samples_of(10)[:3])
    killed_part(path, samples_of(10)[3:6])
    final_part(path, 3, samples_of(10)[6:])
    unlink = Path.unlink
    died = []

    def dies(self: Path, missing_ok: bool = False) -> None:
        if ".part" in self.name:
            if len(died) == removed:
                raise KeyboardInterrupt
            died.append(self)
        unlink(self, missing_ok)

    with monkeypatch.context() as patched:
        patched.setattr(Path, "unlink", dies)
        with pytest.raises(KeyboardInterrupt):
            join_parts(path)
    assert len(list(path.parent.iterdir())) == 3 - removed
    assert numbers(path) == list(range(10)), "what was joined is not read from its part"
    assert not check_continues(path, "t", {"scenario": "s"})
    assert join_parts(path) == [path]
    assert numbers(path) == list(range(10))
    assert list(path.parent.iterdir()) == [path]


def test_a_part_of_another_log_is_neither_read_nor_joined_nor_removed(path):
    in_two_parts(path)
    path.unlink()  # and its second part stays
    killed_part(path, samples_of(3))
    assert numbers(path) == [0, 1, 2]
    final_part(path, 3, samples_of(4)[3:])
    assert join_parts(path) == [path]
    assert numbers(path) == [0, 1, 2, 3]
    assert part_of(path, 2).exists()


@pytest.mark.parametrize("step_s", [0.0, 7200.0])
def test_a_clock_that_was_set_makes_no_log_another_run_s(path, step_s, monkeypatch):
    before = time.time
    with monkeypatch.context() as wrong:  # two hours behind, until the network told the time
        wrong.setattr(time, "time", lambda: before() - step_s)
        killed_part(path, samples_of(1))
    old_s = before() - 7200.0
    os.utime(path, (old_s, old_s))
    if step_s:
        assert check_continues(path, "t", {"scenario": "s"})
    else:
        with pytest.raises(LogError, match=r"2\.0 hours ago.*--resume"):
            check_continues(path, "t", {"scenario": "s"})
        assert check_continues(path, "t", {"scenario": "s"}, same_run=True)


def test_a_recorder_started_after_the_end_completes_the_joining_and_ends_well(path):
    scenario = "thesis"
    text = dumps(load(scenario))
    team = load(scenario).team
    final = encoded(msgspec.structs.replace(FINAL, lost=(), withdrawn=()))
    for samples in (samples_of(10)[:5], samples_of(10)[5:]):
        recorder, _ = next_part(path, team, {"scenario": text})
        with recorder:
            recorder.write(samples)
            if samples[0].counter:
                recorder.write([Sample("central/final", final, 0, 0, 0)])
    command = ["record", scenario, "--output", str(path)]
    output_of(*command)
    assert parts_of(path) == [path]
    assert numbers(path) == list(range(10))
    assert run(*command, "--resume").exit_code == 0
    refused = run(*command)
    assert refused.exit_code == 2, "this may be another run: nothing of it would be recorded"


@pytest.fixture
def limit():
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    yield lambda size: resource.setrlimit(resource.RLIMIT_FSIZE, (soft if size < 0 else size, hard))
    resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_a_full_disk_ends_no_run_and_the_log_goes_on_when_there_is_room(
    path, limit, monkeypatch, caplog
):
    monkeypatch.setattr("teamslam.team.recording.shell._RETRY_S", 0.0)
    network = MemoryNetwork()
    bus, world = MemoryBus(network), MemoryBus(network)

    def answer(request: bytes) -> list[bytes]:
        wanted = decoded(request, m.MeasurementsRequest)
        return [encoded(odometry(i)) for i in range(wanted.first, wanted.last + 1)]

    world.answer(c.MEASUREMENTS, "alpha", answer)
    recorder, inventory = next_part(path, "t", {})
    room = False

    def more() -> tuple[Recorder, Inventory]:
        if not room:
            raise RecorderError("the disk is full")
        return next_part(path, "t", {})

    loop = RecordLoop(bus, recorder, (), inventory, more)
    limit(path.stat().st_size + 20_000)
    said = 0

    def stopped() -> bool:
        nonlocal said
        for _ in range(100):
            world.publish(Outgoing(c.ODOMETRY, "alpha", odometry(said)))
            world.publish(Outgoing(c.OWN_POSE, "alpha", POSE))
            said += 1
        loop.take(bus.receive())
        loop.request_missing(0.0)
        return any("nothing is recorded" in each for each in loop.status().warnings)

    wait_until(stopped)
    assert "nothing is recorded any more" in caplog.text
    limit(-1)
    assert logged(path, c.OWN_POSE) < said, "what was written reads"
    room = True
    world.publish(Outgoing(c.END, "", build.end(incarnation=0, alpha=said)))
    for now_s in (1e9, 2e9, 3e9):
        loop.request_missing(now_s)
        loop.take(bus.receive())
    loop.close()
    assert join_parts(path) == [path]
    log = open_log(path)
    assert logged(path, c.ODOMETRY) == logged(path, c.OWN_POSE) == said
    assert holes(log) == []


def test_a_disk_that_stays_full_is_an_error_at_the_end(path):
    network = MemoryNetwork()
    stop = threading.Event()
    stop.set()
    recorder = Recorder(path, "t", {})
    recorder._failure = OSError("No space left on device")

    def more() -> tuple[Recorder, Inventory]:
        raise RecorderError("the disk is full")

    with pytest.raises(RecorderError, match="No space left"):
        RecordLoop(MemoryBus(network), recorder, (), None, more).run(stop)


def test_what_a_bus_sends_and_receives_is_in_its_own_log_and_merged_there_once(tmp_path):
    paths = [tmp_path / "a.mcap", tmp_path / "b.mcap"]
    with (
        router() as at, own_log(paths[0], "t") as a, own_log(paths[1], "t") as b,
        ZenohBus("t", at) as robot, ZenohBus("t", at) as centre,
    ):  # fmt: skip
        robot.tap, centre.tap = a, b
        centre.subscribe(c.SUBMAP)
        for i in range(5):
            robot.publish(Outgoing(c.SUBMAP, "alpha", submap(i)))
            robot.publish(Outgoing(c.ODOMETRY, "alpha", odometry(i)))
        received(centre, 5)
    submaps, measurements = c.SUBMAP.key("alpha"), c.ODOMETRY.key("alpha")
    found = [{k: n for k, (n, _) in open_log(path).counts().items()} for path in paths]
    assert found == [{submaps: 5, measurements: 5}, {submaps: 5}]
    merged = merge([open_log(path) for path in paths], tmp_path / "whole.mcap")
    assert merged == (10, 5)


def test_what_a_robot_has_asked_for_is_in_its_own_log_and_what_a_death_cost_it_is_known(tmp_path):
    """A restarted robot fetches measurements from its source, which its log must contain."""
    path = tmp_path / "a.mcap"
    with router() as at, own_log(path, "t") as log, ZenohBus("t", at) as source:
        source.answer(c.MEASUREMENTS, "alpha", lambda _: [encoded(odometry(i)) for i in (1, 2, 5)])
        answering = threading.Event()
        thread = threading.Thread(target=lambda: answers(source, answering))
        thread.start()
        with ZenohBus("t", at) as robot:
            robot.tap = log
            wanted = build.measurements_request(robot="alpha", first=1, last=5)
            for _ in range(2):
                assert len(robot.ask(c.MEASUREMENTS, "alpha", wanted, 10.0)) == 3
        answering.set()
        thread.join()
        assert [(first, last) for _, first, last in log.lost("alpha")] == [(0, 0), (3, 4)]
        assert log.lost("bravo") == []
    assert {k: n for k, (n, _) in open_log(path).counts().items()} == {c.ODOMETRY.key("alpha"): 3}


def answers(bus: ZenohBus, until: threading.Event) -> None:
    while not until.is_set():
        bus.receive(0.05)


SECOND = 10**9
RATE = 40


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    path = tmp_path_factory.mktemp("flips") / "log.mcap"
    samples = [
        Sample(channel.key("alpha"), encoded(message(i)), i, 10**18 + i * SECOND // rate, i)
        for channel, message, rate in ((c.ODOMETRY, odometry, RATE), (c.SUBMAP, submap, 2))
        for i in range(20 * rate)
    ]
    with Recorder(path, "t", {"scenario": "s"}) as recorder:
        recorder.write(samples)
    return path.read_bytes(), samples


def saved(path: Path) -> list[Sample]:
    return list(read_undamaged(open_log(path), []))


def heads(path: Path) -> list[int]:
    """Positions of the opcodes and lengths of chunks and of their indices."""
    with path.open("rb") as file:
        kinds = (Opcode.CHUNK, Opcode.MESSAGE_INDEX)
        offsets = [frame.offset for frame in read_frames(file, path) if frame.opcode in kinds]
    return [offset + k for offset in offsets for k in range(9)]


@pytest.mark.parametrize("where", ["anywhere", "in the heads of records"])
def test_a_flipped_bit_costs_a_second_of_recorded_time_at_the_most(where, recorded, tmp_path):
    data, samples = recorded
    path = tmp_path / "flipped.mcap"
    path.write_bytes(data)
    with path.open("rb") as file:
        first = next(f.offset for f in read_frames(file, path) if f.opcode == Opcode.CHUNK)
    places = list(range(first, len(data))) if where == "anywhere" else heads(path)
    rng = random.Random(3)
    losses = 0
    for place in rng.sample(places, 60):
        flipped = bytearray(data)
        flipped[place] ^= 1 << rng.randrange(8)
        path.write_bytes(flipped)
        there = set(saved(path))
        lost = [s for s in samples if s not in there]
        losses += bool(lost)
        regular = [s.wall_ns for s in lost if "odometry" in s.key]
        assert max(regular, default=0) - min(regular, default=0) <= SECOND, f"bit at {place}"
        assert len(lost) <= RATE, f"bit at {place}"
    assert losses, "a flip that costs nothing at all shows nothing"
