import math
from collections.abc import Mapping
from typing import Any

import msgspec
import pytest

from teamslam.sim.scenarios.scenario import Scenario, load, loads, with_options
from teamslam.sim.studies.experiments import xu, xu_localisation
from teamslam.sim.studies.experiments.curves import curves_run
from teamslam.sim.studies.experiments.experiment import Options, Results, runs_of
from teamslam.sim.studies.experiments.team_runs import Figures
from teamslam.sim.studies.experiments.xu import FIGURE_4_4, FIGURE_5_2
from tests.scenarios import with_world

STEPS = 40


def short(parameters: Mapping[str, Any]) -> dict[str, Any]:
    return {
        name: value
        if name == "late"
        else value | {"world": value["world"] | {"steps": STEPS, "paths": [[[80, 40], [40, 55]],
                                                                         [[10, 40], [50, 25]]]}}
        for name, value in parameters.items()
    }  # fmt: skip


@pytest.fixture(scope="module")
def runs():
    panels = [("4.4", panel) for panel in FIGURE_4_4.panels]
    panels += [("5.2", panel) for panel in FIGURE_5_2.panels]
    return {
        (f"{figure} {panel.name}", method.name): curves_run(
            **short(xu.task(panel, method, 1).parameters)
        )
        for figure, panel in panels
        for method in panel.methods
        if method not in (xu.OURS, xu.OUR_TEAM)
    }


def largest(run: Figures) -> float:
    return float(max(run["poses"]["r1"]["error_m"]))


def test_as_coded_the_errors_are_far_below_those_as_stated(runs):
    stated = largest(runs["4.4 as stated", xu.HYBRID.name])
    exact = largest(runs["4.4 true controls", xu.HYBRID.name])
    coded = largest(runs["4.4 as coded", xu.HYBRID_CODED.name])
    assert stated > 1.5 * exact > 3.0 * coded


def scenario(**change: object) -> Scenario:
    made = with_options(load("thesis"), robots=1)
    return with_world(made, **change)


def test_the_coded_inputs_are_the_appendix_numbers():
    coded = xu.as_coded(scenario())
    robot = coded.robots[0]
    assert robot.motion.forward.per_s == pytest.approx(0.0025)
    assert math.degrees(robot.motion.turn.per_s) == pytest.approx(0.157, abs=1e-3)
    assert math.degrees(robot.sensor.bearing_sigma) == pytest.approx(5.64, abs=1e-2)
    assert coded.world.visible_from_m == 0.0
    panel = next(p for p in FIGURE_4_4.panels if p.reading == "coded")
    parameters = xu.task(panel, xu.EKF, 1).parameters
    world = loads(msgspec.json.encode(parameters["world"]).decode())
    assert world.robots[0].motion.is_exact
    assert parameters["late"]


def test_a_measurement_narrows_the_cloud_and_resampling_changes_its_copies_only():
    options = Options((1, 2))
    task = runs_of(xu_localisation, options)[0]
    run = task.run()
    predicted, weighed, resampled = (run[name] for name in xu_localisation.STAGES)
    assert predicted["effective"] == pytest.approx(xu_localisation.PARTICLES)
    assert predicted["sigma_m"] > 5.0
    assert weighed["sigma_m"] < 0.5 * predicted["sigma_m"]
    assert weighed["effective"] < 0.5 * predicted["effective"]
    assert weighed["different"] == xu_localisation.PARTICLES
    assert resampled["effective"] == pytest.approx(xu_localisation.PARTICLES)
    assert resampled["different"] < 0.7 * xu_localisation.PARTICLES
    assert resampled["distance_m"] == pytest.approx(weighed["distance_m"], abs=0.5)


def test_a_start_anywhere_is_found(tmp_path):
    options = Options((3,))
    tasks = runs_of(xu_localisation, options)[:2]
    results = {task.name: task.run() for task in tasks}
    found = results[tasks[1].name]
    first, *_, last = (found[str(step)] for step in xu_localisation.ANYWHERE_STEPS)
    assert first["sigma_m"] > 30.0
    assert last["sigma_m"] < 2.0
    assert last["distance_m"] < 5.0
    outcome = xu_localisation.outcome(options, Results(results))
    assert [p.name for p in outcome.pictures] == [*xu_localisation.STAGES, "anywhere"]
    for picture in outcome.pictures:
        picture.draw(tmp_path / "picture.png")
        assert (tmp_path / "picture.png").stat().st_size > 10_000
