import json
import re
from dataclasses import asdict
from pathlib import Path

import msgspec
import numpy as np
import pytest

from teamslam.central.desk.ledger import Ledger, Rejected, ledger
from teamslam.central.desk.verification.recorded import index_log
from teamslam.team.rejection import Rejection
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.arrays import from_floats, from_ids
from teamslam.team.wire.bus import Sample
from tests.commands import output_of
from tests.sim.recorded.test_rerun import restless
from tests.sim.reruns import changed, messages, said, team_samples, thesis, written

STEPS = 60
DOCS = Path(__file__).parents[3] / "docs"


@pytest.fixture(scope="module")
def samples():
    return team_samples(thesis(STEPS))


def ledger_of(samples: list[Sample], folder: Path) -> Ledger:
    return ledger(index_log(written(folder / "log.mcap", samples)))


def submap_changed(samples: list[Sample], sequence: int, **fields: int) -> list[Sample]:
    def change(message: m.Message) -> m.Message:
        hit = (message.robot, message.sequence) == ("r1", sequence)
        return msgspec.structs.replace(message, **fields) if hit else message

    return changed(samples, ch.SUBMAP, change)


def test_a_good_log_disposes_of_each_measurement_once(samples, tmp_path):
    found = ledger_of(samples, tmp_path)
    assert found.offenders == ()
    (end,) = messages(samples, ch.END)
    assert found.measurements == sum(s.measurements for s in end.streams)
    assert sum(found.totals().values()) == found.measurements
    for robot in ("r1", "r2"):
        (done,) = messages(samples, ch.ROBOT_DONE, robot)
        assert found.totals(robot) == {d.disposition: d.measurements for d in done.ledger}
    words = f"each of {found.measurements} measurements has exactly one disposition"
    assert words in found.statement()


def test_a_robots_false_word_is_named(samples, tmp_path):
    def lie(done: m.Message) -> m.Message:
        ledger = tuple(
            m.Disposition(disposition=d.disposition, measurements=d.measurements + 1)
            for d in done.ledger
        )
        return msgspec.structs.replace(done, ledger=ledger) if done.robot == "r2" else done

    offenders = ledger_of(changed(samples, ch.ROBOT_DONE, lie), tmp_path).offenders
    assert len(offenders) == 2
    assert all(offender.startswith("r2, incarnation 1") for offender in offenders)


def test_a_dead_robots_last_measurements_are_open_or_lost(tmp_path):
    found = ledger_of(said(restless(2, dies=True)), tmp_path)
    assert found.offenders == ()
    lost = found.totals("r1")
    assert lost.get("open", 0) + lost.get("lost", 0) > 0
    assert not found.totals("r2").keys() & {"open", "lost"}


@pytest.mark.parametrize("cache", [None, 0])
def test_restarts_and_new_incarnations_use_no_measurement_twice(cache, tmp_path):
    assert ledger_of(said(restless(1, cache=cache)), tmp_path).offenders == ()


def test_the_command_ends_with_1_and_names_a_measurement_in_two_submaps(samples, tmp_path):
    good = written(tmp_path / "good.mcap", samples)
    assert "exactly one disposition" in output_of("verify-ledger", good.path)
    counter = messages(samples, ch.SUBMAP, "r1")[1].first_measurement - 1
    bad = written(tmp_path / "bad.mcap", submap_changed(samples, 1, first_measurement=counter))
    said = " ".join(output_of("verify-ledger", bad.path, status=1).split())
    assert f"measurement {counter} of r1, incarnation 1 is in two submaps: 0 and 1" in said


def with_far_landmarks(samples: list[Sample]) -> tuple[list[Sample], m.Observations]:
    scan = messages(samples, ch.OBSERVATIONS, "r1")[5]
    far = msgspec.structs.replace(
        scan,
        ids=from_ids(np.array([3, 7], np.uint32)),
        ranges=from_floats(np.full(2, 1e7)),
        bearings=from_floats(np.zeros(2)),
        covariances=b"",
    )
    return changed(samples, ch.OBSERVATIONS, lambda each: far if each == scan else each), far


def test_each_rejected_measurement_is_listed_with_stamp_landmarks_and_reason(
    samples, tmp_path, monkeypatch
):
    of, far = with_far_landmarks(samples)
    log = written(tmp_path / "log.mcap", of)
    found = ledger(index_log(log))
    reason, stamp_s = "a range beyond the bounds", far.stamp_ns / 1e9
    assert [each for each in found.rejected if each.landmarks] == [
        Rejected("r1", 1, far.number, stamp_s, "observations", (3, 7), (), reason)
    ]
    sightings = {
        (s.robot, s.number) for r in ("r1", "r2") for s in messages(samples, ch.SIGHTINGS, r)
    }
    no_nodes = [each for each in found.rejected if each.kind == "sightings"]
    assert {(each.robot, each.number) for each in no_nodes} == sightings
    assert {each.reason for each in no_nodes} == {Rejection.NO_NODES.value}
    assert {each.teammates for each in no_nodes} == {("r1",), ("r2",)}
    out = tmp_path / "ledger.json"
    monkeypatch.setenv("COLUMNS", "120")
    said = output_of("verify-ledger", log.path, "--list", "--json", out, status=1)
    (row,) = (line for line in said.splitlines() if " observations " in line)
    words = ["r1", str(far.number), f"{stamp_s:.3f}", "observations", "3", "7", *reason.split()]
    assert row.split() == words
    listed = json.loads(out.read_text("utf-8"))["rejected"]
    assert listed == [
        {**asdict(each), "landmarks": [*each.landmarks], "teammates": [*each.teammates]}
        for each in found.rejected
    ]


def test_the_outliers_of_a_window_are_counted_by_submap(samples, tmp_path):
    of = submap_changed(samples, 1, gated=5)
    (found,) = ledger_of(of, tmp_path).outliers
    assert (found.robot, found.submap, found.detections) == ("r1", 1, 5)
    assert found.start_s < found.stamp_s


def test_the_page_explains_each_reason():
    page = (DOCS / "report.md").read_text("utf-8").partition("## Rejected measurements")[2]
    explained = re.findall(r"^\| (.+?) \|", page, re.MULTILINE)[1:]
    assert explained == [each.value for each in Rejection]
