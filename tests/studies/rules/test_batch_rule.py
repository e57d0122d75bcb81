import numpy as np
import pytest

from teamslam.central.config import CentralConfig
from teamslam.central.node import make_centre
from teamslam.sim.scenarios.scenario import load, with_options
from teamslam.sim.studies.batch_reference.reference import batch_map
from teamslam.sim.studies.rules import batch_rule
from teamslam.sim.studies.rules.batch_rule import taken_as_white
from teamslam.team import translate
from teamslam.team.config import FrontEnd, RobotConfig, Sensor
from teamslam.team.wire import channels as ch
from teamslam.team.wire.digest import announce_configuration
from tests import build
from tests.scenarios import with_front_ends, with_world
from tests.sim.reruns import messages, team_samples
from tests.teams import config, published, stream


def team_run(world, fusion, estimator, steps):
    scenario = with_options(load(world), fusion=fusion, estimator=estimator)
    return team_samples(with_front_ends(with_world(scenario, steps=steps), particles=50))


@pytest.mark.parametrize(("world", "steps"), [("thesis", 150), ("thesis-b", 150)])
def test_it_is_the_batch_map_of_gtsam_on_the_same_measurements(world, steps):
    pytest.importorskip("gtsam", reason="pip install '.[batch-reference]'")
    limit = batch_map(team_run(world, "join", "hybrid", steps))
    samples = team_run(world, "batch", "dead-reckoning", steps)
    (final,) = messages(samples, ch.FINAL_MAP)
    ids, means = translate.landmarks_of(final)
    covariance = translate.landmark_covariance_of(final)
    sigma = np.sqrt(np.diag(limit.covariance))
    np.testing.assert_array_equal(ids, limit.ids)
    assert np.abs((means - limit.means).ravel() / sigma).max() < 1e-4
    assert np.abs((covariance - limit.covariance) / np.outer(sigma, sigma)).max() < 1e-4
    assert final.chi2 == pytest.approx(limit.cost, rel=1e-8)
    for robot, path in limit.paths.items():
        (said,) = messages(samples, ch.TRAJECTORY, robot)
        stamps, poses = translate.trajectory_of(said)
        np.testing.assert_array_equal(stamps, path.stamps_ns[1:])
        np.testing.assert_allclose(poses, path.poses[1:], atol=1e-5)


def robots(**options):
    return {name: config(name, **options) for name in ("r1", "r2")}


MEASUREMENTS = {"r1": published(stream("r1", 9)), "r2": published(stream("r2", 7, y=1.0))}


def heard(configs, **options):
    node = make_centre(CentralConfig(fusion="batch", broadcast_s=4.0, **options), sorted(configs))
    out = []
    for name, told in configs.items():
        out += node.handle(announce_configuration(ch.robot_node(name), 0, 0, told))
        for measurement in MEASUREMENTS[name]:
            out += node.handle(measurement)
        out += node.handle(build.done(robot=name, measurements=len(MEASUREMENTS[name])))
    end = build.end(**{name: len(each) for name, each in MEASUREMENTS.items()})
    return node, out + node.handle(end)


def test_a_final_map_that_has_not_converged_says_so(monkeypatch):
    node, _ = heard(robots())
    assert node.final.reasons == node.status().warnings == ()
    monkeypatch.setattr(batch_rule, "FINAL_ITERATIONS", 1)
    monkeypatch.setattr(batch_rule, "RUNNING_ITERATIONS", 1)
    node, _ = heard(robots())
    (said,) = node.final.reasons
    assert said.startswith("the batch has not converged in 1 iterations")
    assert node.status().warnings == (said,)


def test_errors_that_persist_are_taken_as_white_and_that_is_said_once():
    lasting = Sensor(range_sigma=0.1, bearing_sigma=0.02, range_white=0.5)
    node, _ = heard(robots(sensor=lasting))
    said = (
        "r1, r2: errors that persist (range_white = 0.5) are taken as white, "
        "so the covariance is too small",
    )
    assert node.final.reasons == node.status().warnings == said
    biased = RobotConfig("r3", sensor=lasting, front_end=FrontEnd(biases=("bearing",)))
    assert taken_as_white({"r3": biased, "r4": RobotConfig("r4")}) == [
        "r3: errors that persist (range_white = 0.5; biases bearing) are taken as white, "
        "so the covariance is too small"
    ]
