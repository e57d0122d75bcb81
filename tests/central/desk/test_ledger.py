from pathlib import Path

import msgspec
import pytest
from typer.testing import CliRunner

from teamslam.central.desk.ledger import Ledger, ledger
from teamslam.central.desk.verification.recorded import index_log
from teamslam.sim.cli.rerun import app
from teamslam.team.wire import channels as ch
from teamslam.team.wire import messages as m
from teamslam.team.wire.bus import Sample
from tests.sim.recorded.test_rerun import restless
from tests.sim.reruns import changed, messages, said, team_samples, thesis, written

STEPS = 60


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
    assert (
        f"each of {found.measurements} measurements has exactly one disposition"
        in found.statement()
    )


def test_a_measurement_in_two_submaps_is_named(samples, tmp_path):
    second = messages(samples, ch.SUBMAP, "r1")[1]
    twice = submap_changed(samples, 1, first_measurement=second.first_measurement - 1)
    (offender,) = ledger_of(twice, tmp_path).offenders
    counter = second.first_measurement - 1
    assert offender == f"measurement {counter} of r1, incarnation 1 is in two submaps: 0 and 1"


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


def test_the_command_ends_with_1_and_names_the_offender(samples, tmp_path):
    good = written(tmp_path / "good.mcap", samples)
    runner = CliRunner()
    proof = runner.invoke(app, ["verify-ledger", str(good.path)])
    assert proof.exit_code == 0, proof.output
    assert "exactly one disposition" in proof.output
    second = messages(samples, ch.SUBMAP, "r1")[1]
    bad = submap_changed(samples, 1, first_measurement=second.first_measurement - 1)
    path = written(tmp_path / "bad.mcap", bad).path
    result = runner.invoke(app, ["verify-ledger", str(path)])
    assert result.exit_code == 1
    assert "is in two submaps: 0 and 1" in result.output
