import json
import re
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from teamslam.central.desk.evaluation.evaluation import evaluate
from teamslam.central.desk.evaluation.figures import to_json
from teamslam.central.desk.evaluation.history import history
from teamslam.central.desk.report import page as report_page
from teamslam.central.desk.report.page import write_report
from teamslam.central.desk.report.run import Run, run_figures
from teamslam.team import translate
from teamslam.team.recording.recorder import Recorder
from teamslam.team.wire import channels as ch
from teamslam.team.wire.bus import Sample, opened
from tests import commands
from tests.sim.logs import final_map, joined_log, scenario, streams, world_log

PICTURES = ["map", "errors", "consistency"]


def run_of(log: list[Sample], **metadata: str) -> Run:
    return Run(evaluate(log), history(log), metadata)


def page_of(run: Run, folder: Path) -> str:
    figures = to_json(run.evaluation, run_figures(run))
    return write_report(run, folder, figures)[0].read_text("utf-8")


@pytest.fixture(scope="module")
def log(log):
    """With times of arrival."""
    return [
        msgspec.structs.replace(sample, wall_ns=(k + 1) * 1_000_000) for k, sample in enumerate(log)
    ]


@pytest.fixture
def _without_pictures(monkeypatch):
    monkeypatch.setattr(report_page, "write_pictures", lambda *_: {})


def test_it_is_one_page_that_needs_nothing_else(log, tmp_path):
    run = replace(run_of(log, **{"seed": "1", "version.teamslam": "0.0.7"}), command="teamslam <x>")
    paths = write_report(run, tmp_path / "new", to_json(run.evaluation, run_figures(run)))
    names = [path.name for path in paths]
    tables = ["report.html", "report.json", "map.csv", "map.json"]
    assert names == [*tables, *(f"{p}.png" for p in PICTURES), "trajectories"]
    page = paths[0].read_text("utf-8")
    assert page.count("data:image/svg+xml;base64,") == len(PICTURES)
    assert not re.findall(r'(?:src|href)="(?!data:|#)', page)
    made = re.search(
        r"Recorded on ([\d-]+ [\d:]+ UTC) by teamslam 0.0.7; report of (20.*); (.*)</p>", page
    )
    assert made is not None
    assert (made[1], made[3]) == ("1970-01-01 00:00 UTC", "teamslam &lt;x&gt;")
    targets = set(re.findall(r'href="#(\w+)"', page))
    assert targets == set(re.findall(r'<h2 id="(\w+)"', page))
    assert {"consistency", "latency", "events", "traffic"} <= targets
    assert '<meta name="viewport" content="width=device-width' in page
    figures = json.loads(paths[1].read_text("utf-8"))
    assert figures["landmarks"] == 8
    assert set(figures["nis_per_dof"]) == {"r1", "r2"}
    assert figures["trajectories"]["r1"]["online"]["poses"] > 5
    assert figures["bytes_per_s"][ch.SUBMAP.key("r1")] > 0.0


def test_what_a_log_says_can_not_become_markup(log, tmp_path):
    run = run_of(log, commit="<b>", long="<i>" * 100)
    bad = "<script>alert(1)</script> [red]x[/nothing]"
    evaluation = replace(run.evaluation, notes=(bad,))
    events = tuple(replace(event, text=bad, node=bad) for event in run.history.events[:1])
    hostile = replace(
        run, evaluation=evaluation, history=replace(run.history, events=events), no_ledger=bad
    )
    page = page_of(hostile, tmp_path)
    assert not re.search("<script|<b>|<i>", page)
    assert "<td>&lt;b&gt;</td>" in page


@pytest.mark.usefixtures("_without_pictures")
def test_the_page_says_where_its_times_start_on_the_clock_of_the_texts(log, tmp_path):
    run = run_of(log)
    note = "of the clock that the texts give"
    assert note not in page_of(run, tmp_path)
    later = replace(run.history, start_ns=1_000 * 10**9)
    assert f"from the start, 1,000.0 s {note}" in page_of(replace(run, history=later), tmp_path)


def test_without_truth_there_are_the_monitor_and_nis(log, tmp_path):
    blind = [s for s in log if not s.key.startswith("truth")]
    run = run_of(blind)
    page = page_of(run, tmp_path)
    assert 'id="consistency"' in page
    assert 'id="paths"' not in page
    assert (tmp_path / "consistency.png").exists()
    assert not (tmp_path / "errors.png").exists()
    assert {path.name for path in (tmp_path / "trajectories").iterdir()} == {
        f"{robot}.{kind}.tum" for robot in ("r1", "r2") for kind in ("smoothed", "online")
    }


@pytest.mark.parametrize("count", [0, 1, 30])
def test_a_log_that_stops_anywhere_is_reported(count, tmp_path):
    page = page_of(run_of(world_log(scenario())[:count]), tmp_path)
    assert "did not finish" in page


def written(log: list[Sample], path: Path) -> Path:
    with Recorder(path, "small", {"seed": "1"}) as recorder:
        recorder.write(log)
    return path


@pytest.mark.usefixtures("_without_pictures")
def test_the_command_proves_the_ledger_and_says_so(log, tmp_path):
    file = written(log, tmp_path / "log.mcap")
    done = commands.output_of("report", file, "-o", tmp_path / "out")
    assert "has exactly one disposition" in done
    assert re.search(r"^NIS per dof: r1 [\d.]+, r2 [\d.]+$", done, re.MULTILINE)
    page = (tmp_path / "out" / "report.html").read_text("utf-8")
    assert re.search(r'class="good">Ledger: each of \d+ measurements has exactly one', page)
    figures = json.loads((tmp_path / "out" / "report.json").read_text("utf-8"))
    assert figures["ledger"]["offenders"] == []
    assert figures["provenance"] == {"seed": "1"}


@pytest.mark.usefixtures("_without_pictures")
def test_a_log_that_lacks_what_the_ledger_needs_names_it_beside_the_run_or_in_a_folder(tmp_path):
    file = written(joined_log(scenario(), 0.1), tmp_path / "log.mcap")
    commands.output_of("report", file, "-o", tmp_path / "out")
    page = (tmp_path / "out" / "report.html").read_text("utf-8")
    assert "the log has no configuration of robot/r1" in page
    beside = commands.output_of("report", file, "--no-ledger")
    assert f"wrote {tmp_path / 'report.html'}" in beside.replace("\n", "")
    other = file.rename(tmp_path / "other.mcap")
    commands.output_of("report", other, "--no-ledger")
    assert (tmp_path / "other" / "report.html").is_file()
    assert "give a folder" in commands.output_of("report", other, "-o", other, status=2)


# The history.


@pytest.fixture(scope="module")
def found(log):
    return history(log)


def test_nis_is_what_the_robots_said_of_their_windows(found, log):
    said = [opened(s)[2] for s in log if s.key == ch.INNOVATION.key("r1")]
    submaps = [opened(s)[2] for s in log if s.key == ch.SUBMAP.key("r1")]
    of_r1 = found.innovations["r1"]
    assert of_r1.stamps_ns.tolist() == [s.stamp_ns for s in submaps]
    assert of_r1.per_dof == sum(i.squared for i in said) / sum(i.dof for i in said)
    assert of_r1.dof.sum() > 50
    resumed = history([*log, *(s for s in log if s.key == ch.INNOVATION.key("r1"))])
    assert resumed.innovations["r1"].per_dof == of_r1.per_dof


def test_the_cost_and_the_nees_are_those_of_each_map(found, log):
    keys = (ch.FUSED_MAP.key(), ch.FINAL_MAP.key())
    maps = [opened(s)[2] for s in log if s.key in keys]
    assert len(found.map_cost.values) == len([x for x in maps if x.dof])
    assert found.map_cost.values[-1] == maps[-1].chi2 / maps[-1].dof
    ids, means = translate.landmarks_of(maps[-1])
    world = streams(scenario(robots=2))
    true = dict(zip(world.landmark_ids.tolist(), world.landmarks, strict=True))
    errors = [mean - true[i] for i, mean in zip(ids.tolist(), means, strict=True)]
    e, P = np.concatenate(errors), translate.landmark_covariance_of(maps[-1])
    assert maps[-1].joint
    assert found.map_nees.values[-1] == pytest.approx(e @ np.linalg.solve(P, e) / len(e))
    assert (np.diff(found.map_nees.stamps_ns) >= 0).all()


def test_without_truth_there_is_the_cost_and_no_nees():
    of = scenario()
    hidden = (ch.TRUTH.key("r1"), ch.TRUTH_LANDMARKS.key())
    blind = history([s for s in joined_log(of, 0.1) if s.key not in hidden])
    assert len(blind.map_nees.values) == 0
    assert blind.map_cost.values.tolist() == [1.5]
    assert final_map([1], np.zeros((1, 2)), np.eye(2)).message.dof == 20
