import numpy as np
import pytest

from teamslam.team.association import AssociationProfile
from teamslam.team.estimation.association.gating import Pair
from teamslam.team.estimation.association.verification import (
    Closure,
    ClosureTests,
    find_failed_test,
)

PROFILE = AssociationProfile()
PAIRS = 7
FOUND = Closure(
    pairs=tuple(Pair(k, 10 + k, llr=9.0, sd=0.5, rival=0.0) for k in range(PAIRS)),
    llr=60.0,
    share=1.0,
    sd=0.5,
    motion=np.zeros(3),
)


def test_a_closure_inside_one_map_needs_no_context() -> None:
    assert find_failed_test(FOUND, PROFILE, ClosureTests(pairs=5, llr=25.0)) == ""


@pytest.mark.parametrize(("known", "fails"), [(4 * PAIRS - 1, True), (4 * PAIRS, False)])
def test_a_closure_of_two_maps_needs_landmarks_outside_the_place(known: int, fails: bool) -> None:
    tests = ClosureTests(pairs=5, llr=25.0, context=2.0, known=known)
    assert find_failed_test(FOUND, PROFILE, tests).startswith("context") == fails
