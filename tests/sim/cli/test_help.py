import json
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner

from teamslam.sim.cli import results
from teamslam.sim.cli.commands import WRONG_USE
from teamslam.sim.cli.main import SECTIONS, app, load_all, main
from teamslam.sim.cli.results import Steps
from teamslam.team.recording.recorder import Recorder
from tests.sim.logs import joined_log, scenario
from tests.test_architecture import unknown

RUN = CliRunner()
SHOWN = {name: each for name, each in load_all().commands.items() if not each.hidden}


def test_every_command_is_in_one_section_and_has_an_example_that_it_understands():
    named = [name for names in SECTIONS.values() for name in names]
    assert sorted(named) == sorted(SHOWN)
    assert len(SECTIONS) == 5
    commands = [(name, each) for name, each in SHOWN.items() if not hasattr(each, "commands")]
    for group in ("log", "map", "experiment"):
        assert SHOWN[group].epilog.startswith(f"teamslam {group} ")
        commands += [(f"{group} {name}", each) for name, each in SHOWN[group].commands.items()]
    for name, each in commands:
        for line in each.epilog.splitlines():
            assert line.startswith(f"teamslam {name} ")
            assert unknown(line.removeprefix("teamslam ")) is None
    assert RUN.invoke(app, ["view", "--help"]).output.splitlines()[0].endswith("view [OPTIONS] LOG")


def test_a_misspelt_command_option_or_scenario_is_answered_by_the_closest_one():
    for words, meant in (
        (["lunch"], "'launch'"),
        (["log", "chek"], "'check'"),
        (["launch", "--sped", "3"], "'--speed'"),
        (["rerun", "LOG", "--no-center", "0-1"], "'--no-centre'"),
    ):
        result = RUN.invoke(app, words)
        assert result.exit_code == 2
        assert "id you mean " in result.output
        assert meant in result.output.partition("id you mean ")[2]
    assert "did you mean `waypoints`?" in str(RUN.invoke(app, ["launch", "waypoint"]).exception)


def test_short_work_says_nothing_and_long_work_what_it_does_and_how_far_it_is(monkeypatch, capsys):
    at_s = [0.0]
    monkeypatch.setattr(results.time, "monotonic", lambda: at_s[0])
    told = Steps()
    told.begin("scoring the run")
    told.share(0.3)
    assert capsys.readouterr().err == ""
    at_s[0] = 3.5
    told.share(0.42)
    told.share(0.43)
    told.begin("proving the ledger")
    at_s[0] = 7.0
    told.robot("r3")
    assert capsys.readouterr().err == "scoring the run: 42%\nproving the ledger: r3\n"


def written(path: Path, deviation: float) -> Path:
    path.parent.mkdir(parents=True)
    with Recorder(path, "small", {}) as recorder:
        recorder.write(joined_log(scenario(robots=2), deviation))
    return path


def test_two_runs_stand_side_by_side(tmp_path):
    near, far = (tmp_path / name / "log.mcap" for name in ("near", "far"))
    written(near, 0.05)
    written(far, 0.2)
    picture, figures = tmp_path / "both.svg", tmp_path / "both.json"
    done = CliRunner().invoke(
        app, ["compare", str(near.parent), str(far), "-o", str(picture), "--json", str(figures)]
    )
    assert done.exit_code == 0, done.output
    told = json.loads(figures.read_text())
    assert float(told["near"]["landmark RMSE [m]"]) < float(told["far"]["landmark RMSE [m]"])
    assert "near" in done.stdout
    assert "<svg" in picture.read_text()


def test_one_run_and_a_picture_of_no_kind_are_refused(tmp_path):
    alone = CliRunner().invoke(app, ["compare", "a"])
    assert (alone.exit_code, "two or more" in alone.output) == (2, True)
    wrong = CliRunner().invoke(app, ["compare", "a", "b", "-o", str(tmp_path / "x.jpeg")])
    assert (wrong.exit_code, ".svg" in wrong.output) == (2, True)


def message_in(said: str, status: object) -> str:
    assert "Traceback" not in said
    assert status == WRONG_USE, said
    errors = [line for line in said.splitlines() if line.startswith("error: ")]
    assert len(errors) == 1, said
    return errors[0]


@pytest.fixture
def told(monkeypatch, tmp_path, capfd):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")

    def run(*arguments: str) -> str:
        monkeypatch.setattr(sys, "argv", ["teamslam", *arguments])
        with pytest.raises(SystemExit) as ended:
            main()
        return message_in("".join(capfd.readouterr()), ended.value.code)

    return run


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (["launch", "atlantis"], ["atlantis: no such scenario", "thesis", "waypoints"]),
        (["launch", "thesis", "--robots", "0"], ["0 robots: a team has 1 to 1000"]),
        (["launch", "thesis", "--robots", "1001"], ["1001 robots: a team has 1 to 1000"]),
        (
            ["launch", "thesis", "--estimator", "hybrid-thesis"],
            ["hybrid-thesis can not feed the rule join", "valid:", "kalman-per-axis"],
        ),
        (["launch", "thesis", "--fusion", "mean"], ["'mean' at fusion", "covariance-intersection"]),
        (["launch", "thesis", "--speed", "banana"], ["--speed banana", "positive number, or max"]),
        (["launch", "thesis", "--speed", "-1"], ["--speed -1", "positive number, or max"]),
        (["launch", "--dataset", "nowhere.zip"], ["nowhere.zip: no such file or folder"]),
        (["launch", "thesis", "--dataset", "x.zip"], ["takes no data set", "utias"]),
        (["launch", "utias"], ["no data set given", "--dataset", "not shipped"]),
        (["launch", "victoria"], ["no data set given", "odometry.csv and detections.csv"]),
        (["launch", "thesis", "--record", "/dev/null"], ["/dev/null: not a regular file"]),
        (["launch", "thesis", "-o", "/dev/null"], ["/dev/null: File exists; give another path"]),
        (["rerun", "none", "-o", "/dev/null"], ["-o /dev/null: File exists; give a folder"]),
        (["repair", "/dev/null", "-o", "/dev/null"], ["/dev/null exists: choose another name"]),
        (["record", "thesis", "-o", "/dev/null"], ["/dev/null exists: choose another name"]),
        (["experiment", "ma-6a"], ["ma-6a: give the sets with --dataset"]),
        (["replay", "nowhere.mcap"], ["nowhere.mcap: not found"]),
        (["view", "nowhere.mcap"], ["nowhere.mcap: not found"]),
        (
            ["view", "nowhere.mcap", "--follow", "--layout", "x"],
            ["nowhere.mcap: not found", "need"],
        ),
        (["report", "nowhere.mcap", "-o", "out"], ["nowhere.mcap: not found"]),
        (["router", "--listen", "banana"], ["can not listen at banana", "tcp/HOST:PORT"]),
        (
            ["router", "--listen", "tcp/203.0.113.1:7447"],
            ["--listen tcp/203.0.113.1:7447", "--keys", "--insecure"],
        ),
        (
            ["router", "--insecure", "--listen", "tcp/203.0.113.1:7447"],
            ["can not listen", "not this machine's"],
        ),
    ],
)
def test_wrong_use_is_told_with_what_to_do(arguments, parts, told):
    message = told(*arguments)
    assert [part for part in parts if part not in message] == [], message


@pytest.mark.parametrize(
    ("text", "arguments", "said"),
    [
        ("robotcount = 2", ["launch", "mine"], "mine: unknown field `robotcount`"),
        ("steps =", ["launch", "mine"], "mine: not valid TOML"),
        ("", ["replay", "mine"], "mine: empty file"),
        ("no log", ["repair", "mine", "--output", "out"], "mine: no MCAP file"),
    ],
)
def test_a_mistake_in_a_file_is_told_with_its_name(text, arguments, said, told):
    name = "mine.toml" if arguments[0] == "launch" else "mine.mcap"
    Path(name).write_text(text)
    arguments = [name if each == "mine" else each for each in arguments]
    assert said.replace("mine", name) in told(*arguments)
