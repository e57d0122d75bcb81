import numpy as np
import pytest
from jaxtyping import TypeCheckError

from teamslam.team.estimation.hybrid_slam import fastslam
from teamslam.team.estimation.models import Increment
from tests import shapes

WRONG = np.zeros((3, 2))


def test_after_so_many_calls_a_function_is_let_through_and_no_other_and_the_next_test_checks_it():
    with pytest.raises(TypeCheckError):
        fastslam.at_poses(WRONG)
    for _ in range(shapes.CALLS):
        fastslam.at_poses(np.zeros((3, 3)))
    fastslam.at_poses(WRONG)
    with pytest.raises(TypeCheckError):
        fastslam.resampled(WRONG, np.random.default_rng())
    shapes.begin_test()
    with pytest.raises(TypeCheckError):
        fastslam.at_poses(WRONG)


def test_methods_and_class_methods_are_let_through_too():
    still = Increment.identity()
    for _ in range(shapes.CALLS):
        still = Increment.identity().then(still)
    still.then(Increment(np.zeros(3), np.zeros((3, 3))))
    for method in (Increment.then, Increment.identity.__func__):
        assert method.__wrapped__.__no_type_check__
    shapes.begin_test()
    assert not hasattr(Increment.then.__wrapped__, "__no_type_check__")
