import msgspec
import pytest
from click.testing import CliRunner

from teamslam.central.desk.evaluation.evaluation import add_holes, evaluate
from teamslam.sim.cli.commands import WRONG_USE
from teamslam.sim.cli.main import app
from teamslam.sim.datasets.tables import DatasetError
from teamslam.sim.datasets.utias import write_utias
from teamslam.team.recording.check import NO_FINAL, holes
from teamslam.team.recording.reader import LogError, open_log
from teamslam.team.recording.recorder import Recorder
from teamslam.team.wire.bus import Sample, opened
from teamslam.team.wire.codec import encoded
from tests import build, commands
from tests.sim.logs import scenario, streams, world_log


def run(*arguments: object) -> tuple[int, str, str]:
    result = CliRunner().invoke(app, ["log", *map(str, arguments)], env={"COLUMNS": "80"})
    if isinstance(result.exception, LogError):
        return WRONG_USE, result.stdout, f"error: {result.exception}"
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    return result.exit_code, result.stdout, result.stderr


def published() -> list[Sample]:
    counts: dict[str, int] = {}
    samples = []
    for sample in world_log(scenario(robots=2)):
        count = counts[sample.key] = counts.get(sample.key, -1) + 1
        samples.append(msgspec.structs.replace(sample, counter=count, wall_ns=count))
    return samples


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    path = tmp_path_factory.mktemp("logs") / "log.mcap"
    with Recorder(path, "small", {"seed": "1", "note": "x" * 200 + "\n\x1b[2J[bold]"}) as recorder:
        recorder.write(published())
    return path


@pytest.mark.parametrize("options", [(), ("--keys",)])
def test_info_names_each_key_and_sends_no_control_sequence_to_the_terminal(log, options):
    status, out, _ = run("info", log, *options)
    lines = [line for line in out.splitlines() if str(log) not in line]
    assert status == 0
    assert "\x1b" not in out
    assert "team small, complete: " in out
    assert [line for line in lines if line.startswith("note: xxx")]
    assert ("source/r1/odometry" if options else "odometry") in out


def test_check_ends_with_1_and_a_line_for_each_finding(log, tmp_path):
    assert run("check", log)[:2] == (0, f"{log}: nothing wrong\n")
    lost = tmp_path / "lost.mcap"
    with Recorder(lost, "small", {}) as recorder:
        recorder.write([s for s in published() if s.counter != 3])
    status, out, _ = run("check", lost)
    assert status == 1
    info = run("info", lost)
    assert "team small, not whole: " in info[1]
    assert "is not whole, source/r1: 2 measurements of incarnation 1 missing: 7–8" in info[2]
    stream = "source/r1: 2 measurements of incarnation 1 missing: 7–8"
    assert {stream, "truth/r1: 1 message missing: 3"} <= set(out.splitlines())
    assert all(" missing: " in line for line in out.splitlines())


def test_a_log_that_is_cut_off_is_repaired(log, tmp_path):
    (tmp_path / "cut.mcap").write_bytes(log.read_bytes()[:-100])
    assert run("check", tmp_path / "cut.mcap")[0] == 1
    assert run("repair", tmp_path / "cut.mcap", "-o", tmp_path / "whole.mcap")[0] == 0
    status, out, _ = run("check", tmp_path / "whole.mcap")
    assert (status, out) == (1, f"file: {NO_FINAL}\n")  # the rest after the cut is unknown
    assert list(open_log(tmp_path / "whole.mcap").samples()) == published()


def test_the_exported_data_set_is_the_one_that_the_world_would_write(log, tmp_path):
    write_utias(streams(scenario(robots=2)), tmp_path / "world")
    status, out, _ = run("export", log, "--format", "utias", "-o", tmp_path / "log")
    assert status == 0
    assert "Robot2_*.dat: r2" in out
    names = sorted(path.name for path in (tmp_path / "world").iterdir())
    assert names == sorted(path.name for path in (tmp_path / "log").iterdir())
    for name in names:
        assert (tmp_path / "log" / name).read_bytes() == (tmp_path / "world" / name).read_bytes()


def test_a_log_that_the_format_of_utias_does_not_hold_is_refused_with_the_remedy(tmp_path):
    own = [s for s in published() if s.key.startswith("source/r1")]
    start, first = (next(s for s in own if opened(s)[2].number == k) for k in (0, 1))
    step = build.increment(stamp_ns=first.stamp_ns, number=1, increment=[1.0, 0.0, 0.1])
    moved = {"key": "source/r1/odometry", "payload": encoded(step)}
    for samples, *words in (
        (own, "it has sightings of r2 but not their measurements; `teamslam log merge`"),
        (
            [s for s in own if s.counter != 3 and "sight" not in s.key],
            "r1: odometry intervals are not contiguous in time: one ends",
            "the format needs measurements without gaps",
        ),
        (
            [start, msgspec.structs.replace(first, **moved)],
            "it has odometry as motions, which the format does not have",
            "-o FOLDER`",
        ),
    ):
        log = tmp_path / f"{len(samples)}.mcap"
        with Recorder(log, "small", {}) as recorder:
            recorder.write(samples)
        status, _, err = run("export", log, "--format", "utias", "-o", tmp_path / "out")
        assert status == 2
        assert [each for each in (f"{log.name}: ", *words) if each not in err] == []


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["info", "nowhere.mcap"], "nowhere.mcap: not found; give the path of a log"),
        (["check", "."], "log.mcap: not found; give the path of a log that was recorded, or of"),
        (["cut", "LOG", "-o", "LOG"], "exists: choose another name or remove it"),
        (["cut", "LOG", "-o", "new", "--from", "5", "--to", "5"], "the first before the second"),
        (["cut", "LOG", "-o", "new", "--from", "nan"], "give seconds"),
        (["cut", "LOG", "-o", "new", "--from", "50"], "its measurements are from 0 to 20.000 s"),
        (["cut", "LOG", "-o", "new", "--channels", "odo"], "no channel 'odo'; there are start, "),
        (["merge", "LOG", "nowhere.mcap", "-o", "new"], "nowhere.mcap: not found"),
        (["merge", "LOG", "-o", "LOG"], "exists: choose another name"),
        (["export", "LOG", "-o", "LOG/.."], "not an empty folder: give a new one"),
        (["export", "LOG", "-o", "new", "--format", "excel"], "'excel' is not one of"),
        (
            ["export", "LOG", "-o", "new", "--format", "utias", "--channels", "start"],
            "--channels is for tables",
        ),
    ],
)
def test_what_a_user_gets_wrong_ends_with_2_and_leaves_nothing(
    log, monkeypatch, tmp_path, arguments, told
):
    monkeypatch.chdir(tmp_path)
    given = [
        log.parent if each == "LOG/.." else log if each == "LOG" else each for each in arguments
    ]
    status, _, err = run(*given)
    assert status == 2
    assert told in " ".join(err.split())
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "words",
    [
        ("verify-ledger",),
        ("rerun", "--verify"),
        ("rerun",),
        ("calibrate",),
        ("batch-reference",),
        ("compare", "hole.mcap"),
        ("log", "export", "--output", "tables"),
        ("report", "--output", "report"),
        ("import", "--output", "set"),
        ("view", "--layout", "layout.json"),
        ("log", "cut", "--output", "cut.mcap"),
        ("log", "merge", "--output", "merged.mcap", "hole.mcap"),
    ],
)
def test_a_log_with_a_hole_says_so_in_every_command(tmp_path, monkeypatch, words):
    monkeypatch.chdir(tmp_path)
    with Recorder(tmp_path / "hole.mcap", "small", {"seed": "1"}) as recorder:
        lost = [s for s in published() if s.key == "source/r2/odometry"][5:8]
        recorder.write([sample for sample in published() if sample not in lost])
    result = commands.run(*words, "hole.mcap")
    failed = result.exception
    assert failed is None or isinstance(failed, SystemExit | LogError | DatasetError)
    said = " ".join(f"{result.stdout} {result.stderr} {failed}".split())
    assert "not whole, source/r2: 3 measurements of incarnation 1 missing" in said


def test_chosen_channels_are_exported_as_csv(log, tmp_path):
    status, out, _ = run("export", log, "-o", tmp_path / "out", "--channels", "odometry, truth")
    assert status == 0
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        "odometry.csv", "truth.csv",
    ]  # fmt: skip
    assert "odometry.csv: 40 rows" in out


def test_a_run_with_many_gaps_has_five_notes_and_their_number(tmp_path):
    path = tmp_path / "log.mcap"
    views = [
        msgspec.structs.replace(sample, key=f"view/pose/r{k}", counter=count)
        for k in range(1, 9)
        for count, sample in ((0, published()[0]), (2, published()[0]))
    ]
    with Recorder(path, "small", {}) as recorder:
        recorder.write([*published(), *views])
    log = open_log(path)
    plain = evaluate(log.samples())
    notes = add_holes(plain, log, holes(log)).notes[len(plain.notes) :]
    assert len(notes) == 6
    assert (
        notes[-1] == f"the log is not whole, 3 more findings: `teamslam log check {path}` names all"
    )
