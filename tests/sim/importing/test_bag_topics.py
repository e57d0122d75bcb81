from typing import Any

import numpy as np
import pytest

from teamslam.sim.world.streams import WorldStreams
from tests.ros2 import messages as ros
from tests.sim.importing.test_import import ODOMETRY, OPTICAL, TAGS, S, imported, refusal

TF = "tf2_msgs/msg/TFMessage"
LEVEL = (0.0, 0.0, 0.0, 1.0)
BACK = (0.0, 0.0, 1.0, 0.0)


def odometry(topic: str, child: str, speed: float = 1.0) -> list[ros.Message]:
    told: list[ros.Message] = []
    for k in range(3):
        message = ros.odometry(k * S, ros.pose(speed * k), speed)
        message.child_frame_id = child
        told.append((k * S, topic, ODOMETRY, message))
    return told


def seen(topic: str, frame: str, *tags: tuple[str, Any]) -> list[ros.Message]:
    return [(S, topic, TAGS, ros.detections(S, frame, tags))]


def static(topic: str, *frames: tuple[str, str, Any, Any]) -> list[ros.Message]:
    return [(0, topic, TF, ros.transforms(*((0, *frame) for frame in frames)))]


@pytest.mark.parametrize("space", ["", "/anna"])
def test_of_two_odometries_the_wheels_are_proposed_and_the_user_decides(tmp_path, space):
    wheels, fused = f"{space}/wheel/odometry", f"{space}/odometry/filtered"
    messages = [*odometry(fused, "base_footprint", 2.0), *odometry(wheels, "base_footprint")]
    bag = ros.write_bag(tmp_path / "bag", [*messages, *seen(f"{space}/tags", "base_footprint")])
    said = refusal(bag, "-o", tmp_path / "set")
    robot = space.strip("/") or "r1"
    assert f"{robot}: 2 topics may be its odometry, and one is used: {wheels} is proposed" in said
    assert f'odometry = "{wheels}"   # or "{fused}"' in said
    assert 'base_frame = "base_footprint"' in said
    assert said.count("[robots.") == 1
    topics = tmp_path / "topics.toml"
    for topic, speed in ((wheels, 1.0), (fused, 2.0)):
        text = said[said.index("[robots.") : said.index("\nand type")]
        topics.write_text(text.replace(f'"{wheels}"   # or "{fused}"', f'"{topic}"'))
        (stream,) = imported(bag, "-o", tmp_path / f"{speed}", "--ros2", topics)[0].streams
        assert stream.intervals.increments[:, 0].tolist() == [speed, speed]


def test_each_camera_sees_from_its_own_place_and_frames_may_hang_below_either_base(tmp_path):
    frames = [
        ("base_link", "base_footprint", ros.vector(0.1), LEVEL),  # the odometry's frame is a leaf
        ("base_link", "front", ros.vector(0.3, 0.1), LEVEL),
        ("front", "front_optical", ros.vector(), OPTICAL),
        ("base_link", "rear", ros.vector(-0.2), BACK),
        ("rear", "rear_optical", ros.vector(), OPTICAL),
    ]
    # From base_footprint, 0.1 m ahead of base_link, tags 1 and 2 are at (2, 1) and (-3, 1).
    messages = [
        *static("/tf_static", *frames),
        *odometry("/odom", "base_footprint"),
        *seen("/front/tags", "front_optical", ("1", ros.pose(-0.9, 0.0, 1.8))),
        *seen("/rear/tags", "rear_optical", ("2", ros.pose(1.0, 0.0, 2.7))),
    ]
    bag = ros.write_bag(tmp_path / "bag", messages)
    world, said = imported(bag, "-o", tmp_path / "set")
    assert "r1: 2 sensors (front_optical, rear_optical) at several places" in said
    assert "mount" in (tmp_path / "set" / "scenario.toml").read_text()
    (stream,) = world.streams
    points = stream.landmark_detections.points
    assert points is not None
    at = dict(zip(stream.landmark_detections.ids.tolist(), points, strict=True))
    np.testing.assert_allclose(at[1] + (0.2, 0.1), (2.0, 1.0), atol=1e-12)
    np.testing.assert_allclose(at[2] + (0.2, 0.1), (-3.0, 1.0), atol=1e-12)


def test_robots_whose_frames_are_called_alike_keep_their_own_cameras(tmp_path):
    messages: list[ros.Message] = []
    for robot, ahead in (("ann", 0.2), ("bob", 0.7)):
        camera = ("base_link", "camera", ros.vector(ahead), LEVEL)
        messages += static(f"/{robot}/tf_static", camera)
        messages += odometry(f"/{robot}/odom", "base_link")
        messages += seen(f"/{robot}/tags", "camera", ("1", ros.pose(2.0)))
    imported(ros.write_bag(tmp_path / "bag", messages), "-o", tmp_path / "set")
    text = (tmp_path / "set" / "scenario.toml").read_text()
    assert [f"{ahead}," in text for ahead in (0.2, 0.7)] == [True, True]


def test_a_detection_with_two_names_is_told_and_either_may_count(tmp_path):
    (tag,) = seen("/tags", "base_link", ("tag36h11:12", ros.pose(2.0)))
    tag[3].detections[0].id = "3"
    bag = ros.write_bag(tmp_path / "bag", [*odometry("/odom", "base_link"), tag])
    first, said = imported(bag, "-o", tmp_path / "a")
    assert "has the id 3 and the class tag36h11:12: its id is taken" in said
    (tmp_path / "topics.toml").write_text(
        '[robots.r1]\nodometry = "/odom"\ndetections = ["/tags"]\nnames = "class"\n'
    )
    second, _ = imported(bag, "-o", tmp_path / "b", "--ros2", tmp_path / "topics.toml")
    found = [each.streams[0].landmark_detections.ids.tolist() for each in (first, second)]
    assert found == [[3], [12]]


def test_what_was_stamped_before_the_clock_was_set_is_dropped_and_counted(tmp_path):
    year = 55 * 365 * 86_400 * S
    messages = []
    for k in range(6):
        at = (k + 1) * S + (year if k > 1 else 0)
        messages.append((k * S, "/odom", ODOMETRY, ros.odometry(at, ros.pose(float(k)))))
    tags = ros.detections(year + 4 * S, "base_link", [("1", ros.pose(2.0))])
    bag = ros.write_bag(tmp_path / "bag", [*messages, (7 * S, "/tags", TAGS, tags)])
    world, said = imported(bag, "-o", tmp_path / "set")
    assert "r1: 2 odometry rows dropped: by another clock than most rows: it jumps" in said
    (stream,) = world.streams
    assert stream.intervals.duration_ns.tolist() == [S, S, S]


def ids_by_robot(world: WorldStreams) -> dict[str, list[int]]:
    return {each.robot: each.landmark_detections.ids.tolist() for each in world.streams}


def shared_tf(*, bases: tuple[str, str], odoms: tuple[str, str], linked: bool = True) -> list[Any]:
    """Two robots, each with its odometry and camera, and one /tf with both robots' tags in it.

    linked: /tf has the moving transform from odometry frame to base, /tf_static the one to the
    camera.
    """
    messages: list[Any] = []
    for robot, base, odom, ahead in zip(("ann", "bob"), bases, odoms, (0.2, 0.7), strict=True):
        camera = f"{robot}/camera"
        if linked:
            messages += static("/tf_static", (base, camera, ros.vector(ahead), LEVEL))
            moved = ros.transforms((S, odom, base, ros.vector(1.0), LEVEL))
            messages.append((S, "/tf", TF, moved))
        told = odometry(f"/{robot}/odom", base)
        for _, _, _, message in told:
            message.header.frame_id = odom
        tags = [(S, camera, f"tag36h11:{k}", ros.vector(2.0 + ahead), LEVEL) for k in (1, 2)]
        messages += [*told, (S, "/tf", TF, ros.transforms(*tags[: 1 + (robot == "bob")]))]
    return messages


@pytest.mark.parametrize("by", ["base", "odometry frame"])
def test_in_a_shared_tf_each_robot_has_the_detections_of_its_own_camera(tmp_path, by):
    bases, odoms = ("ann/base_link", "bob/base_link"), ("ann/odom", "bob/odom")
    messages = shared_tf(bases=bases, odoms=odoms)
    if by == "odometry frame":  # the base of the odometry is not in the tree of transforms
        for _, topic, kind, message in messages:
            if kind == ODOMETRY:
                message.child_frame_id = f"{topic.split('/')[1]}/imu"
    bag = ros.write_bag(tmp_path / "bag", messages)
    world, said = imported(bag, "-o", tmp_path / "set")
    assert ids_by_robot(world) == {"ann": [1], "bob": [1, 2]}
    assert "ann: 2 dropped: a detection in a frame of bob" in said
    assert ("no transform" in said) == (by != "base")


@pytest.mark.parametrize(
    ("names", "linked"), [(("base_link", "base_link"), True), (("a/base", "b/base"), False)]
)
def test_detections_that_may_be_of_either_robot_are_refused_with_their_frames_and_a_remedy(
    tmp_path, names, linked
):
    messages = shared_tf(bases=names, odoms=("odom", "odom"), linked=linked)
    bag = ros.write_bag(tmp_path / "bag", messages)
    topics = tmp_path / "topics.toml"
    text = '[robots.{0}]\nodometry = "/{0}/odom"\ndetections = ["/tf"]\n'
    topics.write_text(text.format("ann") + text.format("bob"))
    said = refusal(bag, "-o", tmp_path / "set", "--ros2", topics)
    assert "the frames ann/camera, bob/camera" in said
    assert '[robots.ann] frames = ["ann/camera", "bob/camera"]' in said
    assert not (tmp_path / "set").exists()
    listed = [text.format(name) + f'frames = ["{name}/camera"]\n' for name in ("ann", "bob")]
    topics.write_text("".join(listed))
    world, _ = imported(bag, "-o", tmp_path / "set", "--ros2", topics)
    assert ids_by_robot(world) == {"ann": [1], "bob": [1, 2]}


@pytest.mark.parametrize("linked", [True, False])
def test_tags_of_a_robot_that_is_not_imported_are_not_guessed_to_be_of_the_one_that_is(
    tmp_path, linked
):
    bases, odoms = ("ann/base_link", "bob/base_link"), ("ann/odom", "bob/odom")
    messages = shared_tf(bases=bases, odoms=odoms, linked=linked)
    bag = ros.write_bag(tmp_path / "bag", messages)
    text = (
        '[robots.ann]\nodometry = "/ann/odom"\ndetections = ["/tf"]\nbase_frame = "ann/base_link"\n'
    )
    (tmp_path / "topics.toml").write_text(text)
    given = (bag, "-o", tmp_path / "set", "--ros2", tmp_path / "topics.toml")
    assert "bob/camera" in refusal(*given)
    (tmp_path / "topics.toml").write_text(text + 'frames = ["ann/camera"]\n')
    world, said = imported(*given)
    assert "ann: 2 dropped: a detection in a frame that `frames` does not list" in said
    assert ids_by_robot(world) == {"ann": [1]}
