from dataclasses import replace

import msgspec
import pytest

from teamslam.central.desk.evaluation.evaluation import evaluate
from teamslam.central.desk.evaluation.figures import to_json
from teamslam.central.desk.evaluation.history import history
from teamslam.central.desk.report.page import write_report
from teamslam.central.desk.report.run import Run
from teamslam.central.desk.report.tables import summary_tables, team_rows
from teamslam.sim.in_memory.team import final_map, run_team
from teamslam.sim.world.simulator import simulate
from teamslam.team.containment import Boundary
from teamslam.team.shell import FaultyRunError, judge
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.bus import Sample
from teamslam.team.wire.codec import decoded, encoded
from tests import build
from tests.central.test_withdrawal import run, scenario
from tests.sim.reruns import changed


@pytest.fixture(scope="module")
def samples():
    return run(scenario(), "odometry")


@pytest.fixture(scope="module")
def result(samples):
    return evaluate(samples)


def test_the_tables_the_page_and_the_figures_name_a_withdrawn_robot_by_whom_and_why(
    samples, result, tmp_path
):
    state = result.states["r3"]
    assert state.state == "withdrawn"
    assert state.why.startswith("by central: its submaps contradict")
    assert [result.states[name].state for name in ("r1", "r2")] == ["joined", "joined"]
    rows = dict(team_rows(result))
    assert rows["robots in the map"] == "r1, r2"
    assert rows["withdrawn"] == f"r3: {state.why}"
    assert summary_tables(result)
    figures = to_json(result)
    assert figures["robot_states"]["r3"] == {"state": "withdrawn", "why": state.why}
    (of,) = figures["withdrawn"]
    assert of == {"robot": "r3", "cause": "contradicts_the_rest", "text": state.why}
    write_report(Run(result, history(samples), {}), tmp_path, figures)
    assert "r3: by central: its submaps contradict" in (tmp_path / "report.html").read_text()


def test_a_robot_without_a_common_landmark_is_not_joined_and_one_that_sent_nothing_is_named(
    samples,
):
    def of_r2(final: m.FusedMap) -> m.FusedMap:
        why = ("r2 (incarnation 1) not joined: 0 shared landmarks, 2 needed",)
        members = tuple(each for each in final.members if each.robot != "r1")
        changes = {"reasons": why, "members": members, "lost": ("r3",), "withdrawn": ()}
        return msgspec.structs.replace(final, **changes)

    result = evaluate(changed(samples, ch.FINAL_MAP, of_r2))
    assert {name: of.state for name, of in result.states.items()} == {
        "r1": "not joined", "r2": "not joined", "r3": "lost",
    }  # fmt: skip
    assert result.states["r1"].why == "nothing of it is in the map"
    assert result.states["r2"].why == "0 shared landmarks, 2 needed"


def test_errors_in_the_frame_that_a_withdrawn_robot_has_left_behind_are_not_printed():
    of = scenario()
    streams = simulate(of.world, of.robots, of.seed)
    first, *others = streams.streams
    streams = replace(streams, streams=(first, *(replace(each, start=None) for each in others)))
    wrong = list(run_team(of, streams))
    order = build.withdrawal(reason="its wheel is flat")
    final = final_map(wrong)
    members = tuple(each for each in final.members if each.robot != "r1")
    gone = msgspec.structs.replace(final, frame="r2/1", withdrawn=("r1",), members=members)
    told = changed(wrong, ch.FINAL_MAP, lambda _: gone)
    told.append(Sample(ch.ORDER.key("r1"), encoded(order), 0, 0, 0))
    result = evaluate(told)
    assert result.arbitrary_frame
    assert result.states["r1"] == ("withdrawn", "by operator: its wheel is flat")
    rows = dict(team_rows(result))
    assert rows["landmark RMSE"].startswith("–")
    assert "map NEES per dof" not in rows
    assert "landmarks within 95 %" not in rows
    assert result.robots["r1"].outside, "its poses are in the frame of its own start"


def test_a_process_whose_final_map_is_without_a_withdrawn_robot_ends_with_1(samples):
    final = next(s for s in reversed(samples) if s.key == ch.FINAL_MAP.key())
    with pytest.raises(FaultyRunError, match="the final map is without r3: withdrawn"):
        judge(Boundary("robot/r1"), decoded(final.payload, m.FusedMap))
