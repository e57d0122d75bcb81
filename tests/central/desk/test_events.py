import pytest
from msgspec.structs import replace

from teamslam.central.desk.evaluation.events import EventDetector
from teamslam.central.desk.names import data_set_of, without_decimals
from teamslam.team.wire import messages as m
from tests import build
from tests.support import example, fused_map


def told(*messages: m.Message) -> list[tuple[str, str]]:
    detector = EventDetector()
    return [(e.kind, e.text) for message in messages for e in detector.take(message, 5)]


def alive(there: bool, node: str = "robot/r1") -> m.Liveliness:
    return build.liveliness(node=node, alive=there)


def test_a_robot_joins_is_lost_and_comes_back():
    assert told(alive(True), alive(False), alive(False), alive(True)) == [
        ("joined", "r1 joined"),
        ("lost", "r1 was lost"),
        ("restarted", "r1 came back"),
    ]


def fused(
    robots: list[str],
    reasons: tuple[str, ...] = (),
    withdrawn: tuple[str, ...] = (),
    final: bool = False,
) -> m.FusedMap:
    return fused_map(
        final=final,
        members=tuple(m.VersionEntry(robot=robot, incarnation=1, sequence=0) for robot in robots),
        reasons=reasons,
        withdrawn=withdrawn,
    )


def test_who_is_in_the_map_and_why_not_and_who_was_withdrawn_is_told_once():
    why = "r2: 1 shared landmark, cost 2.5"
    alone = fused(["r1"], (why,))
    moved = fused(["r1"], (why.replace("2.5", "2.6"),))
    assert told(alone, moved, fused(["r1", "r2"]), fused(["r1"], (), ("r2",))) == [
        ("map", "r1 is in the team's map"),
        ("warning", why),
        ("map", "r2 is in the team's map"),
        ("map", f"no longer: {why.replace('2.5', '2.6')}"),
        ("withdrawn", "r2 was withdrawn from the map"),
    ]


def test_a_robot_that_waits_for_its_place_is_not_told_to_be_in_the_map():
    why = "r2 not joined: no landmark is shared"
    assert told(fused(["r1", "r2"], (why,)), fused(["r1", "r2"])) == [
        ("map", "r1 is in the team's map"),
        ("warning", why),
        ("map", "r2 is in the team's map"),
    ]


def test_a_withdrawal_is_told_once_with_its_reason():
    said = build.withdrawal(stamp_ns=3, robot="r2", by="central", reason="its wheels slip")
    assert told(fused(["r1", "r2"]), said, said, fused(["r1"]))[2:] == [
        ("withdrawn", "r2 is withdrawn by the centre: its wheels slip")
    ]


def status(refused: int, *warnings: str) -> m.Status:
    return build.status(
        node="central", state="joining", figures={"refused": float(refused)}, warnings=warnings
    )


def test_a_warning_whose_decimals_move_is_told_once_waiting_never_and_a_refusal_is_one():
    said = (
        status(0, "waiting for r1", "submap 20: cost 1.2"),
        status(0, "submap 20: cost 1.3", "submap 21: cost 1.3"),
        status(2, "refused: overlap"),
    )
    assert told(*said) == [
        ("warning", "central: submap 20: cost 1.2"),
        ("warning", "central: submap 21: cost 1.3"),
        ("refused", "the centre refused 2 submaps"),
        ("refused", "central: refused: overlap"),
    ]
    assert without_decimals("submap 20, cost 9.1") == "submap 20, cost #"


@pytest.mark.parametrize("is_status_first", [True, False])
def test_a_warning_of_the_map_and_of_the_centre_is_one_event_and_a_return_is_another(
    is_status_first,
):
    reason, same = "r2's odometry is 2.3 % too short", "central: r2's odometry is 2.4 % too short"
    both = (status(0, reason.replace("2.3", "2.4")), fused(["r1"], (reason,)))
    said = both if is_status_first else both[::-1]
    assert told(*said, *said, fused(["r1"]), *said) == [
        *[("warning", same)] * is_status_first,
        ("map", "r1 is in the team's map"),
        *[("warning", reason)] * (not is_status_first),
        ("map", f"no longer: {reason}"),
        ("warning", reason),
    ]


def test_the_end_of_the_world_and_its_notes_are_told_once():
    end = m.End(stamp_ns=9, streams=(), notes=("a row was repaired",))
    assert told(end, end, fused([], final=True), alive(True, "recorder")) == [
        ("warning", "a row was repaired"),
        ("done", "the world has ended"),
        ("done", "final map of 0 landmarks"),
        ("joined", "recorder joined"),
    ]


@pytest.mark.parametrize(
    ("scenario", "name"),
    [
        ('{"world": {"path": "data/mine.zip"}}', "mine"),
        ('{"world": {"path": "\\ud800"}}', ""),
        ('{"world": {"path": 5}}', ""),
        ('{"world": []}', ""),
        ("\ud800", ""),
        ("{", ""),
    ],
)
def test_a_data_set_is_named_where_the_scenario_is_readable(scenario, name):
    assert data_set_of(scenario) == name


def test_a_closure_is_an_event_once_and_so_is_that_it_is_undone():
    detector, closed = EventDetector(), example(m.FusedMap)
    (closure,) = (each for each in detector.take(closed, 0) if each.kind == "closure")
    assert closure.text == (
        "alpha (incarnation 1) and bravo (incarnation 0) merged by their maps: 12 landmarks, "
        "log-likelihood ratio 40 against 6, share 0.75, 0 absent"
    )
    undone = replace(closed.decisions[0], kind="undone", why="share 0.41 < 0.5 after 3 ticks")
    again = replace(closed, decisions=(*closed.decisions, undone))
    for expected in (["undone"], []):
        found = [each.kind for each in detector.take(again, 0)]
        assert [kind for kind in found if kind in ("closure", "undone")] == expected
