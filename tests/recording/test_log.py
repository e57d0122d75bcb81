import hashlib
import struct
import subprocess
import sys
from pathlib import Path

import pytest
import zstandard
from hypothesis import given, settings, strategies as st
from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer

from teamslam.team import core
from teamslam.team.recording.editing import repair_log
from teamslam.team.recording.provenance import estimation_digest, provenance
from teamslam.team.recording.reader import LARGEST_CHUNK, DamagedChunkError, Log, LogError, open_log
from teamslam.team.recording.recorder import Recorder, RecorderError
from teamslam.team.wire import channels as c
from teamslam.team.wire.bus import Sample, opened
from tests import build
from tests.recording.logs import recorded, recorded_examples, sampled
from tests.support import ROOT, odometry, submap, wait_until


def stream(count: int) -> list[Sample]:
    return [
        sampled(c.SUBMAP, robot, submap(i, robot), i)
        if i % 10 == 9
        else sampled(c.ODOMETRY, robot, odometry(i, robot), i)
        for i in range(count)
        for robot in ("alpha", "bravo")
    ]


def test_every_recorded_message_comes_back_sound(path):
    log = recorded(path, [sample for _, _, sample in recorded_examples()])
    assert [opened(one)[2] for one in log.samples()] == [x for _, x, _ in recorded_examples()]


@settings(deadline=None, max_examples=40)
@given(
    st.lists(
        st.builds(
            Sample,
            st.sampled_from(["view/scene", "source/alpha/odometry", "central/map"]),
            st.binary(max_size=60),
            st.integers(1, 2**62 - 1),
            st.integers(0, 2**63 - 1),
            st.integers(0, 2**32 - 1),
        )
    )
)
def test_any_bytes_are_kept_as_they_came(tmp_path_factory, samples):
    path = tmp_path_factory.mktemp("any") / "log.mcap"
    assert list(recorded(path, samples).samples()) == samples


def test_a_stamp_before_zero_comes_back_as_it_was(path):
    samples = [
        sampled(c.ODOMETRY, "alpha", build.odometry(stamp_ns=stamp, robot="alpha"))
        for stamp in (-(2**62), -5, 0, 5)
    ]
    log = recorded(path, samples[::-1])
    assert list(log.samples()) == samples[::-1]
    assert sorted(log.samples(), key=lambda s: s.stamp_ns) == samples


def test_metadata_names_team_and_provenance(path):
    log = recorded(path, [], seed="7", **provenance())
    assert log.team == "t"
    assert log.metadata["seed"] == "7"
    assert log.metadata["core"] == core.digest[:16]
    assert log.metadata["estimation"] == estimation_digest()
    for name in ("version.numpy", "version.eclipse-zenoh", "core.level", "cpu.name", "git.commit"):
        assert log.metadata[name]


def test_a_recorder_never_overwrites_and_names_a_missing_folder_and_a_full_disk(path, monkeypatch):
    recorded(path, stream(1))
    with pytest.raises(RecorderError, match=r"log\.mcap exists: choose another name"):
        Recorder(path, "t", {})
    with pytest.raises(RecorderError, match="No such file or directory; choose another place"):
        Recorder(path.parent / "nowhere" / "log.mcap", "t", {})
    monkeypatch.setattr(Path, "open", lambda self, mode: open("/dev/full", "wb"))  # noqa: SIM115 - the recorder closes it
    with pytest.raises(RecorderError, match="No space left on device; choose another place"):
        Recorder(path.parent / "full.mcap", "t", {})


def test_a_log_is_found_by_the_folder_of_its_run(tmp_path):
    recorded(tmp_path / "log.mcap", stream(10))
    assert open_log(tmp_path).path == tmp_path / "log.mcap"
    with pytest.raises(LogError, match=r"log\.mcap: not found; give the path .* folder of its run"):
        open_log(tmp_path.parent)


def test_a_full_disk_is_told_at_the_next_call_and_nothing_hangs(path):
    program = (
        "import resource; from tests.recording.test_log import stream\n"
        "from teamslam.team.recording.recorder import Recorder, RecorderError\n"
        "from tests.support import wait_until\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, 50_000))\n"
        f"recorder = Recorder({str(path)!r}, 't', {{}})\n"
        "def failed():\n"
        "    try: recorder.write(stream(5_000))\n"
        "    except RecorderError as error: return 'File too large' in str(error)\n"
        "wait_until(failed)\n"
        "recorder.close()"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 1
    assert done.stderr.rstrip().endswith("what was flushed before can be repaired")


def killed(path: Path, count: int) -> Log:
    program = (
        "import sys, threading; from pathlib import Path\n"
        "from teamslam.team.recording.recorder import Recorder\n"
        "from tests.recording.test_log import stream\n"
        f"recorder = Recorder(Path({str(path)!r}), 't', {{'seed': '7'}})\n"
        f"recorder.write(stream({count})); print('ready', flush=True); sys.stdin.read()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", program], cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as child:
        assert child.stdout.readline() == b"ready\n"
        wait_until(lambda: len(list(open_log(path).samples())) == 2 * count, what="the flush")
        child.kill()
    return open_log(path)


def test_a_killed_recorders_log_is_read_and_repaired(path, tmp_path):
    log = killed(path, 500)
    assert not log.complete
    assert list(log.samples()) == stream(500)
    out = tmp_path / "repaired.mcap"
    report = repair_log(path, out)
    assert report == (1_000, stream(500)[-1].stamp_ns, ())
    again = open_log(out)
    assert again.complete
    assert (again.team, again.metadata) == ("t", {"seed": "7", "repaired": path.name})
    assert list(again.samples()) == stream(500)


def chunks_of(path: Path) -> list[tuple[int, int]]:
    """(offset, length) of each chunk record."""
    data = path.read_bytes()
    found, offset = [], len(MCAP0_MAGIC)
    while offset < len(data) - len(MCAP0_MAGIC):
        opcode, length = struct.unpack_from("<BQ", data, offset)
        if opcode == Opcode.CHUNK:
            found.append((offset, 9 + length))
        offset += 9 + length
    return found


@pytest.fixture(scope="module")
def noise():
    return [
        Sample("view/noise", hashlib.shake_128(b"%d" % i).digest(40_000), i + 1, 0, i)
        for i in range(100)
    ]


def test_a_flipped_bit_is_named_and_the_other_chunks_are_saved(path, tmp_path, noise):
    recorded(path, noise)
    first, *rest = chunks_of(path)
    data = bytearray(path.read_bytes())
    data[first[0] + first[1] // 2] ^= 1
    path.write_bytes(data)
    with pytest.raises(DamagedChunkError, match=f"damaged chunk at offset {first[0]}: .*repair"):
        list(open_log(path).samples())
    report = repair_log(path, tmp_path / "out.mcap")
    saved = list(open_log(tmp_path / "out.mcap").samples())
    assert len(rest) >= 2
    assert len(report.damaged) == 1
    assert saved == noise[-len(saved) :]
    assert 0 < report.messages == len(saved) < len(noise)


@pytest.mark.parametrize("part", [0.3, 0.6, 0.9, 0.999])
def test_a_truncated_log_reads_up_to_its_last_whole_chunk(path, noise, part):
    recorded(path, noise)
    data = path.read_bytes()
    whole = sum(offset + length <= part * len(data) for offset, length in chunks_of(path))
    path.write_bytes(data[: int(part * len(data))])
    log = open_log(path)
    read = list(log.samples())
    assert not log.complete
    assert read == noise[: len(read)]
    assert len(list(log.chunks())) == whole


def test_a_damaged_index_does_not_keep_the_samples_away(path):
    recorded(path, stream(60))
    data = path.read_bytes()
    end = sum(chunks_of(path)[-1])
    footer = len(data) - 37
    path.write_bytes(data[:end] + b"\xff" * (footer - end) + data[footer:])
    with pytest.raises(LogError, match="ends before its own index"):
        list(open_log(path).samples())
    out = path.with_name("out.mcap")
    assert repair_log(path, out).messages == 120
    assert list(open_log(out).samples()) == stream(60)


def foreign(path: Path) -> None:
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        writer.finish()


def bomb(path: Path, size: int, claimed: int) -> None:
    """A log with one chunk that expands to `size` bytes and claims `claimed`."""
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.NONE)
        writer.start()
        writer.add_metadata("teamslam", {"team": "t"})
        packed = zstandard.compress(bytes(size))
        head = struct.pack("<QQQII", 0, 0, claimed, 0, 4) + b"zstd" + struct.pack("<Q", len(packed))
        file.write(struct.pack("<BQ", Opcode.CHUNK, len(head) + len(packed)) + head + packed)
        writer.finish()


@pytest.mark.parametrize(
    ("make", "told"),
    [
        (lambda path: None, "not found; give the path of a log"),
        (lambda path: path.write_bytes(b""), "empty file; its recorder was stopped"),
        (lambda path: path.write_bytes(b"hello, world"), "not an MCAP file; give a log"),
        (foreign, "an MCAP file of another program"),
        (lambda path: path.write_bytes(MCAP0_MAGIC), "an MCAP file of another program"),
        (lambda path: bomb(path, 2**29, 2**29), f"claim to expand to {2**29}"),
        (lambda path: bomb(path, 2**26, 2**26), f"claim to expand to {2**26}"),
        (lambda path: bomb(path, 2**26, 1_000), "two different sizes are claimed"),
    ],
)
def test_what_is_no_sound_log_is_refused_with_a_remedy(path, make, told):
    make(path)
    with pytest.raises(LogError, match=f"{path}: .*{told}"):
        list(open_log(path).samples())


def test_a_record_longer_than_any_of_ours_is_refused_unread(path):
    recorded(path, stream(1))
    data = path.read_bytes()
    head = data[: chunks_of(path)[0][0]]
    with path.open("wb") as file:
        file.write(head + struct.pack("<BQ", Opcode.CHUNK, LARGEST_CHUNK + 1))
        file.truncate(LARGEST_CHUNK + 2**20)
    with pytest.raises(LogError, match=f"record of {LARGEST_CHUNK + 1} bytes"):
        list(open_log(path).samples())
