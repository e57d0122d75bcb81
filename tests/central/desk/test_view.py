import json
import threading
from collections import defaultdict
from contextlib import nullcontext

import jsonschema
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from teamslam.central.desk.evaluation.errors import transform_points
from teamslam.central.desk.evaluation.running import Estimate, RunningErrors
from teamslam.central.desk.view.drawn import centre_particles
from teamslam.central.desk.view.export import export_views, run_viewer, with_views
from teamslam.central.desk.view.node import LAG_NS, PERIOD_NS, ViewerNode
from teamslam.sim.in_memory.team import final_map
from teamslam.sim.scenarios.scenario import load, with_options
from teamslam.team import end_query, translate
from teamslam.team.recording.check import check_log
from teamslam.team.recording.reader import open_log
from teamslam.team.recording.recorder import Recorder
from teamslam.team.shell import FaultyRunError
from teamslam.team.wire import channels as ch, messages as m, views
from teamslam.team.wire.arrays import from_floats
from teamslam.team.wire.bus import MemoryBus, MemoryNetwork
from teamslam.team.wire.codec import decoded, encoded
from tests import build
from tests.scenarios import with_world
from tests.sim.reruns import team_samples
from tests.support import example

S = 1_000_000_000


@pytest.fixture(scope="module")
def samples():
    return team_samples(with_world(with_options(load("thesis"), seed=1), steps=40))


@pytest.fixture(scope="module")
def exported(samples, tmp_path_factory):
    folder = tmp_path_factory.mktemp("view")
    with Recorder(folder / "log.mcap", "thesis", {}) as recorder:
        recorder.write(samples)
    export_views(open_log(folder / "log.mcap"), folder / "views.mcap")
    return folder / "views.mcap"


@pytest.fixture(scope="module")
def read(exported):
    found = defaultdict(list)
    with exported.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for schema, channel, message in reader.iter_messages():
            if "/view/" not in channel.topic:
                continue
            if channel.message_encoding == "json":
                value = json.loads(message.data)
                jsonschema.validate(value, json.loads(schema.data))
            else:
                value = DecoderFactory().decoder_for(channel.message_encoding, schema)(message.data)
            found[channel.topic.removeprefix("team/thesis/")].append((message.log_time, value))
    return found


def test_every_view_of_the_table_is_in_an_exported_log(read):
    assert {views.view_of(key) for key in read} == set(views.VIEWS)
    assert {"view/robot/r1", "view/robot/r2", "view/pose/r2", "view/particles/r1"} <= set(read)


def test_the_log_with_views_is_sound_and_has_the_teams_bytes_unchanged(exported, samples):
    log = open_log(exported)
    assert check_log(log) == []
    kept = [s for s in log.samples() if ch.VIEW.owner(s.key) is None]
    assert [(s.key, s.payload) for s in kept] == [(s.key, s.payload) for s in samples]


def test_views_that_a_viewer_has_missed_are_drawn_and_counted(exported, tmp_path):
    every = list(open_log(exported).samples())
    lines = [s for s in every if s.key == "view/log"]
    with Recorder(tmp_path / "log.mcap", "thesis", {}) as recorder:
        recorder.write([s for s in every if s not in lines[:2]])
    drawn = export_views(open_log(tmp_path / "log.mcap"), tmp_path / "again.mcap")
    assert (drawn.own + drawn.views, drawn.before) == (len(every), drawn.views - 2)
    assert str(drawn).startswith(
        f"{len(every)} messages, {drawn.views} of them views ({drawn.before} in the log: a viewer"
    )


def test_the_last_scene_has_the_final_map(read, samples):
    final = final_map(samples)
    names, means = translate.landmarks_of(final)
    entities = {entity.id: entity for entity in read["view/map"][-1][1].entities}
    landmarks = entities["landmarks"]
    assert [text.text for text in landmarks.texts] == [str(name) for name in names]
    dots = [(d.pose.position.x, d.pose.position.y) for d in landmarks.cylinders[1::2]]
    np.testing.assert_allclose(dots, means)
    joint = translate.landmark_covariance_of(final)
    for i, disc in enumerate(landmarks.cylinders[::2]):
        P = joint[2 * i : 2 * i + 2, 2 * i : 2 * i + 2]
        turn = 2.0 * np.arctan2(disc.pose.orientation.z, disc.pose.orientation.w)
        R = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        half = 0.5 * np.array([disc.size.x, disc.size.y])
        np.testing.assert_allclose(R @ np.diag(half**2) @ R.T, 5.991 * P, rtol=1e-6, atol=1e-9)
    assert len(entities["true landmarks"].cubes) == 18


def test_a_view_comes_once_a_second_and_has_every_robot_where_it_was(read, samples):
    times = [at for at, _ in read["view/robots"]]
    assert times == sorted(times)
    assert set(np.diff(times[:-1])) == {PERIOD_NS}
    said = {}
    for sample in samples:
        if sample.key.endswith("/pose"):
            pose = np.frombuffer(decoded(sample.payload, m.PoseEstimate).pose)
            said.setdefault((sample.key.split("/")[1], sample.stamp_ns), []).append(pose[:2])
    for at, scene in read["view/robots"]:
        drawn = {e.id: e.arrows[0].pose.position for e in scene.entities}
        for robot in ("r1", "r2"):
            if f"robot {robot}" in drawn and (robot, at) in said:
                place = drawn[f"robot {robot}"]
                assert any(np.allclose([place.x, place.y], p) for p in said[robot, at])


def test_views_of_the_same_log_are_the_same_bytes(samples):
    assert list(with_views(samples)) == list(with_views(samples))


# Errors.


def pose(at_s: float, x: float, robot: str = "r1", sigma: float = 0.5) -> m.PoseEstimate:
    P = from_floats(sigma**2 * np.eye(3))
    return build.pose_estimate(stamp_ns=round(at_s * S), robot=robot, pose=[x, 0, 0], covariance=P)


def truth(times: list[float], robot: str = "r1") -> m.Truth:
    poses = from_floats(np.column_stack([times, np.zeros((len(times), 2))]))
    return build.truth(
        stamp_ns=round(times[-1] * S),
        robot=robot,
        stamps=[round(t * S) for t in times],
        poses=poses,
    )


@pytest.mark.parametrize("truth_first", [True, False])
def test_an_error_is_known_as_soon_as_pose_and_truth_are_there(truth_first):
    errors = RunningErrors()
    steps = [
        lambda: errors.take_truth(truth([0.0, 1.0, 2.0])),
        lambda: errors.take_pose(Estimate.of(pose(1.5, 2))),
    ]
    for step in steps if truth_first else steps[::-1]:
        assert errors.known() is None
        step()
    found = errors.known()
    np.testing.assert_allclose(found.errors, [[0.5, 0.0, 0.0]])
    np.testing.assert_allclose(found.nees, [1.0])


# Time.


def shown(node: ViewerNode, *messages: tuple[ch.Channel, m.Message]) -> list[tuple[str, int]]:
    return [(s.key, s.stamp_ns) for c, message in messages for s in node.handle(c, message)]


def robots_at(out: list[tuple[str, int]]) -> list[int]:
    return [at // S for key, at in out if key == "view/robots"]


def test_the_view_waits_for_the_slowest_robot_at_work():
    node = ViewerNode()
    ready = [(ch.OWN_POSE, pose(0, 0)), (ch.OWN_POSE, pose(0, 0, "r2"))]
    assert robots_at(shown(node, *ready)) == [0]
    assert robots_at(shown(node, *[(ch.OWN_POSE, pose(t, t)) for t in range(1, 9)])) == []
    assert robots_at(shown(node, (ch.OWN_POSE, pose(3, 3, "r2")))) == [1, 2, 3]
    lost = (ch.ALIVE, build.liveliness(node="robot/r2", alive=False))
    assert robots_at(shown(node, lost)) == [4, 5, 6, 7, 8]


def test_a_robot_that_has_stopped_holds_the_view_for_a_while_only():
    node = ViewerNode()
    shown(node, (ch.OWN_POSE, pose(0, 0)), (ch.OWN_POSE, pose(0, 0, "r2")))
    ahead = LAG_NS // S + 5
    out = shown(node, *[(ch.OWN_POSE, pose(t, t)) for t in range(1, ahead + 1)])
    assert robots_at(out) == [1, 2, 3, 4, 5]


def test_a_cloud_is_drawn_around_the_robot_wherever_its_own_frame_has_drifted():
    rng = np.random.default_rng(1)
    poses = np.column_stack([rng.normal(0.0, [0.3, 0.1], (50, 2)), rng.normal(3.1, 0.05, 50)])
    weights = rng.uniform(0.5, 1.0, 50)
    drift = np.array([40.0, -7.0, 2.0])
    c, s = np.cos(drift[2]), np.sin(drift[2])
    drifted = poses @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) + drift

    def cloud(of: np.ndarray) -> m.ParticleCloud:
        packed = (from_floats(of.ravel()), from_floats(weights))
        return m.ParticleCloud(stamp_ns=0, robot="r1", poses=packed[0], weights=packed[1])

    seen = centre_particles(cloud(poses))
    np.testing.assert_allclose(np.average(seen, axis=0, weights=weights), 0.0, atol=1e-12)
    np.testing.assert_allclose(centre_particles(cloud(drifted)), seen, atol=1e-12)
    heading = float(np.arctan2(*(np.average(f(poses[:, 2]), weights=weights)
                                 for f in (np.sin, np.cos))))  # fmt: skip
    mean = np.average(poses[:, :2], axis=0, weights=weights)
    placed = transform_points(np.array((*mean, heading)), seen)
    np.testing.assert_allclose(placed, poses[:, :2], atol=1e-12)


# The end.


@pytest.mark.parametrize("lost", [(), ("r2",)])
def test_a_viewer_that_comes_after_the_end_leaves_and_says_what_is_wrong(lost, monkeypatch):
    monkeypatch.setattr(end_query, "FINAL_S", 0.1)
    final = example(m.FusedMap, final=True, lost=lost, withdrawn=())
    kept = encoded(build.kept(key="central/final", payload=encoded(final)))
    network = MemoryNetwork()
    MemoryBus(network).answer(ch.KEPT, "", lambda _: [kept])
    stop = threading.Event()
    timer = threading.Timer(20.0, stop.set)
    timer.start()
    try:
        with pytest.raises(FaultyRunError, match="r2 lost") if lost else nullcontext():
            run_viewer(MemoryBus(network), stop)
        assert not stop.is_set(), "it left by itself"
    finally:
        timer.cancel()
