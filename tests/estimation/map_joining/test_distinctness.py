import numpy as np
import pytest

from teamslam.central.config import CentralConfig
from teamslam.central.join_messages import reasons, shown_landmarks
from teamslam.team.config import UNNAMED
from teamslam.team.estimation.association.landmark_sets import Verdict
from teamslam.team.estimation.association.member_log import LocalLandmark
from teamslam.team.estimation.map_joining.condensed import MOST
from teamslam.team.estimation.map_joining.joining import (
    EMPTY_FOLD,
    Contribution,
    Fold,
    JoinSettings,
    Tick,
)
from teamslam.team.estimation.map_joining.tick import fold_tick
from teamslam.team.estimation.submap import LocalMap, Unnamed

SD = 0.01
FALSE = (3.0, 0.5)
PAIR = [(2.0, 0.0), (2.0, 0.2)]


def seen(
    sequence: int, places: list[tuple[float, float]], pose_sd: float, heading_sd: float = 0.001
) -> Contribution:
    sd = np.array([pose_sd, pose_sd, heading_sd, *[SD] * (2 * len(places))])
    local = LocalMap(
        (UNNAMED + np.arange(len(places))).astype(np.uint32),
        np.concatenate([np.zeros(3), np.ravel(places)]),
        np.diag(sd**2),
        unnamed=Unnamed(np.full(len(places), 5, np.uint32), np.ones((len(places), 1), np.bool_)),
    )
    return Contribution("r1", 1, sequence, (sequence + 1) * 10**10, local)


def folded(
    later: tuple[float, float],
    verdicts: tuple[Verdict, ...] = (),
    times: int = 2,
    heading_sd: float = 0.001,
) -> Fold:
    fold = EMPTY_FOLD
    for k in range(2 + times):
        places, pose_sd = (PAIR if k < 2 else [later]), (0.3 if k == 1 else SD)
        contribution = seen(k, places, pose_sd, heading_sd if k == 1 else 0.001)
        tick = Tick([contribution], verdicts=verdicts if k == 3 else ())
        fold = fold_tick(fold, tick, JoinSettings())
    return fold


def member(sequence: int, local: int) -> LocalLandmark:
    return LocalLandmark("r1", 1, sequence, local)


@pytest.mark.parametrize("off", [0.0, 0.045])
def test_a_landmark_whose_submaps_disagree_at_the_scale_of_the_others_is_left_out(off: float):
    """Two submaps contain the last one; the others' residuals are far below the covariance."""
    fold, others = EMPTY_FOLD, [(2.0 * x, y) for x in range(3) for y in (-2.0, 2.0)]
    for k in range(6):
        places = [*others, (9.0, off * (k == 5))] if k >= 4 else others
        fold = fold_tick(fold, Tick([seen(k, places, SD)]), JoinSettings())
    last = fold.landmarks.identity(member(4, 6))
    assert last == fold.landmarks.identity(member(5, 6))
    shown = shown_landmarks(fold, CentralConfig(), "final")
    assert (last in shown.ids) == (off == 0.0)
    assert len({*shown.ids} - {last}) == len(others)


def test_what_may_be_either_of_two_neighbours_is_no_third_landmark():
    fold = folded((2.0, 0.1))
    one, two, third = (fold.landmarks.identity(member(*at)) for at in ((0, 0), (0, 1), (2, 0)))
    assert len({one, two, third}) == 3, "nothing tells which of the two it is"
    assert fold.landmarks.identity(member(3, 0)) == third
    shown = shown_landmarks(fold, CentralConfig(), "final")
    assert {*shown.ids} == {one, two}
    assert [*shown.undecided] == [third]
    assert shown.undecided[third] in (one, two)
    (why,) = reasons(fold, shown, (), 1)
    assert why.startswith(f"left out, may be one with another landmark: 1 of 3 landmarks ({third} ")
    running = shown_landmarks(fold, CentralConfig(), "closed")
    assert {*running.ids} == {one, two, third}, "running maps show it, as tentative"


@pytest.mark.parametrize("how", ["far away", "by an operator"])
def test_a_landmark_that_is_another_one_is_shown(how):
    different = [Verdict(member(0, k), member(2, 0), same=False) for k in (0, 1)]
    fold = folded((4.0, 1.0)) if how == "far away" else folded((2.0, 0.1), tuple(different))
    shown = shown_landmarks(fold, CentralConfig(), "final")
    assert len(shown.ids) == 3
    assert not shown.undecided


def test_of_what_may_be_one_landmark_the_place_that_is_known_best_is_shown():
    fold = folded((2.0, 0.1), times=4)  # more submaps have it than either of the two
    one, two = (fold.landmarks.identity(member(0, k)) for k in (0, 1))
    assert {*shown_landmarks(fold, CentralConfig(), "final").ids} == {one, two}


@pytest.mark.parametrize(("heading_sd", "is_lost"), [(0.2, False), (0.5, True)])
def test_what_a_lost_robot_has_seen_is_left_out_and_the_map_says_so(heading_sd, is_lost):
    fold = folded((8.0, 0.0), heading_sd=heading_sd)
    third = fold.landmarks.identity(member(2, 0))
    shown = shown_landmarks(fold, CentralConfig(), "final")
    assert (third in shown.ids) != is_lost
    assert [*shown.weak] == [third] * is_lost
    words = reasons(fold, shown, (), 1)
    assert len(words) == 2 * is_lost
    assert not is_lost or words[0].startswith("r1 (incarnation 1) was lost: its heading is known")
    assert not is_lost or words[1] == "left out, seen by robots that were lost: 1 of 3 landmarks"
    assert third in shown_landmarks(fold, CentralConfig(), "closed").ids


def looked_at(times: int, found: int, verdicts: tuple[Verdict, ...] = ()) -> Fold:
    fold = EMPTY_FOLD
    for k in range(times):
        places = [*PAIR, FALSE] if k < found else PAIR
        fold = fold_tick(
            fold, Tick([seen(k, places, SD)], verdicts=verdicts * (k == 1)), JoinSettings()
        )
    return fold


@pytest.mark.parametrize(("times", "found"), [(15, 2), (16, 2), (16, 3)])
def test_what_fewer_than_one_submap_in_eight_finds_that_look_there_is_left_out(times, found):
    fold = looked_at(times, found)
    third = fold.landmarks.identity(member(0, 2))
    shown, is_missed = shown_landmarks(fold, CentralConfig(), "final"), times >= MOST * found
    assert (third in shown.ids) != is_missed
    assert [*shown.missed] == [third] * is_missed
    words = reasons(fold, shown, (), 1)
    left_out = "left out, missed by nearly all that looked there: 1 of 3 landmarks"
    assert words == (left_out,) * is_missed
    assert third in shown_landmarks(fold, CentralConfig(), "closed").ids


def test_a_landmark_that_an_operator_has_judged_is_shown_however_many_missed_it():
    fold = looked_at(16, 2, (Verdict(member(0, 2), member(0, 0), same=False),))
    assert (
        fold.landmarks.identity(member(0, 2)) in shown_landmarks(fold, CentralConfig(), "final").ids
    )
