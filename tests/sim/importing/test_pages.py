import re
import subprocess
import sys
import tomllib
from dataclasses import replace
from pathlib import Path

import pytest

from teamslam.sim.calibration.data import LEAST_SPANS, SPAN_S, moving_stretches
from teamslam.sim.cli import launch
from teamslam.sim.cli.main import load_all
from teamslam.sim.importing.tables import load_map
from teamslam.sim.scenarios.scenario import load, with_options
from teamslam.sim.scenarios.source import scenario_beside, streams_of
from teamslam.team.config import MotionNoise
from teamslam.team.ros2.topics import load_topics
from tests.commands import output_of

ROOT = Path(__file__).parents[3]
BUILTIN = ROOT / "sim" / "scenarios" / "builtin"


def blocks(page: str, language: str) -> list[str]:
    text = (ROOT / "docs" / page).read_text("utf-8")
    return re.findall(rf"```{language}\n(.*?)```", text, re.DOTALL)


def made(command: str, folder: Path) -> None:
    python, program, name = command.split()
    assert python == "python"
    subprocess.run([sys.executable, ROOT / program, name], cwd=folder, check=True)


def test_the_data_set_of_the_page_is_read(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    first, second = blocks("your_data.md", "sh")[0].splitlines()
    made(first, tmp_path)
    assert second == "teamslam launch --dataset my_set"
    scenario = with_options(load(scenario_beside("my_set")), dataset="my_set")
    world = streams_of(scenario)
    assert [stream.robot for stream in world.streams] == ["r1", "r2"]
    assert all(len(stream.landmark_detections.ids) == 2400 for stream in world.streams)
    assert world.landmarks is not None
    advice = launch._how_to_learn(Path("my_set"), replace(world, landmarks=None))
    assert "without true paths and landmarks" in advice
    short = [
        replace(each, intervals=each.intervals.where(each.intervals.end_ns < 100_000_000_000))
        for each in world.streams
    ]
    found = moving_stretches(short)
    assert 0 < found < LEAST_SPANS
    advice = launch._how_to_learn(Path("my_set"), replace(world, streams=tuple(short)))
    assert f"have {found} stretches of 10 s" in advice
    page = (ROOT / "docs" / "your_data.md").read_text("utf-8")
    assert f"{LEAST_SPANS} stretches of {SPAN_S:.0f} s" in page


def test_the_scenario_and_the_map_of_the_page_are_sound(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    _, columns, further, robots, mixed, own = blocks("your_data.md", "toml")
    (tmp_path / "columns.toml").write_text(columns)
    assert set(load_map(tmp_path / "columns.toml").shared) == {"odometry", "observations"}
    (tmp_path / "further.toml").write_text(further)
    assert set(load_map(tmp_path / "further.toml").shared) == {"detections", "truth"}
    (tmp_path / "robots.toml").write_text(robots)
    assert set(load_map(tmp_path / "robots.toml").robots["jackal"]) == {"odometry"}
    (tmp_path / "mixed.toml").write_text(mixed)
    husky = load_map(tmp_path / "mixed.toml").robots["husky"]
    assert husky["odometry"].drop == {"robot": ("jackal",)}
    made("python examples/own_data.py my_set", tmp_path)
    (tmp_path / "my_set" / "scenario.toml").write_text(own)
    scenario = load(scenario_beside("my_set"))
    assert [robot.id for robot in scenario.robots] == ["r1", "r2"]
    sensor, motion = scenario.robots[0].sensor, scenario.robots[0].motion
    assert (sensor.range_sigma, sensor.range_sigma_per_m) == (0.05, 0.0)
    assert sensor.bearing_sigma == 0.02
    assert motion.forward == MotionNoise(per_m=0.02)
    assert motion.turn == MotionNoise(per_s=0.004, per_rad=0.02)
    assert motion.lateral == MotionNoise()


def test_the_page_has_the_figures_of_the_built_in_scenario_that_merging_keeps():
    noise = (ROOT / "docs" / "your_data.md").read_text("utf-8").partition("## Noise")[2]
    built_in = tomllib.loads((BUILTIN / "recorded.toml").read_text("utf-8"))["defaults"]
    per_m = built_in["sensor"]["range_sigma_per_m"]
    stated = tomllib.loads("\n".join(re.findall(r"`((?:forward|turn|lateral) = {.*?})`", noise)))
    assert stated == {name: built_in["motion"][name] for name in ("forward", "turn", "lateral")}
    assert f"`range_sigma_per_m = {per_m}`" in noise
    assert "`pip install 'teamslam[calibrate]'`" in noise


def test_the_clock_of_the_page_is_added_to_its_scenario(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    clock, *_, own = blocks("your_data.md", "toml")
    made("python examples/own_data.py my_set", tmp_path)
    (tmp_path / "my_set" / "scenario.toml").write_text(f"{own}\n{clock}")
    late = load(scenario_beside("my_set"))
    assert [robot.clock_offset_s for robot in late.robots] == [0.0, 0.12]


def test_the_bag_of_the_page_is_listed_and_imported(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    page = (ROOT / "docs" / "your_ros2_robot.md").read_text("utf-8")
    command = re.search(r"`(python examples/\S+ my_bag)`", page)
    made(command[1], tmp_path)
    listed = output_of("import", "my_bag")
    assert "`teamslam import my_bag -o FOLDER` imports these topics" in listed
    proposal = listed.partition("into topics.toml:\n\n")[2].partition("\nand type")[0]
    (tmp_path / "topics.toml").write_text(proposal)
    typed = "import my_bag -o my_set --ros2 topics.toml"
    assert f"teamslam {typed}" in page
    assert "teamslam import my_bag -o FOLDER --ros2 topics.toml" in listed
    output_of(*typed.split())
    scenario = load(scenario_beside("my_set"))
    assert scenario.robots[0].sensor.mount == pytest.approx((0.2, 0.0, 0.0), abs=1e-12)
    (stream,) = streams_of(scenario).streams
    assert set(stream.landmark_detections.ids.tolist()) == {7, 12, 13}
    assert stream.landmark_detections.points[0] == pytest.approx([1.8, 1.0])


def test_the_topics_of_the_page_are_sound(tmp_path):
    (tmp_path / "topics.toml").write_text(blocks("your_ros2_robot.md", "toml")[0])
    topics = load_topics(tmp_path / "topics.toml")
    assert topics.robots["r1"].teammates == {"5": "r2"}


def test_the_commands_of_a_team_over_wifi_are_sound(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "lab.toml").write_text(blocks("your_robot.md", "toml")[0])
    page = (ROOT / "docs" / "machines.md").read_text("utf-8")
    section = page.partition("## A team over Wi-Fi")[2].partition("\n## ")[0]
    typed = [line.split()[1:] for line in section.splitlines() if line.startswith("    teamslam")]
    assert [words[0] for words in typed] == ["keys", "router", "record", "central", "robot"]
    output_of(*typed[0])
    names = {path.name for path in (tmp_path / "keys").rglob("*")}
    for node in ("robot-r1", "source-r1", "robot-r2", "central", "recorder"):
        assert any(name.startswith(node) for name in names), node
    for name, *words in typed[1:]:
        context = load_all().commands[name].make_context(name, list(words))
        assert context.params["keys"] == Path("keys")
