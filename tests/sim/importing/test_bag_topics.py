from pathlib import Path
from typing import Any

import numpy as np
import pytest

from teamslam.sim.scenarios.scenario import load
from teamslam.sim.scenarios.source import scenario_beside
from teamslam.sim.world.streams import WorldStreams
from teamslam.team.datum import Datum
from teamslam.team.geodesy import geodetic_from_local, local_from_geodetic
from tests.ros2 import messages as ros
from tests.sim.importing.test_import import (
    ODOMETRY,
    OPTICAL,
    TAGS,
    S,
    drive,
    imported,
    read,
    refusal,
)

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


FIX = "sensor_msgs/msg/NavSatFix"
DATUM = Datum(48.745, 9.105)


def fixes(
    topic: str = "/gps/fix", frame: str = "base_link", east_m: float = 10.0
) -> list[ros.Message]:
    """(10, 20) m from the datum without covariance, then none, then (12, 21) m with one."""
    places = np.array([[east_m, 20.0], [east_m + 2.0, 21.0]])
    first, last = geodetic_from_local(DATUM, places).tolist()
    made = [
        ros.fix(S, frame, tuple(first)),
        ros.fix(S + S // 2, frame, (float("nan"), float("nan")), status=-1),
        ros.fix(2 * S, frame, tuple(last), (0.04, 0.01, 0.09)),
    ]
    return [(k * S, topic, FIX, message) for k, message in enumerate(made)]


def topics_with_datum(path: Path) -> Path:
    path.write_text(
        f"[datum]\nlatitude_deg = {DATUM.latitude_deg}\nlongitude_deg = {DATUM.longitude_deg}\n"
        '[robots.r1]\nodometry = "/odom"\ndetections = ["/tags"]\nfixes = "/gps/fix"\n'
    )
    return path


def test_degrees_are_mapped_to_the_plane_and_back():
    """Length of a degree on WGS84 at 45°: 111,131.7 m of latitude, 78,846.8 m of longitude."""
    (north, east) = local_from_geodetic(
        Datum(45.0, 7.0), np.array([[45.0005, 7.0], [45.0, 7.0005]])
    )
    assert north == pytest.approx([0.0, 0.0005 * 111_131.7], abs=1e-3)
    assert east == pytest.approx([0.0005 * 78_846.8, 0.0], abs=1e-3)
    points = np.random.default_rng(1).uniform(-2e4, 2e4, (50, 2))
    for datum in (Datum(-33.9, 151.2, 40.0), Datum(70.0, 179.99)):
        back = local_from_geodetic(datum, geodetic_from_local(datum, points))
        np.testing.assert_allclose(back, points, atol=1e-6)
    with pytest.raises(ValueError, match="beyond the tangent plane"):
        geodetic_from_local(DATUM, np.array([[1e8, 0.0]]))


def test_a_bags_fixes_become_a_table_in_the_plane_of_the_first_or_of_a_stated_datum(tmp_path):
    bag = ros.write_bag(tmp_path / "bag", [*drive(), *fixes()])
    topics = topics_with_datum(tmp_path / "topics.toml")
    moved = {}
    for name, more in (("first", ()), ("stated", ("--ros2", topics))):
        world, said = imported(bag, "-o", tmp_path / name, *more)
        assert "r1: 1 dropped: a message of a receiver without a fix" in said
        (stream,) = world.streams
        assert stream.fixes_ns.tolist() == [S, 2 * S]
        np.testing.assert_array_equal(stream.fixes[1, 2:], [0.04, 0.01, 0.09])
        assert np.isnan(stream.fixes[0, 2:]).all()
        moved[name] = stream.fixes[:, :2]
        datum = load(scenario_beside(tmp_path / name)).central.datum
        assert datum is not None
        assert f"fixes are east and north of the datum {datum.latitude_deg}," in said
    np.testing.assert_allclose(moved["stated"], [[10.0, 20.0], [12.0, 21.0]], atol=1e-5)
    assert np.abs(moved["first"][0]).max() < 0.06  # the first fix, rounded to 10⁻⁶ degrees
    np.testing.assert_allclose(np.diff(moved["first"], axis=0), [[2.0, 1.0]], atol=1e-3)


def test_of_two_receivers_the_user_decides_and_a_filtered_one_is_left_out(tmp_path):
    two = ros.write_bag(tmp_path / "two", [*drive(), *fixes("/left/fix"), *fixes("/right/fix")])
    refused = refusal(two, "-o", tmp_path / "set")
    assert "2 topics may be its fixes: /left/fix, /right/fix" in refused
    both = ros.write_bag(tmp_path / "b", [*drive(), *fixes(), *fixes("/gps/filtered")])
    assert len(imported(both, "-o", tmp_path / "set")[0].streams[0].fixes) == 2


def test_fixes_of_an_added_robot_are_in_the_plane_of_the_data_set(tmp_path):
    antenna = static("/tf_static", ("base_link", "gps", ros.vector(0.8, -0.5, 1.0), LEVEL))
    for robot, east_m in (("ann", 10.0), ("bob", 40.0)):
        made = [*antenna, *drive(), *fixes(frame="gps", east_m=east_m)]
        bag = ros.write_bag(tmp_path / robot, made)
        imported(bag, "-o", tmp_path / "set", "--robot", robot)
    one, other = (stream.fixes[:, :2] for stream in read(tmp_path / "set").streams)
    np.testing.assert_allclose(other - one, [[30.0, 0.0], [30.0, 0.0]], atol=1e-3)
    robots = load(scenario_beside(tmp_path / "set")).robots
    assert [each.gnss.antenna for each in robots] == [(0.8, -0.5), (0.8, -0.5)]
