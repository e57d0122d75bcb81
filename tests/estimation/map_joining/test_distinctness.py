"""A final map shows no landmark twice: what may be one with another landmark is left out."""

import numpy as np
import pytest

from central.config import CentralConfig
from central.join_messages import reasons, shown_landmarks
from team.config import UNNAMED
from team.estimation.map_joining.association.landmarks import LocalLandmark, Verdict
from team.estimation.map_joining.auditing import taken
from team.estimation.map_joining.joining import EMPTY_FOLD, Contribution, Fold, JoinSettings, Tick
from team.estimation.submap import LocalMap, Unnamed

SD = 0.01
PAIR = [(2.0, 0.0), (2.0, 0.2)]


def seen(sequence: int, places: list[tuple[float, float]], pose_sd: float) -> Contribution:
    """A submap of a robot that stands, with landmarks that one keyframe saw together."""
    sd = np.array([pose_sd, pose_sd, 0.001, *[SD] * (2 * len(places))])
    local = LocalMap(
        (UNNAMED + np.arange(len(places))).astype(np.uint32),
        np.concatenate([np.zeros(3), np.ravel(places)]),
        np.diag(sd**2),
        unnamed=Unnamed(np.full(len(places), 5, np.uint32), np.ones((len(places), 1), np.bool_)),
    )
    return Contribution("r1", 1, sequence, (sequence + 1) * 10**10, local)


def folded(later: tuple[float, float], verdicts: tuple[Verdict, ...] = ()) -> Fold:
    """Two neighbours are seen twice; after a motion with an error of 0.3 m one landmark is."""
    views = [(PAIR, SD), (PAIR, 0.3), ([later], SD), ([later], SD)]
    fold = EMPTY_FOLD
    for k, (places, pose_sd) in enumerate(views):
        tick = Tick([seen(k, places, pose_sd)], verdicts=verdicts if k == 3 else ())
        fold = taken(fold, tick, JoinSettings())
    return fold


def member(sequence: int, local: int) -> LocalLandmark:
    return LocalLandmark("r1", 1, sequence, local)


def test_what_may_be_either_of_two_neighbours_is_no_third_landmark() -> None:
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
def test_a_landmark_that_is_another_one_is_shown(how: str) -> None:
    different = [Verdict(member(0, k), member(2, 0), same=False) for k in (0, 1)]
    fold = folded((4.0, 1.0)) if how == "far away" else folded((2.0, 0.1), tuple(different))
    shown = shown_landmarks(fold, CentralConfig(), "final")
    assert len(shown.ids) == 3
    assert not shown.undecided
