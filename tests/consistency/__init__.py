"""Consistency: whether the estimator's covariances agree with its errors.

Each test evaluates a statistic (NEES, NIS, joint cost) per degree of freedom in many worlds with
known truth. Its mean must lie in the two-sided 99.9 % interval about 1; above it the covariances
are too small. Most tests show their power by a mutant that counts information twice, or lacks a
state, and must lie outside.

Elsewhere: comparison methods in `tests/studies/estimators`, the monitor in
`tests/central/test_monitor.py`, the window's smoother in
`tests/estimation/association/test_clustering.py`.
"""
