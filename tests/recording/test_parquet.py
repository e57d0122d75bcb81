import json
import sys

import msgspec
import numpy as np
import pytest

from teamslam.sim.cli import log as cli_log
from teamslam.team.recording.tables import ParquetTable, export_tables, numbers_of, table_of
from teamslam.team.wire import channels as c, messages as m
from teamslam.team.wire.bus import Sample
from tests.commands import output_of
from tests.recording.logs import recorded, recorded_examples, sampled
from tests.support import odometry

pq = pytest.importorskip("pyarrow.parquet", reason="pip install '.[parquet]'")


def test_every_field_of_every_message_reads_back(tmp_path):
    kept = recorded_examples()
    samples = [sample for _, _, sample in kept]
    samples.append(Sample(samples[0].key, b"\x90", 0, 0, 99))
    exported = export_tables(
        recorded(tmp_path / "log.mcap", samples), tmp_path / "out", form=ParquetTable
    )
    assert exported.unsound == 1
    assert len(exported.rows) == len({table_of(of, x) for of, x, _ in kept})
    for i, (channel, message, sample) in enumerate(kept):
        table = pq.read_table(tmp_path / "out" / f"{table_of(channel, message)}.parquet")
        (row,) = [r for r in table.to_pylist() if r["counter"] == i]
        assert row["key"] == sample.key
        assert row["wall_ns"] == sample.wall_ns
        for field in msgspec.structs.fields(message):
            value, back = getattr(message, field.name), row[field.name]
            if isinstance(value, bytes) and field.type == m.Digest:
                assert back == value.hex()
            elif isinstance(value, bytes):
                assert np.array_equal(back, numbers_of(message, field.name))
            elif isinstance(value, tuple | dict | msgspec.Struct):
                assert json.loads(back) == json.loads(msgspec.json.encode(value))
            else:
                assert back == value
                assert type(back) is type(value)


def test_without_pyarrow_the_command_says_what_to_install(tmp_path, monkeypatch):
    log = recorded(tmp_path / "log.mcap", [sampled(c.ODOMETRY, "alpha", odometry(1), 1)]).path
    command = ["log", "export", str(log), "-o", str(tmp_path / "out"), "--format", "parquet"]
    monkeypatch.setattr(cli_log, "find_spec", lambda name: None)
    refused = output_of(*command, status=2)
    assert f"{sys.executable} -m pip install 'pyarrow>=18'" in refused
    monkeypatch.undo()
    done = output_of(*command)
    assert "odometry.parquet: 1 row\n" in done
