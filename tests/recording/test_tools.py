import contextlib
import csv
import json
import struct
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from mcap.writer import MCAP0_MAGIC, Writer

from teamslam.team.recording.check import DRAWN, Counters, check_log, find_misdeclaration
from teamslam.team.recording.editing import MERGED, cut, merge, summarise_log
from teamslam.team.recording.reader import Log, LogError, open_log
from teamslam.team.recording.recorder import Recorder, schema_of
from teamslam.team.recording.tables import export_tables, table_of
from teamslam.team.wire import channels as c, messages as m
from teamslam.team.wire.arrays import from_derivatives, from_floats, from_ids
from teamslam.team.wire.bus import NO_COUNTER, Sample
from teamslam.team.wire.codec import encoded
from tests import build
from tests.recording.logs import recorded, recorded_examples, sampled
from tests.recording.test_log import chunks_of
from tests.support import odometry, submap

SECOND = 10**9


def drive(robot: str, seconds: int) -> list[Sample]:
    out = [sampled(c.ROBOT_CONFIG, robot, build.configuration(node=f"robot/{robot}"), 0)]
    for i in range(10 * seconds):
        stamp = 100 * SECOND + i * SECOND // 10
        driven = build.odometry(stamp_ns=stamp, robot=robot, number=i, duration_ns=SECOND // 10)
        out.append(sampled(c.ODOMETRY, robot, driven, i))
        if i % 10 == 9:
            times = {"stamp_ns": stamp, "start_ns": stamp - SECOND}
            said = msgspec.structs.replace(submap(i // 10, robot), **times)
            out.append(sampled(c.SUBMAP, robot, said, i // 10))
    return out


def status(counter: int, wall_s: float = 0, node: str = "central", **fields: object) -> Sample:
    sample = sampled(c.STATUS, node, build.status(node=node, **fields), counter)
    return msgspec.structs.replace(sample, wall_ns=10**18 + round(wall_s * SECOND) + counter)


def later(samples: list[Sample], **fields: object) -> list[Sample]:
    return [msgspec.structs.replace(s, wall_ns=s.wall_ns + SECOND, **fields) for s in samples]


def found(log: Log) -> list[str]:
    return [str(finding) for finding in check_log(log)]


@pytest.fixture
def whole(path):
    samples = sorted([*drive("alpha", 6), *drive("bravo", 6)], key=lambda s: s.stamp_ns)
    return recorded(path, samples, seed="7")


# Check.


ONE, TWO = drive("alpha", 1), drive("alpha", 2)
END = sampled(c.END, "", build.end(alpha=10), 0)
DONE = sampled(c.ROBOT_DONE, "alpha", build.done(robot="alpha", measurements=10, steps=2), 0)
MORE = [
    sampled(c.END, "", build.end(alpha=12), 0),
    sampled(c.ROBOT_DONE, "alpha", build.done(robot="alpha", incarnation=0, submaps=3), 0),
    msgspec.structs.replace(
        sampled(
            c.TALLY, "robot/alpha",
            build.tally(node="robot/alpha", since_ns=10**18,
                        keys=("robot/alpha/done", "robot/alpha/team/pose"), counts=(1, 4)), 0,
        ),
        wall_ns=10**18 + 100,
    ),
]  # fmt: skip
"""The counts of others: more measurements, submaps and poses than the log has."""
OTHER = sampled(
    c.ODOMETRY, "alpha", build.odometry(stamp_ns=100 * SECOND, robot="alpha", number=3), 10
)
SWAPPED = [*ONE[:2], ONE[5], *ONE[3:5], ONE[2], *ONE[6:]]
ALIVE = [
    sampled(c.ALIVE, "central", build.liveliness(node="central", alive=up), 0)
    for up in (True, False)
]
FIRST_LOST = "source/alpha: 5 measurements of incarnation 1 missing: 0–4"
NO_END = "world/end: missing: the number of measurements is unknown"
TWO_LOST = [s for s in TWO if s.counter not in (3, 4, 8) or "odometry" not in s.key]
FOUND: dict[str, tuple[list[Sample], list[str]]] = {
    "nothing": (TWO, []),
    "lost messages": (TWO_LOST, ["source/alpha: 3 measurements of incarnation 1 missing: 3–4, 8"]),
    "a recorder that came late": (TWO[6:], [FIRST_LOST]),
    "a publisher that starts again": (ONE + later(ONE), []),
    "a publisher that starts again, first messages lost": (
        [status(0), status(1), status(2), *later([status(2)])],
        ["central/status: 2 messages missing: 0–1"],
    ),
    "counts of others": (
        ONE + MORE,
        [
            "robot/alpha/team/pose: 4 messages missing: 0–3",
            "source/alpha: 2 measurements of incarnation 1 missing: 10–11",
            "robot/alpha/submap: 2 submaps of incarnation 0 missing: 1–2",
        ],
    ),
    "no end of the streams": ([*ONE, DONE], [NO_END]),
    "the end of the streams": ([*ONE, DONE, END], []),
    "measurements that came as replies": (
        [
            later([s], counter=NO_COUNTER)[0] if s.counter in (2, 3) else s
            for s in drive("alpha", 5)
        ],
        [],
    ),
    "a measurement twice, with other contents": (
        [*ONE, OTHER],
        ["source/alpha: 1 measurements of incarnation 1 present twice with different contents"],
    ),
    "the last words of the recorder": (
        [*ONE, status(0, node="recorder", warnings=("missing: robot/alpha/team/pose: 7",))],
        ["recorder: missing: robot/alpha/team/pose: 7"],
    ),
    "the recorder's words on a key that is named already, and views last": (
        [
            *(msgspec.structs.replace(status(k), key="view/log") for k in (0, 2)),
            *TWO_LOST,
            status(0, node="recorder", warnings=("missing: view/log: 1", "missing: view/map: 3")),
        ],
        [
            "source/alpha: 3 measurements of incarnation 1 missing: 3–4, 8",
            f"view/log: 1 message missing: 1{DRAWN}",
            "recorder: missing: view/map: 3",
        ],
    ),
    "tokens and the recorder's own status": ([*ALIVE, status(4, node="recorder")], []),
    "the first statuses": ([status(4)], ["central/status: 4 messages missing: 0–3"]),
    "one late and one twice": (
        [*SWAPPED, SWAPPED[-2]],
        ["source/alpha/odometry: 1 message twice, the first is 9"],
    ),
    "views": (
        [msgspec.structs.replace(status(k), key="view/log") for k in (0, 2)],
        ["view/log: 1 message missing: 1; `teamslam view LOG --export NEW` draws all views again"],
    ),
}


@pytest.mark.parametrize("case", FOUND)
def test_the_check_names_every_loss_and_nothing_else(path, case):
    samples, expected = FOUND[case]
    assert found(recorded(path, samples)) == expected


@pytest.mark.parametrize("samples", [TWO[6:], [*ONE, DONE]], ids=["beginning", "end"])
def test_a_cut_log_lacks_nothing_outside_of_its_cut(path, samples):
    assert found(recorded(path, samples, cut="said")) == []


def test_a_process_without_a_last_word_is_named(path):
    """A killed robot's second life reports its totals; those of the first are unknown."""

    node = "robot/alpha"

    def tally(since_s: int, until_s: int, count: int) -> Sample:
        since_ns, until_ns = (10**18 + s * SECOND for s in (since_s, until_s))
        said = build.tally(node=node, since_ns=since_ns, keys=(f"{node}/status",), counts=(count,))
        return msgspec.structs.replace(sampled(c.TALLY, node, said, 0), wall_ns=until_ns)

    first = [status(k, 10 + k, node, stamp_ns=k * SECOND) for k in range(3)]
    second = [status(k, 20 + k, node, stamp_ns=k * SECOND) for k in range(2)]
    last = tally(19, 23, 2)
    (named,) = found(recorded(path, [*first, *second, last]))
    assert named.startswith("robot/alpha/tally: the process with messages until 2.0 s announced")
    both = [*first, *second, tally(9, 13, 3), last]
    assert found(recorded(path.with_name("both.mcap"), both)) == []
    assert found(recorded(path.with_name("memory.mcap"), first)) == []


def missing(samples: list[Sample]) -> int:
    counters = Counters()
    for sample in samples:
        counters.take(sample)
    counted = [line.split(" missing")[0].split()[0] for line in counters.findings(part=False)]
    return sum(map(int, counted))


kept_of_lives = st.lists(st.sets(st.integers(1, 30), max_size=12), min_size=1, max_size=4)


def lost_of(lives: list[set[int]]) -> int:
    return sum(max(kept, default=0) - len(kept) for kept in lives)


@settings(deadline=None, max_examples=150)
@given(kept_of_lives, st.randoms())
def test_in_any_order_of_arrival_as_many_are_missing_as_were_lost(lives, rng):
    samples = [
        Sample("source/alpha/odometry", b"", 0, 1_000 * life + counter, counter)
        for life, kept in enumerate(lives)
        for counter in (0, *rng.sample(sorted(kept), len(kept)))
    ]
    assert missing(samples) == lost_of(lives)


@settings(deadline=None, max_examples=300)
@given(kept_of_lives, st.integers(0, 60), st.integers(-100, 100))
def test_wherever_a_clock_is_set_as_many_are_missing_as_were_lost(lives, after, seconds):
    """A message a second, in the order of arrival; each life is identified by its message 0."""
    said = [(life, n) for life, kept in enumerate(lives) for n in sorted({0, *kept})]
    samples = [
        Sample(
            "robot/alpha/status", b"", 0, (40 * life + n - (k >= after) * seconds) * SECOND + k, n
        )
        for k, (life, n) in enumerate(said)
    ]
    assert missing(samples) == lost_of(lives)


def test_a_publication_that_came_as_a_reply_is_not_missing():
    """Without its counter it is one of those published, no matter which."""
    counters = Counters()
    counters.take(Sample("central/final", b"", 0, 5, NO_COUNTER))
    assert counters.findings(part=False, totals=(1,)) == []
    assert counters.findings(part=False, totals=(2,)) == ["2 messages missing: 0–1"]


def flip(path: Path, offset: int) -> None:
    data = bytearray(path.read_bytes())
    data[offset] ^= 1
    path.write_bytes(data)


def test_a_flipped_bit_is_found_in_a_chunk_and_in_the_index(whole):
    (offset, length), *_ = chunks_of(whole.path)
    flip(whole.path, offset + length - 5)
    assert found(whole)[0].startswith(f"file: damaged chunk at offset {offset}")
    flip(whole.path, offset + length - 5)
    size = whole.path.stat().st_size
    start = struct.unpack_from("<Q", whole.path.read_bytes(), size - len(MCAP0_MAGIC) - 20)[0]
    flip(whole.path, (start + size) // 2)
    assert "file: the CRC of its index does not match" in found(whole)


@pytest.fixture(scope="module")
def once_recorded(tmp_path_factory):
    """The bytes of one log, since another recorder may end chunks elsewhere, by the clock."""
    path = tmp_path_factory.mktemp("once") / "log.mcap"
    return recorded(path, drive("alpha", 2)).path.read_bytes()


@settings(deadline=None, max_examples=120)
@given(st.data())
def test_a_damaged_log_is_told_of_and_never_a_crash(tmp_path_factory, once_recorded, data):
    path = tmp_path_factory.getbasetemp() / "checked.mcap"
    damaged = bytearray(once_recorded)
    for _ in range(data.draw(st.integers(1, 4))):
        damaged[data.draw(st.integers(0, len(damaged) - 1))] = data.draw(st.integers(0, 255))
    path.write_bytes(damaged[: data.draw(st.integers(len(damaged) // 2, len(damaged)))])
    with contextlib.suppress(LogError):
        log = open_log(path)
        lines = found(log)
        assert not summarise_log(log).damaged or lines
        assert log.complete or lines


def foreign(path: Path, key: str, encoding: str, schema: str, text: bytes) -> Log:
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        writer.add_metadata("teamslam", {"team": "t"})
        number = writer.register_schema(schema, "jsonschema", text)
        writer.register_channel(f"team/t/{key}", encoding, number)
        writer.finish()
    return open_log(path)


SHORTER = json.loads(schema_of(m.Submap))
SHORTER["$defs"]["Submap"]["prefixItems"][-2:] = []
OTHER = schema_of(m.Submap).replace(b'"integer"', b'"number"')


@pytest.mark.parametrize(
    ("key", "encoding", "schema", "text", "told"),
    [
        ("robot/r1/submap", "msgpack", "submap/1", schema_of(m.Submap), None),
        ("robot/r1/submap", "msgpack", "submap/1", json.dumps(SHORTER).encode(), None),
        ("robot/r1/submap", "msgpack", "submap/1", OTHER, "its schema is not that of submap/1"),
        ("robot/r1/submap", "msgpack", "submap/1", b"[", "its schema is not that of submap/1"),
        ("robot/r1/submap", "msgpack", "submap/2", b"{}", "declared as msgpack, submap/2; its"),
        ("robot/r1/submap", "json", "submap/1", b"{}", "declared as json, submap/1; its messages"),
        ("robot/r1/banana", "msgpack", "submap/1", b"{}", "no channel has this key"),
        ("view/scene", "protobuf", "foxglove.SceneUpdate", b"", None),
    ],
)
def test_a_schema_is_held_against_its_channel(path, key, encoding, schema, text, told):
    log = foreign(path, key, encoding, schema, text)
    assert not list(log.samples())
    found = find_misdeclaration(key, log.declared[key])
    assert found is None if told is None else found is not None and found.startswith(told)


# Cut and merge.


@settings(deadline=None, max_examples=15)
@given(st.integers(-SECOND, 7 * SECOND))
def test_two_parts_of_a_log_merge_to_the_log_in_time_order(tmp_path_factory, at_ns):
    folder = tmp_path_factory.mktemp("parts")
    log = recorded(folder / "log.mcap", [*drive("bravo", 6), *drive("alpha", 6)])
    parts = []
    for name, bounds in (("a", (None, at_ns / SECOND)), ("b", (at_ns / SECOND, None))):
        try:
            cut(log, folder / f"{name}.mcap", *bounds)
        except LogError:  # nothing in it
            assert not 0 < at_ns <= 59 * SECOND // 10
        else:
            parts.append(open_log(folder / f"{name}.mcap"))
            stamps = [s.stamp_ns - 100 * SECOND for s in parts[-1].samples([c.ODOMETRY])]
            assert all((stamp < at_ns) == (name == "a") or stamp == at_ns for stamp in stamps)
    merged = merge(parts, folder / "m.mcap")
    again = open_log(folder / "m.mcap")
    assert list(again.samples()) == sorted(log.samples(), key=lambda s: s.stamp_ns)
    assert merged.duplicates == (2 if len(parts) == 2 else 0)  # configurations hold in both
    assert [line for part in [*parts, again] for line in found(part)] == []


def test_robots_own_logs_merge_once_and_stably(tmp_path):
    a = recorded(tmp_path / "a.mcap", drive("alpha", 3), seed="7", host="x")
    b = recorded(tmp_path / "b.mcap", [*drive("alpha", 1), *drive("bravo", 3)], seed="7", host="y")
    merged = merge([a, b], tmp_path / "m.mcap")
    log = open_log(tmp_path / "m.mcap")
    both = [*drive("alpha", 3), *drive("bravo", 3)]
    assert list(log.samples()) == sorted(both, key=lambda s: s.stamp_ns)
    assert merged == (len(both), len(drive("alpha", 1)))
    assert log.metadata == {
        "seed": "7", "host@a.mcap": "x", "host@b.mcap": "y", MERGED: "a.mcap, b.mcap",
    }  # fmt: skip


def test_damage_is_told_before_a_new_log_is_made_and_logs_of_two_teams_are_not_merged(
    whole, tmp_path
):
    with Recorder(tmp_path / "u.mcap", "u", {}) as recorder:
        recorder.write(drive("alpha", 1))
    with pytest.raises(LogError, match=r"u\.mcap: a log of team 'u', not 't' as .*log\.mcap is"):
        merge([whole, open_log(tmp_path / "u.mcap")], tmp_path / "a.mcap")
    (offset, length), *_ = chunks_of(whole.path)
    flip(whole.path, offset + length - 5)
    with pytest.raises(LogError, match=r"damaged chunk .* log repair` saves the rest"):
        cut(whole, tmp_path / "a.mcap", 1.0)
    with pytest.raises(LogError, match="damaged chunk"):
        merge([whole], tmp_path / "a.mcap")
    assert not (tmp_path / "a.mcap").exists()


# CSV.


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


@pytest.mark.parametrize("write", [from_derivatives, from_floats], ids=["float32", "float64"])
def test_a_submaps_derivatives_are_exported_at_the_width_that_they_have(write, tmp_path):
    sensitivity, curvature = np.arange(14) / 8.0, np.arange(7) / 4.0
    message = msgspec.structs.replace(
        submap(0),
        biases=("bearing", "clock_offset"),
        sensitivity=write(sensitivity),
        curvature=write(curvature),
    )
    export_tables(
        recorded(tmp_path / "log.mcap", [sampled(c.SUBMAP, "alpha", message)]), tmp_path / "out"
    )
    (row,) = rows_of(tmp_path / "out" / "submap.csv")
    assert [float(word) for word in row["sensitivity"].split()] == sensitivity.tolist()
    assert [float(word) for word in row["curvature"].split()] == curvature.tolist()


@settings(deadline=None, max_examples=25)
@given(
    st.lists(
        st.tuples(st.integers(0, 2**31 - 1), st.floats(0, 1e9), st.floats(-3.14, 3.14)), max_size=5
    )
)
def test_numbers_read_back_from_csv_are_the_same(tmp_path_factory, seen):
    folder = tmp_path_factory.mktemp("csv")
    fields = dict(zip(("ids", "ranges", "bearings"), zip(*seen, strict=True), strict=False))
    message = build.observations(stamp_ns=5, robot="alpha", number=9, **fields)
    log = recorded(folder / "log.mcap", [sampled(c.OBSERVATIONS, "alpha", message, 3)])
    export_tables(log, folder / "out")
    (row,) = rows_of(folder / "out" / "observations.csv")
    assert (row["key"], row["counter"], row["number"]) == ("source/alpha/observations", "3", "9")
    for name, kind in zip(fields, (int, float, float), strict=False):
        back = [kind(word) for word in row[name].split()]
        assert (from_ids if kind is int else from_floats)(back) == getattr(message, name)


def test_every_channel_becomes_a_table_and_what_is_unsound_is_counted(tmp_path):
    kept = recorded_examples()
    samples = [sample for _, _, sample in kept]
    samples.append(msgspec.structs.replace(samples[0], payload=b"\x90"))
    samples.append(Sample("view/scene", b"?", 0, 0, 0))
    exported = export_tables(recorded(tmp_path / "log.mcap", samples), tmp_path / "out")
    assert exported.unsound == 1
    assert {path.stem for path in exported.rows} == {table_of(of, x) for of, x, _ in kept}
    for path, count in exported.rows.items():
        rows = rows_of(path)
        assert len(rows) == count
        assert list(rows[0])[:3] == ["key", "counter", "wall_ns"]


def test_unsound_messages_are_counted_and_the_first_is_explained(path):
    samples = drive("alpha", 1)
    samples[3] = msgspec.structs.replace(samples[3], payload=samples[3].payload[:-1])
    samples[4] = msgspec.structs.replace(samples[4], payload=encoded(odometry(4, "bravo")))
    samples[5] = msgspec.structs.replace(samples[5], stamp_ns=5)
    *_, line = found(recorded(path, samples))
    assert line.startswith("source/alpha/odometry: 3 unsound, the first: message 2: truncated")
    samples[3:5] = drive("alpha", 1)[3:5]
    (line,) = found(recorded(path.with_name("b.mcap"), samples))
    assert line.endswith("message 4: logged at 5 ns, of 100400000000 ns")
