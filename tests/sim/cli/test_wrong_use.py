import sys
from pathlib import Path

import pytest

from teamslam.sim.cli.commands import WRONG_USE
from teamslam.sim.cli.main import main


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
        (["launch", "utias"], ["no data set given", "--dataset"]),
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
