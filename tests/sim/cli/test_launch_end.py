import errno
import os

import pytest
from click.exceptions import Exit

from teamslam.central.desk.evaluation.evaluation import evaluate
from teamslam.central.desk.evaluation.history import history
from teamslam.central.desk.report import page
from teamslam.central.desk.report.run import Run
from teamslam.sim.cli import launch
from teamslam.sim.in_memory.team import run_team
from teamslam.sim.launch.launch import Outcome
from teamslam.sim.scenarios.scenario import dumps
from teamslam.team.recording.recorder import Recorder
from teamslam.team.wire import channels as ch
from tests import commands
from tests.scenarios import with_world
from tests.sim.logs import scenario, streams


def test_a_launch_that_is_interrupted_as_it_is_scored_says_where_the_log_is_and_leaves_no_half_file(
    tmp_path, monkeypatch
):
    log, figures = tmp_path / "run" / "log.mcap", tmp_path / "figures.json"
    outcome = Outcome(log=log, folder=log.parent, wall_s=1.0, processes=[])

    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(launch, "_launch", lambda *_: outcome)
    monkeypatch.setattr(launch, "_conclude", interrupted)
    words = ["launch", "thesis", "-o", str(log.parent), "--json", str(figures)]
    ended = commands.run(*words)
    assert ended.exit_code == 130, ended.output
    assert f"interrupted: the run is in {log}" in ended.stderr
    assert not figures.exists()


def test_a_full_disk_leaves_the_runs_figures_and_says_how_the_report_is_made_elsewhere(
    tmp_path, monkeypatch
):
    outcome = Outcome(log=tmp_path / "log.mcap", folder=tmp_path, wall_s=1.0, processes=[])

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(page, "write_report", full)
    run = Run(evaluate([]), history([]), {})
    launch._write_report(run, outcome, {})
    (failure,) = outcome.failures
    assert failure == (
        f"{tmp_path}: can not write the report: No space left on device; "
        f"`teamslam report {outcome.log} -o FOLDER` makes it elsewhere"
    )


@pytest.mark.parametrize("lost", ["nothing", "a measurement", "the final map"])
def test_a_router_killed_as_the_run_ends_is_a_note_where_map_and_log_are_whole(
    lost, tmp_path, capsys
):
    of = scenario()
    samples = list(run_team(of, streams(of)))
    key = {"a measurement": ch.ODOMETRY.key("r1"), "the final map": ch.FINAL_MAP.key()}.get(lost)
    without = next((n for n, sample in enumerate(samples) if sample.key == key), None)
    log = tmp_path / "log.mcap"
    with Recorder(log, of.team, {"scenario": dumps(of)}) as recorder:
        recorder.write([sample for n, sample in enumerate(samples) if n != without])
    death = "router (pid 7) was ended by SIGKILL"
    outcome = Outcome(log=log, folder=tmp_path, wall_s=1.0, processes=[], deaths=[death])
    if lost == "nothing":
        launch._conclude(outcome, None, report=False)
        assert f"note: {death}; map and log are whole" in capsys.readouterr().out
        assert outcome.failures == []
    else:
        with pytest.raises(Exit) as ended:
            launch._conclude(outcome, None, report=False)
        assert ended.value.exit_code == 1
        assert death in outcome.failures


def test_a_run_whose_map_has_no_landmark_fails_with_the_reason(tmp_path):
    of = scenario()
    of = with_world(of, landmark_count=0, landmarks=())
    log = tmp_path / "log.mcap"
    with Recorder(log, of.team, {"scenario": dumps(of)}) as recorder:
        recorder.write(list(run_team(of, streams(of))))
    outcome = Outcome(log=log, folder=tmp_path, wall_s=1.0, processes=[])
    with pytest.raises(Exit) as ended:
        launch._conclude(outcome, None, report=False)
    assert ended.value.exit_code == 1
    assert [each for each in outcome.failures if "the final map has no landmark" in each]
    again = commands.output_of("rerun", log, "--noise", "bearing=2", status=1)
    assert "the final map has no landmark" in again
