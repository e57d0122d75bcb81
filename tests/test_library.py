import ast
import json
import re
import runpy
import sys

import matplotlib.pyplot as plt
import numpy as np
import pytest

import teamslam
from teamslam.team import library
from teamslam.team.estimation.association.gating import CONTRADICTED, compare_classes
from teamslam.team.wire import channels as ch
from teamslam.team.wire.bus import Outgoing, opened
from teamslam.team.wire.zenoh.bus import ZenohBus
from teamslam.team.wire.zenoh.router import router
from tests.sim.reruns import team_samples, thesis, written
from tests.support import ROOT, submap

EXAMPLES = ROOT / "examples"
SENSOR = teamslam.Sensor(range_sigma=0.1, bearing_sigma=0.02)
MOTION = teamslam.MotionModel(
    forward=teamslam.MotionNoise(per_m=0.05), turn=teamslam.MotionNoise(per_rad=0.05, per_m=0.01)
)
LANDMARKS = np.array([[2.0, 4.0], [6.0, -3.0], [9.0, 4.0], [13.0, 1.0], [4.0, 1.0]])


def driven(start, keyframes, rng):
    pose, taken = start, []
    for _ in range(keyframes):
        increment = teamslam.increment_of(MOTION, 1.0, 1.0, 0.05)
        factor = np.linalg.cholesky(increment.covariance + 1e-12 * np.eye(3))
        pose = teamslam.compose(pose, increment.mean)
        pose = teamslam.compose(pose, factor @ rng.normal(size=3))
        z = np.array([teamslam.measurement_of(pose, landmark) for landmark in LANDMARKS])
        z += rng.normal(0.0, (0.1, 0.02), z.shape)
        ids = np.arange(len(z), dtype=np.uint32)
        taken.append(
            teamslam.Keyframe(increment=increment, ids=ids, ranges=z[:, 0], bearings=z[:, 1])
        )
    return pose, taken


def submaps(keyframes, rng, window=5):
    front_end = teamslam.FrontEnd(particles=50)
    return [
        teamslam.submap_of(keyframes[k : k + window], SENSOR, rng, front_end)
        for k in range(0, len(keyframes), window)
    ]


def test_every_name_of_the_library_comes_from_team_and_is_documented():
    for name in library.__all__:
        assert getattr(teamslam, name) is getattr(library, name)
        assert (getattr(teamslam, name).__doc__ or "").strip()
    page = (ROOT / "docs" / "library.md").read_text()
    assert [name for name in library.__all__ if f"`{name}`" not in page] == []


def test_two_robots_joined_are_where_the_batch_reference_says():
    rng = np.random.default_rng(3)
    starts = {"r1": np.zeros(3), "r2": np.array([3.0, -2.0, 0.4])}
    measured = {robot: driven(start, 15, rng)[1] for robot, start in starts.items()}
    initial = {"r1": teamslam.InitialPose(pose=starts["r1"])}
    joined = teamslam.join({robot: submaps(of, rng) for robot, of in measured.items()}, initial)
    wide = teamslam.InitialPose(pose=starts["r2"], covariance=np.diag((100.0, 100.0, 10.0)))
    batch = teamslam.batch_map(measured, dict.fromkeys(measured, SENSOR), {**initial, "r2": wide})
    assert batch.converged
    assert joined.apart == {}
    np.testing.assert_array_equal(joined.landmarks.ids, batch.landmarks.ids)
    sigma = np.sqrt(np.diag(batch.landmarks.covariance)).reshape(-1, 2)
    assert (np.abs(joined.landmarks.means - batch.landmarks.means) < 1.5 * sigma).all()
    last = joined.trajectories["r2"].poses[-1] - batch.trajectories["r2"].poses[-1]
    assert np.linalg.norm(last[:2]) < 0.15


def test_a_robot_that_shares_too_little_is_apart_and_the_map_says_why():
    rng = np.random.default_rng(5)
    _, keyframes = driven(np.zeros(3), 5, rng)
    strangers = [
        teamslam.Keyframe(
            increment=each.increment, ids=each.ids + np.uint32(100), ranges=each.ranges,
            bearings=each.bearings,
        )
        for each in keyframes
    ]  # fmt: skip
    joined = teamslam.join(
        {"r1": submaps(keyframes, rng), "r2": submaps(strangers, rng), "r3": []},
        {"r1": teamslam.InitialPose(pose=np.zeros(3))},
    )
    assert set(joined.trajectories) == {"r1"}
    assert "shared landmark" in joined.apart["r2"]
    assert joined.apart["r3"] == "it has no submaps"


def test_wrong_use_of_the_library_is_named():
    with pytest.raises(ValueError, match="no submaps of r9"):
        teamslam.join({}, {"r9": teamslam.InitialPose(pose=np.zeros(3))})
    with pytest.raises(ValueError, match="no submaps at all"):
        teamslam.join({"r1": []}, {})
    with pytest.raises(ValueError, match="r1 has no start"):
        teamslam.batch_map(
            {"r1": driven(np.zeros(3), 1, np.random.default_rng(1))[1]}, {"r1": SENSOR}, {}
        )
    with pytest.raises(teamslam.WireError):
        teamslam.submap_in(b"\x91\xa8submap/1")


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    path = tmp_path_factory.mktemp("library") / "log.mcap"
    written(path, team_samples(thesis(60)))
    return path


def test_submaps_of_a_log_join_to_its_final_map(log):
    starts = [opened(sample)[2] for sample in teamslam.open_log(log).samples([ch.START])]
    (final,) = [opened(sample)[2] for sample in teamslam.open_log(log).samples([ch.FINAL_MAP])]
    initial = {
        start.robot: teamslam.InitialPose(pose=np.frombuffer(start.pose, "<f8")) for start in starts
    }
    joined = teamslam.join(teamslam.submaps_in(log), initial)
    np.testing.assert_array_equal(joined.landmarks.ids, np.frombuffer(final.ids, "<u4"))
    means = np.frombuffer(final.means, "<f8").reshape(-1, 2)
    np.testing.assert_allclose(joined.landmarks.means, means, atol=1e-4)


def ran(name: str, *arguments: str, capsys: pytest.CaptureFixture[str], monkeypatch) -> str:
    monkeypatch.setattr(sys, "argv", [name, *arguments])
    runpy.run_path(str(EXAMPLES / name))
    return capsys.readouterr().out


def test_the_example_of_fastslam_maps_the_landmarks(capsys, monkeypatch, tmp_path):
    out = ran("fastslam.py", str(tmp_path / "f.png"), capsys=capsys, monkeypatch=monkeypatch)
    found = re.fullmatch(r"8 landmarks, RMSE (0\.\d+) m\n", out)
    assert float(found[1]) < 0.2
    assert (tmp_path / "f.png").stat().st_size > 10_000


def test_the_example_of_joining_ties_both_robots(capsys, monkeypatch, tmp_path):
    out = ran("join_two_maps.py", str(tmp_path / "j.png"), capsys=capsys, monkeypatch=monkeypatch)
    assert "joined: 24 landmarks of r1, r2" in out
    assert out.endswith("not joined: none\n")
    assert (tmp_path / "j.png").stat().st_size > 10_000


def test_the_example_of_a_log_joins_it_again(log, capsys, monkeypatch):
    out = ran("read_log.py", str(log), capsys=capsys, monkeypatch=monkeypatch)
    assert "team test, complete" in out
    assert re.search(r"^joined: \d+ landmarks, cost per dof \d", out, re.MULTILINE)


def test_the_example_of_a_submap_reads_it_off_a_live_team(capsys, monkeypatch):
    with router() as endpoint, ZenohBus("demo", endpoint) as bus:
        bus.publish(Outgoing(ch.SUBMAP, "alpha", submap(0)))
        out = ran("read_submap.py", endpoint, "demo", capsys=capsys, monkeypatch=monkeypatch)
    assert "submap 0 of alpha" in out
    assert "landmark 1 at" in out


def test_the_notebook_runs_from_top_to_bottom(capsys):
    cells = json.loads((EXAMPLES / "submap.ipynb").read_text())["cells"]
    code = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
    scope: dict[str, object] = {}
    for each in code:
        exec(compile(each, "submap.ipynb", "exec"), scope)
    out = capsys.readouterr().out
    found = re.search(r"mean of 50 windows: (\d\.\d+)", out)
    assert 0.8 < float(found[1]) < 1.3
    assert len(plt.get_fignums()) == 3
    plt.close("all")
    assert all(cell.get("outputs", []) == [] for cell in cells), "committed without its outputs"


def test_examples_use_nothing_of_ours_but_the_library():
    programs = sorted(EXAMPLES.glob("*.py"))
    assert len(programs) == 7
    for program in programs:
        names = {
            node.module
            for node in ast.walk(ast.parse(program.read_text()))
            if isinstance(node, ast.ImportFrom)
        }
        assert not {name for name in names if name and name.startswith("teamslam.")}


def test_descriptors_of_one_landmark_match_and_of_two_do_not():
    rng = np.random.default_rng(3)
    words = rng.normal(0.0, 1.0, (32, 8))
    landmarks = rng.normal(0.0, 1.0, (200, 8))
    views = landmarks + rng.normal(0.0, 0.3, (4, 200, 8))
    apart = views[0, :, np.newaxis] - words
    nearest = (apart**2).sum(axis=2).argmin(axis=1)
    sigma = apart[np.arange(200), nearest].std()
    first, second = (
        sum(np.log(library.word_likelihoods(view, words, sigma)) for view in pair)
        for pair in (views[:2], views[2:])
    )
    same = compare_classes(first, second)
    other = compare_classes(first, np.roll(second, 1, axis=0))
    assert (same > -CONTRADICTED).mean() > 0.99
    assert (other < -CONTRADICTED).mean() > 0.5
    assert same.mean() > 1.0


@pytest.mark.parametrize(
    ("descriptors", "words", "sigma"),
    [
        (np.zeros(3), np.zeros((2, 3)), 1.0),
        (np.zeros((1, 3)), np.zeros((1, 3)), 1.0),
        (np.zeros((1, 3)), np.zeros((2, 4)), 1.0),
        (np.zeros((1, 3)), np.zeros((2, 3)), 0.0),
    ],
)
def test_descriptors_of_other_shapes_are_refused(descriptors, words, sigma):
    with pytest.raises(ValueError, match=r"give"):
        library.word_likelihoods(descriptors, words, sigma)
