import random
from typing import Any

import numpy as np
import pytest

from teamslam.team.ros2 import decoding as d
from teamslam.team.ros2.frames import BODY, Frames, heading
from teamslam.team.ros2.topics import RobotTopics
from teamslam.team.ros2.translator import Pose, Seen, Speeds, Translator
from tests.ros2 import messages as ros

AT = 1_700_000_000_123_456_789
T = ros.T
ODOMETRY = "nav_msgs/msg/Odometry"
COVARIANCE = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]).ravel()
OPTICAL = (-0.5, 0.5, -0.5, 0.5)  # x ahead, y left, z up → a camera's x right, y down, z ahead


def samples() -> dict[str, Any]:
    posed = ros.pose(1.0, 2.0, 3.0, yaw=0.5)
    head = ros.header(AT, "camera")
    stamped = T["geometry_msgs/msg/PoseWithCovarianceStamped"](
        header=head, pose=ros.with_covariance(posed, COVARIANCE)
    )
    point = T["geometry_msgs/msg/Point"](x=0.0, y=0.0, z=0.0)
    twist = T["geometry_msgs/msg/Twist"](linear=ros.vector(1.5), angular=ros.vector(z=-0.5))
    isaac = "isaac_ros_apriltag_interfaces/msg/AprilTagDetection"
    return {
        "nav_msgs/msg/Odometry": ros.odometry(AT, posed, 1.5, -0.5),
        "geometry_msgs/msg/TwistStamped": T["geometry_msgs/msg/TwistStamped"](
            header=head, twist=twist
        ),
        "geometry_msgs/msg/PoseStamped": T["geometry_msgs/msg/PoseStamped"](
            header=head, pose=posed
        ),
        "geometry_msgs/msg/PoseWithCovarianceStamped": stamped,
        "geometry_msgs/msg/TransformStamped": ros.transforms(
            (AT, "camera", "tag36h11:7", ros.vector(1, 2, 3), (0.0, 0.0, 0.0, 1.0))
        ).transforms[0],
        "tf2_msgs/msg/TFMessage": ros.transforms(
            (AT, "camera", "tag36h11:7", ros.vector(1, 2, 3), (0.0, 0.0, 0.0, 1.0))
        ),
        "vision_msgs/msg/Detection3DArray": ros.detections(AT, "camera", [("7", posed)]),
        f"{isaac}Array": T[f"{isaac}Array"](
            header=head,
            detections=[
                T[isaac](family="36h11", id=7, center=point, corners=[point] * 4, pose=stamped)
            ],
        ),
        "sensor_msgs/msg/NavSatFix": ros.fix(AT, "gps", (48.745, 9.105), (1.0, 0.2, 2.0)),
        "aruco_opencv_msgs/msg/ArucoDetection": T["aruco_opencv_msgs/msg/ArucoDetection"](
            header=head,
            markers=[T["aruco_opencv_msgs/msg/MarkerPose"](marker_id=7, pose=posed)],
            boards=[],
        ),
        "ros2_aruco_interfaces/msg/ArucoMarkers": T["ros2_aruco_interfaces/msg/ArucoMarkers"](
            header=head, marker_ids=np.array([7], np.int64), poses=[posed]
        ),
        "aruco_msgs/msg/MarkerArray": T["aruco_msgs/msg/MarkerArray"](
            header=head,
            markers=[
                T["aruco_msgs/msg/Marker"](
                    header=head, id=7, pose=ros.with_covariance(posed, COVARIANCE), confidence=1.0
                )
            ],
        ),
    }


SAMPLES = samples()


@pytest.mark.parametrize("kind", SAMPLES)
def test_each_type_is_decoded(kind):
    record = d.decode(kind, ros.cdr(kind, SAMPLES[kind]))
    match record:
        case d.OdometryRecord():
            assert (record.forward, record.yaw_rate, record.position) == (1.5, -0.5, (1, 2, 3))
            assert heading(record.rotation) == pytest.approx(0.5)
        case d.SpeedRecord():
            assert (record.forward, record.yaw_rate) == (1.5, -0.5)
        case d.PoseRecord():
            assert record.position == (1.0, 2.0, 3.0)
        case d.TransformsRecord():
            assert record.transforms[0].child == "tag36h11:7"
            assert record.transforms[0].stamp_ns == AT
        case d.TagsRecord():
            (tag,) = record.tags
            assert (tag.name, tag.position, record.frame) == ("7", (1.0, 2.0, 3.0), "camera")
            assert tag.covariance in (None, (1, 0, 0, 0, 2, 0, 0, 0, 3))
        case d.FixRecord():
            assert (record.degrees, record.covariance) == ((48.745, 9.105), (1.0, 0.2, 2.0))
            assert record.frame == "gps"
    assert getattr(record, "stamp_ns", AT) == AT


@pytest.mark.parametrize("kind", SAMPLES)
def test_damaged_bytes_are_an_error_and_nothing_else(kind):
    chance = random.Random(kind)
    sound = ros.cdr(kind, SAMPLES[kind])
    refused = 0
    for _ in range(150):
        data = bytearray(sound)
        for _ in range(chance.randint(1, 4)):
            data[chance.randrange(len(data))] = chance.randrange(256)
        cut = data[: chance.randrange(len(data) + 1)] if chance.random() < 0.5 else data
        try:
            d.decode(kind, bytes(cut))
        except d.DamagedError:
            refused += 1
    assert refused > 50


def test_numbers_that_are_not_finite_are_damage():
    for bad in (ros.pose(float("nan")), ros.pose(y=float("inf"))):
        with pytest.raises(d.DamagedError, match="not finite"):
            d.decode(
                "nav_msgs/msg/Odometry", ros.cdr("nav_msgs/msg/Odometry", ros.odometry(AT, bad))
            )
    flat = T["geometry_msgs/msg/Pose"](
        position=T["geometry_msgs/msg/Point"](x=0.0, y=0.0, z=0.0),
        orientation=ros.quaternion((0.0, 0.0, 0.0, 0.0)),
    )
    with pytest.raises(d.DamagedError, match="has not the length 1"):
        d.decode(ODOMETRY, ros.cdr(ODOMETRY, ros.odometry(AT, flat)))


@pytest.mark.parametrize("yaw", [0.0, 0.5, -3.0, np.pi, 3.1])
def test_a_heading_is_the_yaw_of_its_quaternion(yaw):
    q = (0.0, 0.0, np.sin(yaw / 2), np.cos(yaw / 2))
    assert heading(q) == pytest.approx(yaw)
    assert heading((0.0, 0.0, -q[2], -q[3])) == pytest.approx(yaw)


def translator(**options: Any) -> Translator:
    topics = {"odometry": "/odom", "detections": ("/tags", "/tf"), "truth": "/truth"}
    return Translator(RobotTopics(**{**topics, **options}))


def test_a_camera_s_tags_are_points_ahead_and_left_of_where_it_sits():
    frames = Frames()
    frames.take(d.Transform(0, "base_link", "mast", (0.2, 0.0, 1.0), (0.0, 0.0, 1.0, 0.0)))
    frames.take(d.Transform(0, "mast", "lens_optical", (0.1, 0.0, 0.0), OPTICAL))
    robot = Translator(RobotTopics(detections=("/tags",)), frames)
    seen = d.TagsRecord(AT, "lens_optical", (d.Tag("7", (-0.5, 0.3, 2.0), None),))
    (found,) = robot.take("/tags", seen)
    assert isinstance(found, Seen)
    np.testing.assert_allclose(found.points, [(2.0, 0.5)], atol=1e-12)
    np.testing.assert_allclose(robot.mounts["lens_optical"].pose[:2], (0.1, 0.0), atol=1e-12)
    assert abs(robot.mounts["lens_optical"].pose[2]) == pytest.approx(np.pi)


def test_a_sensor_whose_place_is_not_known_is_said():
    robot = translator()
    tag = d.Tag("7", (1.0, 2.0, 3.0), None)
    (found,) = robot.take("/tags", d.TagsRecord(AT, "cam_optical_frame", (tag,)))
    assert isinstance(found, Seen)
    assert found.points == ((3.0, -1.0),)
    assert "no transform from cam_optical_frame to base_link" in robot.said[0]
    told = translator(mount=(1.0, 0.5, 0.0), optical=False)
    (found,) = told.take("/tags", d.TagsRecord(AT, "cam_optical_frame", (tag,)))
    assert isinstance(found, Seen)
    assert (found.points, told.mounts["cam_optical_frame"].plane is BODY) == (((1.0, 2.0),), True)
    assert told.said == []


def test_tags_are_landmarks_teammates_or_strangers_by_their_names():
    robot = translator(teammates={"5": "r2"}, landmarks={"dock": 900})
    tags = [d.Tag(name, (1.0, 0.0, 0.0), None) for name in ("36h11:7", "5", "dock", "chair", "1e3")]
    landmarks, mates = robot.take("/tags", d.TagsRecord(AT, "base_link", tuple(tags)))
    assert isinstance(landmarks, Seen)
    assert isinstance(mates, Seen)
    assert (landmarks.names, mates.names) == ((7, 900), ("r2",))
    assert sum(robot.dropped.values()) == 2


def test_an_empty_detection_says_that_it_looked():
    assert translator().take("/tags", d.TagsRecord(AT, "base_link", ())) == [Seen(AT, (), ())]


def test_odometry_is_a_pose_or_speeds_or_a_transform():
    record = d.OdometryRecord(
        stamp_ns=AT,
        frame="odom",
        child="base_link",
        position=(1.0, 2.0, 0.0),
        rotation=(0.0, 0.0, 0.0, 1.0),
        forward=3,
        left=0,
        yaw_rate=4,
    )
    assert translator().take("/odom", record) == [Pose(AT, 1.0, 2.0, 0.0)]
    assert translator(use="twist").take("/odom", record) == [Speeds(AT, 3, 4)]
    assert translator().take("/truth", record) == [Pose(AT, 1.0, 2.0, 0.0, truth=True)]
    moved = d.Transform(AT, "odom", "base_link", (1.0, 2.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    tag = moved._replace(parent="base_link", child="tag36h11:7")
    both = d.TransformsRecord((moved, tag))
    assert translator(odometry="/tf").take("/tf", both) == [
        Pose(AT, 1.0, 2.0, 0.0),
        Seen(AT, (7,), ((1.0, 2.0),)),
    ]
