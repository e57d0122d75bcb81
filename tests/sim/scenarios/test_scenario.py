import re
from pathlib import Path

import msgspec
import pytest

from teamslam.central.config import CentralConfig, CommonBiasSigmas, SurveyedLandmark
from teamslam.central.desk.verification.recorded import Recorded
from teamslam.sim.scenarios.document import ScenarioError
from teamslam.sim.scenarios.scenario import (
    Scenario,
    builtin_names,
    dumps,
    load,
    loads,
    scenario_warnings,
    with_options,
)
from teamslam.sim.scenarios.source import streams_of
from teamslam.sim.world.config import (
    FolderWorld,
    LiveWorld,
    SimulatedWorld,
    UnlabelledWorld,
    UtiasWorld,
)
from teamslam.team import former_names
from teamslam.team.association import AssociationProfile
from teamslam.team.config import (
    AssociationSettings,
    BiasSigmas,
    Bounds,
    FrontEnd,
    Lens,
    MotionModel,
    MotionNoise,
    RobotConfig,
    Sensor,
)
from teamslam.team.driver.measurement_messages import Call, MeasurementError, observations
from teamslam.team.pairs import ESTIMATORS, RULES
from tests import build
from tests.commands import run
from tests.support import ROOT
from tests.trials.stress_world import StressWorld, write

SMALL = """
[world]
kind = "simulated"
steps = 3
landmark_count = 2
"""


def written(folder: Path, text: str) -> Path:
    path = folder / "my.toml"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize("name", builtin_names())
def test_a_built_in_scenario_survives_json(name):
    scenario = load(name)
    assert loads(dumps(scenario)) == scenario
    assert scenario.name == scenario.team == name


def test_estimator_rule_and_seed_are_said_once_and_handed_to_all(tmp_path):
    text = 'seed = 7\nestimator = "hybrid-thesis"\nfusion = "kalman-per-axis"\nrobot_count = 3\n'
    scenario = load(written(tmp_path, text + SMALL))
    told = {(robot.id, robot.seed, robot.estimator, robot.fusion) for robot in scenario.robots}
    rule = ("hybrid-thesis", "kalman-per-axis")
    assert told == {("r1", 7, *rule), ("r2", 7, *rule), ("r3", 7, *rule)}
    assert scenario.central.fusion == "kalman-per-axis"


def test_a_users_file_is_named_after_itself_and_may_change_a_built_in_one(tmp_path):
    path = written(
        tmp_path, 'base = "thesis"\nrobot_count = 4\n[defaults.sensor]\nrange_sigma = 1\n'
    )
    scenario = load(path)
    assert scenario.name == "my"
    assert len(scenario.world.landmarks) == 18
    assert [robot.sensor.range_sigma for robot in scenario.robots] == [1.0] * 4
    assert scenario.robots[0].sensor.bearing_sigma == load("thesis").robots[0].sensor.bearing_sigma


def test_a_command_line_changes_what_it_names_and_nothing_else():
    scenario = load("waypoints")
    assert with_options(scenario) == scenario
    changed = with_options(scenario, robots=5, seed=9, fusion="covariance-intersection")
    assert [robot.id for robot in changed.robots] == ["r1", "r2", "r3", "r4", "r5"]
    assert changed.robots[4].sensor == scenario.robots[1].sensor, "the scenario's robots in turn"
    assert {robot.seed for robot in changed.robots} == {changed.seed} == {9}
    assert {robot.fusion for robot in changed.robots} == {changed.central.fusion, changed.fusion}
    assert with_options(scenario, robots=2).robots == scenario.robots[:2]
    utias = with_options(load("utias"), dataset="x.zip")
    assert utias.world.path == "x.zip"


UTIAS = 'world = { kind = "utias" }\n'


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (SMALL + "[defaults.front_end]\npartcles = 5", "`partcles` at defaults.front_end; known"),
        (SMALL + '[central]\nfusion = "kalman"', "`fusion` is set once for the whole team"),
        (
            SMALL + "[[robots]]\n[[robots]]\nmotion = { turn = { per_y = 1 } }",
            "at robots[1].motion",
        ),
        (SMALL + "[defaults.sensor]\nrange_sigma = 'a'", "expected float, got str at defaults.s"),
        (SMALL + "[defaults.sensor]\nrange_sigma = -0.5", "> 0.0 at defaults.sensor.range_sigma"),
        (SMALL + "[defaults.sensor]\nrange_sigma = nan", "expected a finite number, got nan at d"),
        (SMALL + "x = = 2", "line 6, column 5"),
        ("robot_count = 1001\n" + SMALL, "1001 robots: a team has 1 to 1000"),
        ("robot_count = 'two'\n" + SMALL, "expected a number of robots from 1 to 1000, got 'two'"),
        (SMALL, "no robots: give robot_count, [[robots]], or a base that has some"),
        ("robots = 3\n" + SMALL, "expected [[robots]], an array of tables, at robots"),
        ("robots = [3]\n" + SMALL, "expected a table, got int at robots[0]"),
        ("robot_count = 2\n" + SMALL + "[[robots]]", "robot_count and [[robots]] exclude each"),
        (SMALL + "[[robots]]\nid = 'a'\n[[robots]]\nid = 'a'", "two robots have the id a"),
        (SMALL + "[[robots]]\nid = 'A 1'", "expected a small letter, then small letters, digits"),
        ("name = 'a b'\nrobot_count = 1\n" + SMALL, "expected letters, digits, _, . and -"),
        (SMALL + "[defaults]\nid = 'a'", "`id` at defaults would be every robot's"),
        ("seed = 1", 'no kind of world: put base = "recorded" (or another built-in scenario'),
        ("world = { kind = 'lve' }", "got 'lve' at world.kind; did you mean `live`?"),
        ("base = 'recorded'\n[world]\nadmit = true", '"folder", which this file or its base has'),
        (SMALL + "landmarks = [[1, 2]]", "landmarks and landmark_count exclude each other"),
        (SMALL + "paths = [[[1, 2]]]", "path 0 has no length: give two way-points or more"),
        ("robot_count = 1\n" + SMALL + "unknown_starts = ['r2']", "unknown_starts names r2"),
        ("robot_count = 3\n" + SMALL + "size_m = 1.9", "tolerance_m is 1 in a place 1.9 m wide"),
        (SMALL + "visible_from_m = 0.5\nvisible_to_m = 0.2", "is not above visible_from_m = 0.5"),
        (SMALL + "[defaults.sensor]\nmin_range = 3\nmax_range = 2", "2 is not above min_range = 3"),
        ("world = { kind = 'simulated' }", "missing required field steps"),
        (SMALL + "[defaults.motion]\nkind = 'differential-drive'", "needs wheel_base"),
        (SMALL + "[defaults.motion]\nleft_wheel = 0.1", "noises of differential-drive, not of vel"),
        (UTIAS + "[[robots]]\nid = 'alice'", "the robot alice: in a UTIAS world robots are r1, r2"),
        ("world = { kind = 'utias', start_sigma_m = 1 }", "are both 0 or both above 0"),
        ("base = 'thesys'", "expected a built-in scenario, got 'thesys' at base; known: dlr, "),
        ("base = 'my.toml'", "a file can not be a base: copy what you need of it"),
        ("estimator = 'hybrid-thesis'\n" + SMALL, "valid: hybrid + join, hybrid + kalman, "),
    ],
)
def test_a_mistake_in_a_file_is_named_with_file_place_and_remedy(tmp_path, text, said):
    path = written(tmp_path, text)
    with pytest.raises(ScenarioError) as refused:
        load(path)
    assert str(refused.value).startswith(f"{path}: ")
    assert said in str(refused.value)


def test_what_is_no_scenario_is_refused(tmp_path):
    with pytest.raises(ScenarioError, match=r"a folder, .* a data set goes with --dataset"):
        load(tmp_path)
    with pytest.raises(ScenarioError, match=r"nofile\.toml: no such file; built in are .*thesis"):
        load(tmp_path / "nofile.toml")
    (tmp_path / "bad.toml").write_bytes(b"\xff\xfe")
    with pytest.raises(ScenarioError, match="can not be read as UTF-8 text"):
        load(tmp_path / "bad.toml")
    for text in ("{", "[]", "{}"):
        with pytest.raises(ScenarioError):
            loads(text)
    with pytest.raises(ScenarioError, match="expected int >= 0 at seed"):
        with_options(load("thesis"), seed=-1)


def test_a_simulated_robot_whose_odometry_has_no_noise_is_doubted(tmp_path):
    noisy = "[[robots]]\nmotion = { turn = { per_rad = 0.1 } }\n[[robots]]\n"
    (said,) = scenario_warnings(load(written(tmp_path, SMALL + noisy)))
    assert said.startswith("r2: odometry without noise")


def test_hidden_identities_take_thresholds_in_the_lengths_of_the_sensor():
    coarse, fine = (
        with_options(load(name), identities="hidden") for name in ("thesis", "thesis-b")
    )
    assert coarse.central.association.tight > 3.0 * fine.central.association.tight > 0.45
    assert fine.central.association.gate == AssociationProfile().gate
    assert with_options(load("thesis"), seed=2).central.association == AssociationProfile()
    given = with_options(load("victoria"), identities="hidden").central.association
    assert given == load("victoria").central.association
    thesis = load("thesis")
    stated = msgspec.structs.replace(AssociationProfile(), context=0.0)
    central = msgspec.structs.replace(thesis.central, association=stated)
    thesis = msgspec.structs.replace(thesis, central=central)
    without_context = with_options(thesis, identities="hidden").central.association
    assert without_context == msgspec.structs.replace(coarse.central.association, context=0.0)


def test_a_folder_of_detections_without_names_takes_thresholds_in_the_lengths_of_its_sensor(
    tmp_path,
):
    lengths = {}
    for hidden in (True, False):
        place = write(StressWorld(robots=1, seconds=5.0, hidden=hidden), tmp_path / str(hidden))
        found = with_options(load(place / "scenario.toml"), dataset=place).central.association
        lengths[hidden] = found.tight, found.near, found.gate
    default = AssociationProfile()
    assert lengths[False] == (default.tight, default.near, default.gate)
    # 0.05 m and 2 % of the range, and 0.02 rad, at half of 10 m: 0.15 m, five times the default's
    assert lengths[True] == pytest.approx((5 * default.tight, 5 * default.near, default.gate))


def test_a_scenario_of_a_log_with_former_names_is_read_with_todays():
    outliers = {"outlier_share": 0.3, "outlier_kind": "measurement"}
    world = msgspec.structs.replace(load("thesis").world, **outliers)
    today = msgspec.structs.replace(load("thesis"), world=world)
    former = dumps(today)
    for name, now in former_names.FIELDS.items():
        former = former.replace(f'"{now}":', f'"{name}":')
    former = former.replace('"garbage_kind":"measurement"', '"garbage_kind":"reading"')
    former = former.replace('"front_end":{', '"front_end":{"garbage":0.3,')
    assert former.count("garbage") == 2 + len(today.robots)
    assert loads(former) == today


def test_a_logs_configurations_with_former_names_are_read_with_todays():
    today = load("thesis").robots[0]
    text = msgspec.json.encode(today).decode()
    former = text.replace('"front_end":{', '"front_end":{"outlier_share":0.3,')
    assert former != text
    announced = build.configuration(configuration=former)
    recorded = Recorded()
    recorded.configured[announced.node] = announced
    assert recorded.robot_config("r1") == (today, announced.digest)


@pytest.mark.parametrize("place", ["[defaults.sensor]", '[[robots]]\nid = "r1"\n[robots.sensor]'])
def test_a_bearing_s_sigma_in_degrees_is_refused_in_a_scenario(tmp_path, place):
    file = tmp_path / "mine.toml"
    file.write_text(f'base = "waypoints"\n{place}\nbearing_sigma = 2.0\n')
    with pytest.raises(ScenarioError, match=r"2 rad is 115°.*sensor.bearing_sigma; .*0\.0349"):
        load(file)
    file.write_text(f'base = "waypoints"\n{place}\nbearing_sigma = 0.5\n')
    assert load(file).robots[0].sensor.bearing_sigma == 0.5


def test_a_bearing_s_variance_in_degrees_is_refused_by_the_driver():
    with pytest.raises(MeasurementError, match=r"2 rad is 115°; if it is in degrees, give 0\.0349"):
        observations(Call("r1", 10, "observe"), [7], ([2.0], [0.1]), [[[0.01, 0.0], [0.0, 4.0]]])


PAGE = ROOT / "docs" / "scenario.md"
STRUCTS: tuple[type[msgspec.Struct], ...] = (
    Scenario, SimulatedWorld, UtiasWorld, FolderWorld, UnlabelledWorld, LiveWorld, RobotConfig,
    MotionModel, MotionNoise, Sensor, Lens, FrontEnd, AssociationSettings, CentralConfig,
    BiasSigmas, CommonBiasSigmas, SurveyedLandmark, Bounds,
)  # fmt: skip
AT_THE_TOP = {"estimator", "fusion", "seed"}
"""Fields of a robot and the centre that a scenario sets once, for the whole team."""


def described(cls: type[msgspec.Struct]) -> dict[str, str]:
    """Default of each field as the page writes it; empty without a plain default."""
    left_out = AT_THE_TOP if cls in {RobotConfig, CentralConfig} else set()
    fields = msgspec.structs.fields(cls)
    return {field.name: default_of(field) for field in fields if field.name not in left_out}


def default_of(field: msgspec.structs.FieldInfo) -> str:
    if field.required or field.default == () or isinstance(field.default, msgspec.Struct):
        return ""
    if field.default is None:
        return "absent"
    return f"`{msgspec.json.encode(field.default).decode()}`"


def rows_of(page: str, cls: type[msgspec.Struct]) -> dict[str, list[str]]:
    section = page.partition(f": `{cls.__name__}`\n")[2].partition("\n## ")[0]
    cells = [line.strip("| ").split(" | ") for line in section.splitlines() if "| `" in line[:3]]
    return {name.strip("`"): rest for name, *rest in cells}


@pytest.mark.parametrize("cls", STRUCTS)
def test_the_page_has_every_field_with_its_default_its_values_and_a_meaning(cls):
    rows = rows_of(PAGE.read_text("utf-8"), cls)
    expected = described(cls)
    assert rows.keys() == expected.keys()
    assert [name for name in rows if not rows[name][0].startswith(expected[name])] == []
    assert [name for name, row in rows.items() if len(row) != 2 or not all(row)] == []


def test_the_page_has_every_estimator_and_every_rule():
    section = (
        PAGE.read_text("utf-8").partition("## Estimators and rules\n")[2].partition("\n## ")[0]
    )
    first, second = section.partition("| rule |")[::2]
    for table, names in ((first, ESTIMATORS), (second, RULES)):
        cells = re.findall(r"^\| (`.+?) \|", table, re.MULTILINE)
        assert {name for cell in cells for name in re.findall(r"`([^`]+)`", cell)} == {*names}


@pytest.mark.parametrize("page", ["docs/your_own_world.md", "docs/scenario.md"])
def test_the_scenario_that_a_page_shows_gives_three_robots_their_streams(page, tmp_path):
    shown, *changes = re.findall(r"```toml\n(.*?)```", (ROOT / page).read_text("utf-8"), re.DOTALL)
    file = tmp_path / "mine.toml"
    file.write_text(shown, encoding="utf-8")
    streams = streams_of(load(file)).streams
    assert [stream.robot for stream in streams] == ["r1", "r2", "r3"]
    assert all(len(stream.landmark_detections.ids) > 100 for stream in streams)
    for change in changes:
        file.write_text(f'base = "thesis"\n{change}', encoding="utf-8")
        assert load(file) != load("thesis"), "a change of a built-in one"


def test_a_built_in_scenario_that_was_shown_is_the_same_one_as_a_file(tmp_path):
    shown = run("scenarios", "--show", "waypoints")
    file = tmp_path / "waypoints.toml"
    file.write_text(shown.stdout, encoding="utf-8")
    assert load(file) == load("waypoints")
