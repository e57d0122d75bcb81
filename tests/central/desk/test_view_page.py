import base64
import json
import re
import socket
from collections import Counter, defaultdict
from collections.abc import Iterable
from contextlib import AbstractContextManager
from http.client import HTTPConnection
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import msgspec
import numpy as np
import pytest
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from mcap.reader import make_reader
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from teamslam.central.desk.evaluation.errors import transform_points
from teamslam.central.desk.evaluation.evaluation import evaluate
from teamslam.central.desk.view.export import with_views
from teamslam.central.desk.view.layout import layout
from teamslam.central.desk.view.node import ViewerNode
from teamslam.central.desk.view.page_frames import PageFrames, sets_of
from teamslam.central.desk.view.server import (
    VIEWERS,
    Feed,
    ServerError,
    Shown,
    page_files,
    refusal,
    serving,
    session,
)
from teamslam.sim.cli import view
from teamslam.team.recording.reader import LogError, Tail
from teamslam.team.recording.recorder import Recorder
from teamslam.team.translate import joint_bytes, landmark_covariance_of
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.arrays import from_floats, from_ids, from_stamps
from teamslam.team.wire.bus import Sample
from teamslam.team.wire.codec import decoded, encoded
from tests import build
from tests.commands import output_of
from tests.crowd import crowd
from tests.support import ROOT, example, fused_map, wait_until

ROBOTS, LANDMARKS, SECONDS = 3, 40, 60
PAGE = ROOT / "central" / "desk" / "view" / "page"


@pytest.fixture(scope="module")
def samples():
    return list(crowd(ROBOTS, LANDMARKS, SECONDS))


@pytest.fixture(scope="module")
def log(samples, tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "log.mcap"
    with Recorder(path, "crowd", {"seed": "7", "scenario": '{"name": "small crowd"}'}) as recorder:
        recorder.write(samples)
    return path


def told(path: Path) -> list[dict[str, object]]:
    feed = Feed(Tail(path))
    while not feed.ended:
        feed.read_more(growing=False)
    assert feed.error is None
    return [json.loads(frame) for frame in feed.frames]


@pytest.fixture(scope="module")
def frames(log):
    found = defaultdict(list)
    for frame in told(log):
        found[frame["k"]].append(frame)
    return found


# The page's frames.


def test_the_page_is_greeted_first_and_told_the_end_last(log):
    kinds = [frame["k"] for frame in told(log)]
    assert kinds[0] == "hello"
    assert kinds[-1] == "eof"
    assert told(log)[0]["title"] == "small crowd, seed 7 · log.mcap"


def test_the_page_gets_every_pose_and_its_error(frames):
    for robot in ("r1", "r2", "r3"):
        poses = [f for f in frames["pose"] if f["r"] == robot]
        times = [t for f in poses for t in f["t"]]
        np.testing.assert_allclose(times, np.arange(5 * SECONDS) / 5.0)
        rows = np.array([v for f in poses for v in f["v"]]).reshape(-1, 7)
        np.testing.assert_allclose(rows[:, 3:], np.tile([0.04, 0.0, 0.09, 1e-3], (len(rows), 1)))
        errors = np.array([v for f in frames["err"] if f["r"] == robot for v in f["v"]])
        errors = errors.reshape(-1, 7)
        assert len(errors) == len(rows)
        np.testing.assert_allclose(errors[0, 3:6], [0.6, 0.9, 3 * 1e-3**0.5], rtol=1e-6)
        assert 0.7 < errors[:, 6].mean() < 1.3


def test_the_page_is_told_when_a_robots_poses_are_in_another_frame():
    messages = [(ch.START, build.initial_pose(robot=robot)) for robot in ("r1", "r2")]
    for second in range(4):
        for robot in ("r1", "r2"):
            own = second < 2
            frame = f"{robot}/1" if own else "r1/1"
            pose = at_origin(second, robot=robot, frame=frame, in_team_frame=not own)
            messages.append((ch.OWN_POSE if own else ch.TEAM_POSE, pose))
    told = [(each["r"], each["t"]) for each in told_of(*messages) if each["k"] == "frame"]
    assert told == [("r2", 2.0)]


def at_origin(second: int, **fields: object) -> m.PoseEstimate:
    place = {"pose": np.zeros(3), "covariance": np.eye(3)}
    return build.pose_estimate(stamp_ns=second * 10**9, **place, **fields)


def told_of(*messages: tuple[ch.Channel, m.Message]) -> list[dict[str, object]]:
    page = PageFrames()
    for channel, message in messages:
        name = getattr(message, "robot", getattr(message, "node", ""))
        page.count(Sample(channel.key(name), encoded(message), message.stamp_ns, 0, 0))
        page.take(channel, message)
    return [json.loads(frame) for frame in page.flush()]


def test_the_page_gets_measurements_in_the_robots_frame():
    sensor = {"mount": [0.5, 0.0, np.pi / 2], "max_range": 30.0, "field_of_view": 2.0}
    config = build.configuration(configuration=json.dumps({"sensor": sensor}))

    def scan(stamp_ns: int, names: list[int]) -> tuple[ch.Channel, m.Message]:
        return ch.OBSERVATIONS, build.observations(
            stamp_ns=stamp_ns, ids=names, ranges=np.full(len(names), 2.0),
            bearings=np.zeros(len(names))
        )  # fmt: skip

    mate = build.sightings(
        stamp_ns=10**9, teammates=("r2",), ranges=[1.0],
        bearings=[np.pi / 2]
    )  # fmt: skip
    told = told_of(
        (ch.ROBOT_CONFIG, config), scan(0, [7]), scan(2 * 10**8, [7, 8]), scan(6 * 10**8, [7]),
        (ch.SIGHTINGS, mate),
    )  # fmt: skip
    (limits,) = (each for each in told if each["k"] == "sensor")
    assert (limits["range"], limits["view"]) == (30.0, 2.0)
    (seen,) = (each for each in told if each["k"] == "see")
    assert seen["v"] == [7, 0.5, 2.0, 8, 0.5, 2.0, 7, 0.5, 2.0, "r2", -0.5, 0.0]


def test_the_page_is_told_what_a_node_waits_for_and_when_no_more():
    def status(*warnings: str) -> tuple[ch.Channel, m.Message]:
        return ch.STATUS, build.status(node="world", warnings=warnings)

    waits = "waiting for central"
    told = told_of(status(waits), status(waits, "the disk is full"), status())
    assert [each["x"] for each in told if each["k"] == "wait"] == [[waits], []]


def test_the_page_gets_the_members_of_a_landmark_and_the_steps_that_added_them():
    count, words = sets_of(example(m.FusedMap))[2**31 + 7]
    assert count == 2
    assert words == [
        "alpha/1/0/4",
        "alpha/1/1/2: track, log-likelihood ratio 5.5, its best rival -2.0, sd 0.25 m",
    ]


@pytest.mark.parametrize("joint", [False, True])
def test_the_page_and_the_report_of_a_log_have_one_nees(samples, tmp_path, joint):
    *first, last = samples
    final = decoded(last.payload, m.FusedMap)
    if joint:
        P = landmark_covariance_of(final) + 0.005  # an error that all landmarks share
        final = msgspec.structs.replace(final, joint=True, covariance=joint_bytes(P))
    unknown = decoded(first[0].payload, m.TruthLandmarks)  # the last landmark has no truth
    known = msgspec.structs.replace(
        unknown, ids=unknown.ids[:-4], positions=unknown.positions[:-16]
    )
    first[0] = msgspec.structs.replace(first[0], payload=encoded(known))
    log = [*first, msgspec.structs.replace(last, payload=encoded(final))]
    with Recorder(tmp_path / "log.mcap", "crowd", {}) as recorder:
        recorder.write(log)
    frames, report = told(tmp_path / "log.mcap"), evaluate(log)

    (shown,) = (frame["nees"] for frame in frames if frame["k"] == "map" and frame["final"])
    assert report.map.errors.count == LANDMARKS - 1
    assert shown == pytest.approx(report.map.errors.nees_per_dof, rel=1e-6)
    for name, robot in report.robots.items():
        rows = np.array([v for f in frames if f["k"] == "err" and f["r"] == name for v in f["v"]])
        np.testing.assert_allclose(rows.reshape(-1, 7)[:, 6], robot.online.nees / 3.0, rtol=1e-6)


def test_the_page_gets_the_maps_and_how_they_fit(frames, samples):
    """A running map without cross-covariances has no NEES."""
    *running, final = frames["map"]
    assert len(running) + 1 == sum(s.key in ("central/map", "central/final") for s in samples)
    assert {each["nees"] for each in running} == {None}
    assert all(each["rmse"] is not None for each in running)
    assert final["final"]
    assert len(np.frombuffer(base64.b64decode(final["ids"]), "<u4")) == LANDMARKS
    assert 0.05 < final["rmse"] < 0.3
    assert 0.5 < final["nees"] < 2.0


def test_the_page_is_told_every_byte_by_key(frames, samples):
    found, said = Counter(), Counter()
    for frame in frames["bytes"]:
        for key, _, messages, size in frame["v"]:
            found.update({(key, "messages"): messages, (key, "bytes"): size})
    for sample in samples:
        said.update({(sample.key, "messages"): 1, (sample.key, "bytes"): len(sample.payload)})
    assert found == said


def test_an_event_is_at_the_time_of_what_it_is_about(samples, tmp_path):
    ended = m.End(stamp_ns=SECONDS * 10**9, streams=())
    early = [*samples[:8], Sample(ch.END.key(), encoded(ended), ended.stamp_ns, 0, 0), *samples[8:]]
    with Recorder(tmp_path / "early.mcap", "crowd", {}) as recorder:
        recorder.write(early)
    times = {f["x"]: f["t"] for f in told(tmp_path / "early.mcap") if f["k"] == "ev"}
    assert times["the world has ended"] == SECONDS
    assert times["r1 is in the team's map"] == 4.8


def test_the_page_gets_the_changes_since_the_saved_map_with_the_old_places():
    changes = (
        m.LandmarkChange(landmark=3, state="unchanged", dx=0.01, sigma=0.02, chi2=0.3),
        m.LandmarkChange(landmark=4, state="moved", dx=0.5, dy=-0.25, sigma=0.125, chi2=17.0),
        m.LandmarkChange(landmark=7, state="gone", expected=9.5),
        m.LandmarkChange(landmark=8, state="new"),
    )
    fused = fused_map(
        final=True, changes=changes, ids=[3, 4, 7, 8],
        means=np.arange(8.0), covariance=[1.0, 0.0, 1.0] * 4
    )  # fmt: skip
    plain = msgspec.structs.replace(fused, changes=())
    shown, without = (
        next(each for each in told_of((ch.FINAL_MAP, of)) if each["k"] == "map")
        for of in (fused, plain)
    )
    assert shown["changes"] == {
        "unchanged": 1,
        "rows": [
            [4, "moved", 1.5, 3.25, 0.5, -0.25, 0.125, 17.0, 0.0],
            [7, "gone", 4.0, 5.0, 0.0, 0.0, 0.0, 0.0, 9.5],
            [8, "new", 6.0, 7.0, 0.0, 0.0, 0.0, 0.0, 0.0],
        ],
    }
    assert "changes" not in without


MAP_FROM_TRUTH = np.array([3.0, -2.0, 0.7])
TRUE = np.array([[0.0, 0.0], [4.0, 1.0], [2.0, 5.0]])


def in_an_arbitrary_frame(
    *, landmarks: bool = True, known: bool = False, at_ends: bool = False
) -> list[tuple[ch.Channel, m.Message]]:
    heading = np.zeros((3, 1))
    true_path = np.hstack((TRUE + 1.0, heading))
    path = np.hstack((transform_points(MAP_FROM_TRUTH, TRUE + 1.0), heading + MAP_FROM_TRUTH[2]))
    at = from_stamps(np.arange(3) * 10**9)
    fused = fused_map(
        stamp_ns=2 * 10**9, final=True, frame="r1/1", ids=[1, 2, 3],
        means=transform_points(MAP_FROM_TRUTH, TRUE),
        covariance=[1.0, 0.0, 1.0] * 3
    )  # fmt: skip
    start = build.initial_pose(pose=from_floats(np.zeros(3)) if known else b"")
    truth = m.TruthLandmarks(stamp_ns=0, ids=from_ids([1, 2, 3]), positions=from_floats(TRUE))
    crosses = np.zeros((3, 9)) if at_ends else b""
    return [
        (ch.START, start),
        *([(ch.TRUTH_LANDMARKS, truth)] if landmarks else []),
        (ch.TRUTH, build.truth(stamps=at, poses=true_path)),
        (ch.TEAM_POSE, at_origin(2, frame="r1/1")),
        (ch.TRAJECTORY, build.trajectory(stamps=at, poses=path, crosses=crosses)),
        (ch.FINAL_MAP, fused),
    ]


def entities_of(view: str, messages: list[tuple[ch.Channel, m.Message]]) -> dict[str, Any]:
    """What Foxglove shows at last, by name."""
    node = ViewerNode()
    views = [each for message in messages for each in node.handle(*message)]
    scenes = [SceneUpdate.FromString(each.payload) for each in views if each.key == view]
    return {each.id: each for each in scenes[-1].entities}


def places_of(shapes: Iterable[Any]) -> list[tuple[float, float]]:
    return [(each.pose.position.x, each.pose.position.y) for each in shapes]


@pytest.mark.parametrize("landmarks", [True, False])
def test_the_truth_is_aligned_with_a_map_in_an_arbitrary_frame(landmarks):
    told = told_of(*in_an_arbitrary_frame(landmarks=landmarks))
    before, of_map = (each for each in told if each["k"] == "align")
    assert before == {"k": "align", "f": None, "v": None}
    assert of_map["f"] == next(each["f"] for each in told if each["k"] == "map") == "r1/1"
    assert of_map["v"] == pytest.approx(MAP_FROM_TRUTH)


def test_the_truth_is_not_moved_in_its_own_frame_and_without_an_alignment_left_out():
    told = told_of(*in_an_arbitrary_frame(known=True))
    assert not [each for each in told if each["k"] == "align"]
    without = [
        each for each in in_an_arbitrary_frame(landmarks=False) if each[0] is not ch.TRAJECTORY
    ]
    assert [each["v"] for each in told_of(*without) if each["k"] == "align"] == [None, None]


@pytest.mark.parametrize(("known", "moved"), [(False, True), (True, False)])
def test_foxgloves_true_landmarks_are_in_the_frame_of_the_map(known, moved):
    true = entities_of("view/map", in_an_arbitrary_frame(known=known))["true landmarks"]
    expected = transform_points(MAP_FROM_TRUTH, TRUE) if moved else TRUE
    np.testing.assert_allclose(places_of(true.cubes), expected)


@pytest.mark.parametrize("at_ends", [True, False])
def test_smoothed_poses_at_ends_of_submaps_are_dots_and_those_at_keyframes_a_line(at_ends):
    log = in_an_arbitrary_frame(at_ends=at_ends)
    (path,) = (each for each in told_of(*log) if each["k"] == "path")
    assert path["ends"] is at_ends
    entities = entities_of("view/paths", log)
    assert ("smoothed path r1" in entities) is not at_ends
    if at_ends:
        dots = entities["smoothed poses r1"]
        expected = transform_points(MAP_FROM_TRUTH, TRUE + 1.0)
        np.testing.assert_allclose(places_of(dots.cylinders), expected)
        assert not dots.lines


def test_a_submap_and_a_prior_are_links_to_and_from_the_centre():
    page = PageFrames()
    for channel in (ch.SUBMAP, ch.OWN_MAP, ch.PRIOR):
        page.count(Sample(channel.key("r1"), b"", 10**9, 0, 0))
    told = [json.loads(frame) for frame in page.flush()]
    found = [(each["a"], each["b"]) for each in told if each["k"] == "link"]
    assert found == [("r1", "central"), ("central", "r1")]


def test_a_damaged_chunk_costs_the_page_no_more_than_itself(log, tmp_path):
    data = bytearray(log.read_bytes())
    with log.open("rb") as file:
        chunks = make_reader(file).get_summary().chunk_indexes
    chunk = chunks[len(chunks) // 2]
    data[chunk.chunk_start_offset + chunk.chunk_length // 2] ^= 0xFF
    (tmp_path / "damaged.mcap").write_bytes(data)
    found = told(tmp_path / "damaged.mcap")
    assert found[-1]["k"] == "eof"
    assert found[-2]["x"].startswith(
        "1 damaged parts of the log were left out; `teamslam log check"
    )


# The tail of a log.


def test_the_tail_of_a_growing_log_gives_each_sample_once_in_order(log, samples, tmp_path):
    path = tmp_path / "growing.mcap"
    tail = Tail(path)
    assert tail.more() == []
    data = log.read_bytes()
    got: list[Sample] = []
    with path.open("wb") as file:
        for begin in range(0, len(data), 9_973):
            file.write(data[begin : begin + 9_973])
            file.flush()
            got += tail.more()
    while more := tail.more():
        got += more
    assert tail.ended
    assert [(s.key, s.payload) for s in got] == [(s.key, s.payload) for s in samples]


def test_the_tail_of_what_is_no_log_says_so(tmp_path):
    path = tmp_path / "no.mcap"
    path.write_bytes(b"no log" * 20_000)
    with pytest.raises(LogError, match="not an MCAP file"):
        Tail(path).more()


# The server.


@pytest.fixture(scope="module")
def shown(log):
    with session(log, "127.0.0.1", 0, 0, growing=False) as found:
        wait_until(lambda: found.feed.ended, what="the log is read")
        yield found


def asked(
    shown: Shown, path: str, at: str | None = None, **headers: str
) -> tuple[int, bytes, dict[str, str]]:
    at = urlsplit(at or shown.url)
    connection = HTTPConnection(at.hostname, at.port, timeout=60)
    try:
        connection.request("GET", path, headers=headers)
        answer = connection.getresponse()
        return answer.status, answer.read(), dict(answer.getheaders())
    finally:
        connection.close()


@pytest.mark.parametrize("path", sorted(page_files()))
def test_every_file_of_the_page_is_served(shown, path):
    status, body, headers = asked(shown, path)
    assert status == 200
    name = "index.html" if path == "/" else path[1:]
    assert body == (PAGE / name).read_bytes()
    assert "default-src 'self'" in headers["Content-Security-Policy"]


def test_the_page_names_nothing_beyond_itself():
    named = {
        url
        for path in PAGE.iterdir()
        for url in re.findall(r"""(?:https?:)?//[\w.-]+\.\w+[^\s"'`]*""", path.read_text())
    }
    assert named <= {"http://www.w3.org/2000/svg"}


@pytest.mark.parametrize("path", ["/../server.py", "/server.py", "/..%2fserver.py", "/nothing"])
def test_other_files_are_not_served(shown, path):
    assert asked(shown, path)[0] == 404


def test_a_request_under_another_name_is_refused(shown):
    assert asked(shown, "/", Host="elsewhere.example")[0] == 403


def test_the_stream_is_for_the_page_itself(shown):
    url = shown.url.replace("http", "ws") + "stream"
    with connect(url, origin=shown.url.rstrip("/")) as socket:
        assert json.loads(socket.recv(timeout=60))[0]["k"] == "hello"
    with pytest.raises(InvalidStatus, match="403"):
        connect(url, origin="http://elsewhere.example")


def test_a_port_that_is_taken_is_told_with_a_remedy(log):
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        words = rf":{port}: Address already in use; choose another --"
        for ports in ((port, 0), (0, port)):
            with (
                pytest.raises(ServerError, match=words),
                session(log, "127.0.0.1", *ports, growing=False),
            ):
                pass


def test_a_second_view_gives_foxglove_a_free_port_and_says_so(log, monkeypatch, capsys):
    with socket.create_server(("127.0.0.1", 0)) as other:
        taken = other.getsockname()[1]
        monkeypatch.setattr(view, "FOXGLOVE_PORT", taken)
        with view.show_on_page(log, "127.0.0.1", 0, None, browser=False, growing=False) as shown:
            assert urlsplit(shown.foxglove).port not in (taken, None)
    said = capsys.readouterr().out
    assert f"{shown.foxglove}   ({taken} is taken; --foxglove-port chooses another)" in said
    with view.show_on_page(log, "127.0.0.1", 0, None, browser=False, growing=False) as shown:
        assert urlsplit(shown.foxglove).port == taken
    assert "is taken" not in capsys.readouterr().out


@pytest.mark.parametrize("host", ["nowhere.invalid", "192.0.2.1"])
def test_an_address_that_is_not_of_this_machine_is_told_by_its_option(log, host):
    with (
        pytest.raises(ServerError, match=rf"--host {host}: .*; give an address of this machine"),
        session(log, host, 0, None, growing=False),
    ):
        pass


def test_a_log_that_comes_later_is_shown_when_it_is_there(log, tmp_path):
    path = tmp_path / "later.mcap"
    feed = Feed(Tail(path))
    with serving(feed, "127.0.0.1", 0, growing=True) as shown:
        with connect(shown.url.replace("http", "ws") + "stream") as socket:
            path.write_bytes(log.read_bytes())
            assert json.loads(socket.recv(timeout=60))[0]["k"] == "hello"
        wait_until(lambda: feed.ended, what="the log is read")
        assert json.loads(feed.frames[-1]) == {"k": "eof", "complete": True}


# Foxglove.


def foxglove(shown: Shown) -> AbstractContextManager:
    return connect(shown.foxglove, subprotocols=["foxglove.sdk.v1"])


def offered(socket, count: int) -> list[dict[str, str]]:
    channels: list[dict[str, str]] = []
    while len(channels) < count:
        said = json.loads(socket.recv(timeout=60))
        channels += said.get("channels", [])
    return channels


@pytest.mark.parametrize("growing", [False, True])
def test_foxglove_is_offered_every_view_and_receives_the_newest_at_once(log, tmp_path, growing):
    path = tmp_path / "grown.mcap"
    path.write_bytes(log.read_bytes())
    with session(path, "127.0.0.1", 0, 0, growing=growing) as found:
        wait_until(lambda: found.feed.ended, what="the log is read")
        with foxglove(found) as socket:
            socket.recv(timeout=60)
            numbers = {c["topic"]: c["id"] for c in offered(socket, 13)}
            assert {"team/crowd/view/map", "team/crowd/view/pose/r3"} <= set(numbers)
            number = numbers["team/crowd/view/team"]
            wish = {"id": 1, "channelId": number}
            socket.send(json.dumps({"op": "subscribe", "subscriptions": [wish],
                                    "channels": [wish | {"id": number}]}))  # fmt: skip
            while True:
                said = socket.recv(timeout=60)
                if isinstance(said, bytes) and b"landmarks" in said:
                    break
        assert json.loads(said[said.index(b"{") :])["landmarks"] == LANDMARKS


def test_foxglove_is_for_viewers_of_this_machine(shown):
    for origin in ("https://app.foxglove.dev", "http://localhost:8080", None):
        with connect(shown.foxglove, origin=origin, subprotocols=["foxglove.sdk.v1"]) as socket:
            assert json.loads(socket.recv(timeout=60))["op"] == "serverInfo"
    for origin in ("http://elsewhere.example", "https://app.foxglove.dev.example", "null"):
        with pytest.raises(InvalidStatus, match="403"):
            connect(shown.foxglove, origin=origin, subprotocols=["foxglove.sdk.v1"])
    at = shown.foxglove.replace("ws:", "http:") + "/"
    assert asked(shown, "/", at=at, Host="elsewhere.example")[0] == 403


def test_without_foxgloves_sdk_the_page_is_served_and_its_port_names_the_extra(log, monkeypatch):
    with session(log, "127.0.0.1", 0, None, growing=False) as shown:
        assert asked(shown, "/")[0] == 200
        assert shown.foxglove == ""
    monkeypatch.setattr(view, "find_spec", lambda _: None)
    said = output_of("view", log, "--foxglove-port", "0", status=2)
    assert "--foxglove-port needs Foxglove's SDK" in said
    assert "pip install" in said


@pytest.mark.parametrize(
    ("at", "host", "origins", "let_in"),
    [
        ("127.0.0.1", "127.0.0.1:8765", [], True),
        ("::1", "[::1]:8765", ["http://[::1]:80"], True),
        ("127.0.0.1", "elsewhere.example:8765", [], False),
        ("127.0.0.1", "", [], False),
        ("0.0.0.0", "lab.example:8765", ["http://lab.example:8765"], True),
        ("0.0.0.0", "lab.example:8765", ["http://elsewhere.example"], False),
        ("0.0.0.0", "", ["null"], False),
        ("127.0.0.1", "localhost:1", ["http://localhost", "http://elsewhere.example"], False),
    ],
)
def test_foxgloves_proxy_checks_host_and_origin(at, host, origins, let_in):
    assert (refusal(at, host, origins, VIEWERS) is None) == let_in


# The layout.


def test_the_layout_names_only_topics_that_there_are(samples):
    text = layout("crowd", ["r1", "r2", "r3"])
    there = {f"team/crowd/{s.key}" for s in with_views(samples) if ch.VIEW.owner(s.key) is not None}
    named = set(re.findall(r"team/crowd/view/[\w/]+", text))
    optional = {f"team/crowd/view/particles/r{i}" for i in (1, 2, 3)}
    assert named - optional <= there
    assert {"team/crowd/view/map", "team/crowd/view/robot/r3", "team/crowd/view/log"} <= named


@pytest.mark.parametrize(
    "text",
    [
        "x",
        "[]",
        '{"sensor": 5}',
        '{"sensor": {"mount": "abc"}}',
        '{"sensor": {"mount": [1, 2]}}',
        '{"a": ' + 100_000 * "[" + 100_000 * "]" + "}",
    ],
)
def test_a_robots_configuration_that_is_not_one_leaves_its_measurements_unmounted(text):
    config = build.configuration(node="robot/r1", configuration=text)
    seen = build.observations(stamp_ns=5, robot="r1", ids=[1], ranges=[2.0], bearings=[0.0])
    told = told_of((ch.ROBOT_CONFIG, config), (ch.OBSERVATIONS, seen))
    assert not [each for each in told if each["k"] == "sensor"]
    assert [each["v"] for each in told if each["k"] == "see"] == [[1, 2.0, 0.0]]
