import math
from collections.abc import Iterator

import numpy as np
import pytest
import zenoh
from rosbags.highlevel import AnyReader

from teamslam.central.desk.export.rosbag2 import export_rosbag2
from teamslam.central.desk.paths import smoothed_paths
from teamslam.central.desk.verification.recorded import index_log
from teamslam.team.ros2.decoding import types
from teamslam.team.ros2.encoding import compose, ellipse, inverse, names_of
from teamslam.team.ros2.keys import of_rmw, of_token, publication
from teamslam.team.ros2.topics import RobotTopics
from teamslam.team.ros2_answers import Answer, Answers, LiveAnswers, RosPublisher
from teamslam.team.translate import landmark_blocks_of
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.arrays import from_floats, from_ids
from teamslam.team.wire.bus import Sample
from teamslam.team.wire.codec import encoded
from teamslam.team.wire.zenoh.foreign_keys import ForeignKeys
from tests.scenarios import with_world
from tests.sim.reruns import team_samples, thesis, written
from tests.support import example, packed, spd, wait_until

S = 10**9
PUBLISHED = {
    "tf2_msgs/msg/TFMessage": "e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087",
    "geometry_msgs/msg/PoseWithCovarianceStamped": (
        "26432f9803e43727d3c8f668d1fdb3c630f548af631e2f4e31382371bfea3b6e"
    ),
    "nav_msgs/msg/Path": "1957a5bb3cee5da65c4e52e52b65a93df227efce4c20f8458b36e73066ca334b",
    "nav_msgs/msg/Odometry": "3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0",
    "visualization_msgs/msg/MarkerArray": (
        "86cb8800b6fb05b5eff1abd7a56f62a5641d3ae9a1c29e78e67e704f1d067dcf"
    ),
    "vision_msgs/msg/Detection3DArray": (
        "793f5eab9595ac1c0da07873cc859db42eae51f0ee76056db8562515d830e018"
    ),
    "diagnostic_msgs/msg/DiagnosticArray": (
        "5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e"
    ),
    "geometry_msgs/msg/PoseStamped": (
        "10f3786d7d40fd2b54367835614bff85d4ad3b5dab62bf8bca0cc232d73b4cd8"
    ),
}
"""Type hashes (REP 2016) that `ros2 topic info --verbose` shows on ROS 2 Jazzy."""
NAMES = names_of("r1", "/r1/odom", "odom", "base_link")


def posed(stamp_ns: int, pose: tuple[float, float, float], *, inside: bool = True):
    P = from_floats(np.diag([0.04, 0.09, 0.01]))
    given = {"pose": from_floats(pose), "covariance": P, "in_team_frame": inside}
    return example(m.PoseEstimate, stamp_ns=stamp_ns, robot="r1", **given)


def decoded(answer):
    return types().deserialize_cdr(answer.data, answer.kind)


def by_topic(answers):
    return {answer.topic: answer for answer in answers}


def test_map_from_odom_takes_the_odometry_s_pose_to_the_pose_in_the_map():
    answers = Answers(NAMES)
    answers.add_odometry(1 * S, (1.0, 0.0, 0.0))
    answers.add_odometry(2 * S, (2.0, 0.0, 0.2))
    out = by_topic(answers.convert(posed(int(1.5 * S), (10.0, 5.0, math.pi / 2))))
    (found,) = decoded(out["/r1/tf"]).transforms
    assert (found.header.frame_id, found.child_frame_id) == ("map", "odom")
    turn = 2.0 * math.atan2(found.transform.rotation.z, found.transform.rotation.w)
    at = found.transform.translation.x, found.transform.translation.y, turn
    half_way = compose(inverse((0.0, 0.0, 0.0)), (1.5, 0.0, 0.1))
    np.testing.assert_allclose(compose(at, half_way), (10.0, 5.0, math.pi / 2), atol=1e-12)


def test_a_pose_outside_of_the_team_s_frame_is_not_published_and_the_last_transform_stays():
    answers = Answers(NAMES)
    answers.add_odometry(1 * S, (1.0, 0.0, 0.0))
    assert answers.transform(1 * S) == []
    answers.convert(posed(1 * S, (3.0, 0.0, 0.0)))
    assert answers.convert(posed(2 * S, (90.0, 90.0, 0.0), inside=False)) == []
    (kept,) = answers.transform(2 * S)
    assert decoded(kept).transforms[0].transform.translation.x == pytest.approx(2.0)


def test_a_pose_without_odometry_at_its_time_has_no_transform():
    answers = Answers(NAMES)
    answers.add_odometry(5 * S, (0.0, 0.0, 0.0))
    assert "/r1/tf" not in by_topic(answers.convert(posed(1 * S, (3.0, 0.0, 0.0))))


def test_a_pose_has_its_covariance_in_six_dimensions():
    out = by_topic(Answers(NAMES).convert(posed(3 * S + 7, (3.0, -2.0, 1.0))))
    found = decoded(out["/r1/team_pose"])
    assert (found.header.frame_id, found.header.stamp.sec, found.header.stamp.nanosec) == (
        "map", 3, 7,
    )  # fmt: skip
    P = found.pose.covariance.reshape(6, 6)
    assert P[0, 0] == 0.04
    assert P[1, 1] == 0.09
    assert P[5, 5] == 0.01
    assert np.count_nonzero(P) == 3


def test_landmarks_have_ellipses_of_two_sigma_and_their_ids():
    fused = example(m.FusedMap)
    out = by_topic(Answers(NAMES).convert(fused))
    markers = decoded(out["/r1/team_landmarks"]).markers
    assert markers[0].action == 3, "the landmarks of the map before are deleted first"
    drawn = [each for each in markers if each.ns == "landmarks" and each.action == 0]
    major, minor, _ = ellipse(landmark_blocks_of(fused)[0])
    assert (drawn[0].scale.x, drawn[0].scale.y) == (major, minor)
    named = decoded(out["/r1/team_map"]).detections
    assert [each.id for each in named] == ["4", "7"]
    block = named[1].results[0].pose.covariance.reshape(6, 6)[:2, :2]
    np.testing.assert_array_equal(block, landmark_blocks_of(fused)[1])
    assert all(out[topic].latched for topic in ("/r1/team_landmarks", "/r1/team_map"))


@pytest.mark.parametrize("joint", [True, False])
def test_a_landmark_s_block_is_that_of_the_packed_covariance(joint):
    P, ids = spd(6), from_ids([1, 2, 3])
    blocks = np.array([P[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] for k in range(3)])
    data = packed(P) if joint else from_floats(blocks[:, [0, 0, 1], [0, 1, 1]])
    changed = {"ids": ids, "means": from_floats(range(6)), "covariance": data, "joint": joint}
    np.testing.assert_array_equal(landmark_blocks_of(example(m.FusedMap, **changed)), blocks)


@pytest.mark.parametrize(
    ("topic", "frame", "namespace", "tf"),
    [
        ("/odom", "odom", "/r1", "/tf"),
        ("/alpha/odom", "alpha/odom", "/alpha", "/tf"),
        ("/alpha/odom", "odom", "/alpha", "/alpha/tf"),
    ],
)
def test_a_robot_s_topics_are_beside_its_odometry(topic, frame, namespace, tf):
    names = names_of("r1", topic, frame, "base_link")
    assert (names.namespace, names.tf) == (namespace, tf)


@pytest.mark.parametrize(
    ("latched", "of_rmw_zenoh", "of_bridge"),
    [(False, "::,10:,:,:,,", ":1:0:0,10:"), (True, ":1:,1:,:,:,,", ":1:1:0,1:")],
)
def test_the_graph_has_the_quality_of_service(latched, of_rmw_zenoh, of_bridge):
    about = {"domain": 3, "node": "n", "session": "abc", "entity": 4, "latched": latched}
    keys = publication("/r1/team_path", "nav_msgs/msg/Path", "RIHS01_0", **about)
    assert keys.tokens[1].endswith(f"/nav_msgs::msg::dds_::Path_/RIHS01_0/{of_rmw_zenoh}")
    assert f"/nav_msgs§msg§Path/{of_bridge}typehash=RIHS01_0;" in keys.tokens[3]


def test_every_answer_is_on_the_clock_of_the_robot_s_messages():
    """With use_sim_time that clock is a simulator's."""
    live = LiveAnswers("r1", RobotTopics(odometry="/r1/odom"))
    live.add_odometry(7 * S, (1.0, 0.0, 0.0), "odom", "base_link")
    for message in (
        posed(7 * S, (2.0, 0.0, 0.0)),
        example(m.FusedMap, stamp_ns=7 * S),
        example(m.Status, node="r1", stamp_ns=7 * S),
    ):
        live.add_message(message)
    published = list[Answer]()

    class Publisher(RosPublisher):
        def __init__(self):
            pass

        def publish(self, answer):
            published.append(answer)

    live.publish(Publisher())
    assert len({each.topic for each in published}) == 6

    def stamps(value) -> Iterator[int]:
        if getattr(value, "__msgtype__", "") == "std_msgs/msg/Header" and value.frame_id:
            yield value.stamp.sec * S + value.stamp.nanosec
        for each in value if isinstance(value, list) else getattr(value, "__dict__", {}).values():
            yield from stamps(each)

    assert {stamp for each in published for stamp in stamps(decoded(each))} == {7 * S}
    assert {each.stamp_ns for each in published} == {7 * S}


def test_answers_reach_subscribers_of_rmw_zenoh_and_of_a_bridge_with_their_types(network):
    router, endpoint = network
    live = LiveAnswers("r1", RobotTopics(odometry="/r1/odom"))
    with (
        ForeignKeys(endpoint, [], []) as session,
        router.declare_subscriber("0/**") as by_rmw,
        router.declare_subscriber("r1/**") as by_bridge,
    ):
        publisher = RosPublisher(session, "teamslam_r1", 0)
        live.add_odometry(1 * S, (1.0, 0.0, 0.0), "odom", "base_link")
        live.add_message(posed(1 * S, (2.0, 0.0, 0.0)))
        live.publish(publisher)
        found: dict[str, zenoh.Sample] = {}

        def complete() -> bool:
            for subscriber in (by_rmw, by_bridge):
                while (sample := subscriber.try_recv()) is not None:
                    found[str(sample.key_expr)] = sample
            return len(found) >= 6

        wait_until(complete)
        (key,) = (each for each in found if each.startswith("0/r1/team_pose/"))
        assert of_rmw(key, 0) == ("/r1/team_pose", "geometry_msgs/msg/PoseWithCovarianceStamped")
        assert key.rpartition("/")[2] == types().hash_rihs01(of_rmw(key, 0)[1])
        assert found[key].payload.to_bytes() == found["r1/team_pose"].payload.to_bytes()
        assert len(found[key].attachment.to_bytes()) == 33
        tokens = {str(reply.ok.key_expr) for reply in router.liveliness().get("@/*/@ros2_lv/MP/**")}
        assert ("/r1/team_pose", "geometry_msgs/msg/PoseWithCovarianceStamped") in {
            of_token(each) for each in tokens
        }
        graph = {str(reply.ok.key_expr) for reply in router.liveliness().get("@ros2_lv/**")}
        assert any("/MP/%/%/teamslam_r1/%r1%team_pose/" in each for each in graph)
        assert any(each.endswith("/NN/%/%/teamslam_r1") for each in graph)


def test_a_late_subscriber_receives_the_newest_path_and_map(network):
    _, endpoint = network
    with ForeignKeys(endpoint, [], []) as session:
        publisher = RosPublisher(session, "teamslam_r1", 0)
        for answer in Answers(NAMES).convert(posed(1 * S, (2.0, 0.0, 0.0))):
            publisher.publish(answer)
        topics = ["0/r1/team_path/*/*"]
        with ForeignKeys(endpoint, [], [], latched=topics) as late:
            received: list[str] = []

            def came() -> bool:
                received.extend(each.key for each in late.receive(0.05))
                return bool(received)

            wait_until(came)
    assert received[0].startswith("0/r1/team_path/nav_msgs::msg::dds_::Path_/RIHS01_")


def test_type_hashes_are_those_of_ros():
    assert {kind: types().hash_rihs01(kind) for kind in PUBLISHED} == {
        kind: f"RIHS01_{of}" for kind, of in PUBLISHED.items()
    }


@pytest.mark.parametrize("is_known", [True, False], ids=["known start", "arbitrary frame"])
def test_a_bag_has_its_types_and_qualities_of_service_and_its_truth_lies_at_the_paths(
    tmp_path, is_known
):
    scenario = thesis(45)
    if not is_known:
        scenario = with_world(scenario, unknown_starts=("r1", "r2"))
    bag = tmp_path / "bag"
    status = example(m.Status, node="r1")
    state = Sample(ch.STATUS.key("r1"), encoded(status), status.stamp_ns, 0, 0)
    samples = [*team_samples(scenario), state]
    export_rosbag2(written(tmp_path / "log.mcap", samples), bag)
    with AnyReader([bag]) as reader:
        assert {each.msgtype for each in reader.connections} == PUBLISHED.keys()
        assert {
            each.topic.rpartition("/")[2]: (q.reliability.name, q.durability.name, q.depth)
            for each in reader.connections
            for q in each.ext.offered_qos_profiles
            if q.durability.name != "VOLATILE"
        } == dict.fromkeys(
            ("team_path", "smoothed_path", "team_landmarks", "team_map", "tf_static"),
            ("RELIABLE", "TRANSIENT_LOCAL", 1),
        )
        read = [
            (each.topic, stamp, reader.deserialize(data, each.msgtype))
            for each, stamp, data in reader.messages()
        ]

    def planar(topic: str, pose_of) -> dict[int, tuple[float, float, float]]:
        posed = {stamp: pose_of(message) for at, stamp, message in read if at == topic}
        return {
            stamp: (each.position.x, each.position.y, heading(each.orientation))
            for stamp, each in posed.items()
        }

    def heading(turned) -> float:
        return 2.0 * math.atan2(turned.z, turned.w)

    (moved,) = (message.transforms[0].transform for at, _, message in read if at == "/tf_static")
    world_from_map = moved.translation.x, moved.translation.y, heading(moved.rotation)
    assert (world_from_map == (0.0, 0.0, 0.0)) == is_known
    true = planar("/r1/ground_truth", lambda message: message.pose)
    smoothed = planar("/r1/smoothed_pose", lambda message: message.pose.pose)
    both = true.keys() & smoothed.keys()
    assert len(both) > 40
    moved = [np.subtract(compose(world_from_map, smoothed[t]), true[t])[:2] for t in both]
    assert np.sqrt(np.mean(np.square(moved))) < 1.0
    apart = [np.subtract(smoothed[t], true[t])[:2] for t in both]
    assert (np.sqrt(np.mean(np.square(apart))) < 1.0) == is_known
    assert {m.header.frame_id for t, _, m in read if t == "/r1/ground_truth"} == {"world"}


def test_a_log_becomes_a_bag_that_another_reader_opens(tmp_path):
    log = written(tmp_path / "log.mcap", team_samples(thesis(45)))
    counts = export_rosbag2(log, tmp_path / "bag")
    with AnyReader([tmp_path / "bag"]) as reader:
        read = {each.topic: each for each in reader.connections}
        assert {topic: each.msgcount for topic, each in read.items()} == counts
        assert all(each.msgdef.data for each in read.values()), "definitions are embedded"
        poses = [
            reader.deserialize(data, each.msgtype)
            for each, _, data in reader.messages([read["/r1/team_pose"]])
        ]
        assert {pose.header.frame_id for pose in poses} == {"map"}
        smoothed = [
            (stamp, reader.deserialize(data, each.msgtype).pose.pose.position)
            for each, stamp, data in reader.messages([read["/r1/smoothed_pose"]])
        ]
        frames = {
            (t.header.frame_id, t.child_frame_id)
            for each, _, data in reader.messages([read["/tf"]])
            for t in reader.deserialize(data, each.msgtype).transforms
        }
    path = smoothed_paths(index_log(log))["r1"]
    assert [stamp for stamp, _ in smoothed] == path.stamps_ns.tolist()
    assert [[at.x, at.y] for _, at in smoothed] == path.poses[:, :2].tolist()
    assert frames == {
        (parent, child)
        for robot in ("r1", "r2")
        for parent, child in (("map", f"{robot}/odom"), (f"{robot}/odom", f"{robot}/base_link"))
    }
