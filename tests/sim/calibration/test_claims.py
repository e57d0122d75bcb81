import msgspec
import numpy as np
import pytest

from teamslam.central.desk.evaluation.errors import TRUTH_GAP_NS
from teamslam.sim.calibration.claims import landmark_factor, mount_note, odometry_factor
from teamslam.sim.calibration.data import Reference, references, true_paths
from teamslam.sim.world.config import SimulatedWorld
from teamslam.sim.world.simulator import simulate
from teamslam.team.config import MotionModel, MotionNoise, RobotConfig, Sensor

MOUNT = (1.2, -0.4, 0.3)
ROBOTS = [
    RobotConfig(
        f"r{i}",
        motion=MotionModel(
            forward=MotionNoise(0.02), turn=MotionNoise(0.01), lateral=MotionNoise(0.02)
        ),
        sensor=Sensor(range_sigma=0.1, bearing_sigma=0.02, mount=MOUNT),
    )
    for i in range(6)
]
WORLD = SimulatedWorld(
    steps=300, size_m=30.0, landmark_count=12, visible_from_m=1.0, visible_to_m=12.0,
    odometry="increments", odometry_claims=True, odometry_correlation=0.5,
    landmark_claims=(0.5, 2.0), claims_factor=4.0,
)  # fmt: skip


def seen(assumed: tuple[float, float, float] = MOUNT, **changes: object) -> list[Reference]:
    world = simulate(msgspec.structs.replace(WORLD, **changes), ROBOTS, 3)
    assert world.landmarks is not None
    places = dict(zip(world.landmark_ids.tolist(), world.landmarks, strict=True))
    sensor = msgspec.structs.replace(ROBOTS[0].sensor, mount=assumed)
    models = msgspec.structs.replace(ROBOTS[0], sensor=sensor)
    paths = true_paths(world.streams)
    return references(world, paths, places, TRUTH_GAP_NS, "set", frozenset(), models)


@pytest.mark.parametrize("told", ["ranges", "points"])
def test_the_factors_of_what_is_claimed_are_learnt(told):
    data = seen(landmark_form=told)
    assert odometry_factor(data)["covariance_factor"] == pytest.approx(4.0, rel=0.25)
    found = landmark_factor(data, ROBOTS[0].sensor)["covariance_factor"]
    assert found == pytest.approx(4.0, rel=0.1)


def test_a_mount_that_is_not_the_scenarios_is_told_and_where_it_is():
    assert mount_note(seen(), ROBOTS[0].sensor) == ()
    wrong = msgspec.structs.replace(ROBOTS[0].sensor, mount=(0.0, 0.0, 0.3))
    (note,) = mount_note(seen(wrong.mount), wrong)
    told = note.partition("sensor.mount = [")[2].partition("]")[0]
    np.testing.assert_allclose([float(x) for x in told.split(",")], MOUNT, atol=0.03)


def test_a_place_that_the_view_does_not_determine_is_refused_by_name():
    data = seen()
    for k, each in enumerate(data):
        object.__setattr__(each, "seen", each.seen.only(0, 3 + k))
    (note,) = mount_note(data, ROBOTS[0].sensor)
    assert note.startswith("mount: the sensor's place on the base is not learnt")
