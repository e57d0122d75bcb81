"""Consistency: whether the estimator's covariances agree with its errors.

Each test evaluates a statistic (NEES, NIS, joint cost) per degree of freedom in many worlds with
known truth. Its mean must lie in the two-sided 99.9 % interval about 1; above it the covariances
are too small. Most tests show their power by a mutant that counts information twice, or lacks a
state, and must lie outside.

Elsewhere: comparison methods in `tests/studies/estimators`, the monitor in
`tests/central/test_monitor.py`, the window's smoother in
`tests/estimation/association/test_clustering.py`.
"""

from teamslam.team.estimation.consistency import chi2_interval

RIGHT, TOO_SMALL, TOO_LARGE = "right", "covariances too small", "covariances too large"


def judge(statistic: float, dof: int, runs: int = 1) -> str:
    """Compare a mean per degree of freedom with its 99.9 % interval."""
    low, high = chi2_interval(dof, 0.999, runs)
    return RIGHT if low < statistic < high else TOO_SMALL if statistic >= high else TOO_LARGE
