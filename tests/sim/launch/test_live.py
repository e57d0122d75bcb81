from io import StringIO

import numpy as np
import pytest
from rich.console import Console
from scipy.stats import chi2

from teamslam.sim.launch import live
from teamslam.sim.launch.live_errors import LiveErrors
from teamslam.sim.launch.watch import Watch
from teamslam.team.wire import channels as ch, messages as m
from tests import build


def status(node: str, state: str, *warnings: str, **figures: float) -> m.Status:
    return build.status(node=node, state=state, figures=figures, warnings=warnings)


def test_plain_lines_count_the_robots_that_have_come_while_the_world_waits(monkeypatch):
    monkeypatch.setattr(live, "LINE_S", 0.0)
    out = StringIO()
    lines = live._Lines(Console(file=out, width=100))
    watch = Watch(robots=("r1", "r2", "r3"), place="--team t --connect tcp/127.0.0.1:1")
    watch.statuses["world"] = status("world", "waiting", measurements=0.0, of=100.0)
    watch.statuses["robot/r1"] = status("robot/r1", "waiting")
    lines.show(watch)
    watch.statuses["world"] = status("world", "publishing", measurements=90.0, of=100.0)
    watch.statuses["robot/r1"] = status("robot/r1", "mapping", measurements=30.0)
    watch.statuses["robot/r2"] = status("robot/r2", "mapping", measurements=20.0)
    lines.show(watch)
    place, waiting, running = out.getvalue().splitlines()
    assert place.endswith("by --team t --connect tcp/127.0.0.1:1")
    assert waiting.endswith("] 1 of 3 robots have started; waiting for r2, r3")
    assert " 50%  team time 0 s, 2 robots" in running


def test_a_live_team_names_the_drivers_that_it_waits_for_what_to_start_and_repeats_nothing(
    monkeypatch,
):
    monkeypatch.setattr(live, "LINE_S", 0.0)
    monkeypatch.setattr(live, "SETTLED_S", 0.0)
    out = StringIO()
    lines = live._Lines(Console(file=out, width=100))
    place, call = "--team lab --connect tcp/[::1]:9", 'team="lab", connect="tcp/[::1]:9"'
    watch = Watch(robots=("r1", "r2"), drivers=("r1", "r2"), place=place, call=call, began=-1e9)

    def shown() -> list[str]:
        begin = len(out.getvalue())
        lines.show(watch)
        lines.show(watch)
        return out.getvalue()[begin:].splitlines()

    for robot in ("r1", "r2"):
        watch.statuses[f"robot/{robot}"] = status(f"robot/{robot}", "waiting")
    waiting = shown()[-1]
    assert "waiting for the drivers of r1, r2: start the program" in waiting
    assert f'Driver("r1", {call})' in waiting
    assert f"teamslam driver r1 --ros2 FILE {place}" in waiting
    watch.statuses["source/r1"] = status("source/r1", "waiting")
    come = shown()[-1]
    assert "waiting for the driver of r2" in come
    assert "r1 is running and has sent no odometry" in come
    watch.statuses["source/r1"] = status(
        "source/r1", "measuring", measurements=60.0, team_time_s=1.7e9
    )
    watch.statuses["robot/r1"] = status("robot/r1", "mapping", measurements=30.0)
    (running,) = shown()
    assert "30 of 60 measurements mapped  team time 2023-11-14 22:13:20 UTC" in running
    watch.statuses["source/r2"] = status("source/r2", "left")
    assert "the driver of r2 is away: start it again" in shown()[0]
    assert any("the driver of r2 is away" in line for line in printed(watch, 300))


def printed(watch: Watch, width: int) -> list[str]:
    out = StringIO()
    Console(file=out, width=width).print(live._view("thesis, seed 1", watch, width))
    return [line.rstrip() for line in out.getvalue().splitlines()]


def test_while_a_team_starts_one_line_says_who_is_missing(monkeypatch):
    monkeypatch.setattr(live, "PATIENCE_S", -1.0)
    watch = Watch(robots=("r1", "r2"))
    missing = ("world has not appeared yet", "robot/r2 has not appeared yet")
    watch.statuses["recorder"] = status("recorder", "recording", *missing)
    late = status("robot/r1", "waiting", "no measurements of this team yet")
    watch.statuses["robot/r1"] = late
    assert live.warnings(watch) == [f"recorder: {'; '.join(missing)}"]
    watch.statuses["world"] = status("world", "waiting", "waiting for robot/r2")
    assert live.warnings(watch) == ["world: waiting for robot/r2"]
    watch.statuses["world"] = status("world", "publishing")
    assert "robot/r1: no measurements of this team yet" in live.warnings(watch)
    lacking = ("missing: view/map: 20–22", "missing: view/log: 15", "nothing is recorded: full")
    watch.statuses["recorder"] = status("recorder", "done", *lacking)
    assert [w for w in live.warnings(watch) if "recorder" in w] == [f"recorder: {lacking[-1]}"]
    watch.failures.append("robot-r2 (pid 7) was killed")
    assert live.warnings(watch)[0] == "robot-r2 (pid 7) was killed"


SECOND = 1_000_000_000
COVARIANCE = np.array([[0.09, 0.01, 0.0], [0.01, 0.04, 0.005], [0.0, 0.005, 0.01]])


def pose(at_s: float, xyt: np.ndarray) -> m.PoseEstimate:
    return build.pose_estimate(stamp_ns=round(at_s * SECOND), pose=xyt, covariance=COVARIANCE)


def truth(seconds: list[float], poses: np.ndarray) -> m.Truth:
    stamps = [round(s * SECOND) for s in seconds]
    return build.truth(stamp_ns=stamps[-1], stamps=stamps, poses=poses)


def line(seconds: list[float]) -> np.ndarray:
    return np.array([[s, 0.0, (3.0 + s + np.pi) % (2 * np.pi) - np.pi] for s in seconds])


def test_the_nees_of_poses_is_against_the_truth_between_its_samples():
    errors, rng = LiveErrors(), np.random.default_rng(1)
    seconds = [float(s) for s in range(6)]
    expected = []
    for at in (0.5, 1.75, 3.0, 4.25):
        deviation = np.linalg.cholesky(COVARIANCE) @ rng.standard_normal(3)
        errors.take(ch.OWN_POSE, pose(at, line([at])[0] + deviation))
        expected.append(deviation @ np.linalg.solve(COVARIANCE, deviation))
    errors.take(ch.TRUTH, truth(seconds[:4], line(seconds[:4])))
    assert errors.of("r1").count == 3  # the last one's truth is not there yet
    errors.take(ch.TRUTH, truth(seconds[4:], line(seconds[4:])))
    tally = errors.of("r1")
    assert tally.mean == pytest.approx(np.mean(expected) / 3)
    assert tally.coverage == np.mean(np.array(expected) <= chi2.ppf(0.95, 3))
