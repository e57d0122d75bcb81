"""What is told while kernels are compiled."""

import numba

from team.estimation.compiling import OURS, compilations


def doubled(x: float) -> float:
    return 2.0 * x


def tripled(x: float) -> float:
    return 3.0 * x


def test_kernels_of_ours_are_counted_as_they_are_compiled_and_no_others() -> None:
    ours, theirs = numba.njit(doubled), numba.njit(tripled)
    doubled.__module__ = f"{OURS}.estimation"
    told: list[tuple[int, int]] = []
    with compilations(lambda done, of: told.append((done, of)), 1):
        assert theirs(1.0) == 3.0
        assert told == []
        assert ours(1.0) == 2.0
        assert ours(2.0) == 4.0
    assert told == [(1, 1)]
