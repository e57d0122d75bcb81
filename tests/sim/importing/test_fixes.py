from pathlib import Path

import numpy as np
import pytest

from teamslam.sim.scenarios.scenario import load
from teamslam.sim.scenarios.source import scenario_beside
from teamslam.team.datum import Datum
from teamslam.team.geodesy import geodetic_from_local, local_from_geodetic
from tests.ros2 import messages as ros
from tests.sim.importing.test_bag_topics import LEVEL, static
from tests.sim.importing.test_import import S, drive, imported, read, refusal

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
