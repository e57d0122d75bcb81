"""Consistency: whether the estimator's covariances agree with its errors.

Each test simulates many worlds whose true values are known and evaluates one of three statistics
per degree of freedom, each of which has the expectation 1 if the covariances are right:

| statistic | of | module |
|---|---|---|
| NEES eᵀP⁻¹e | a window's submap: end pose and landmarks jointly | `test_submaps` |
| NIS νᵀS⁻¹ν | a window's measurements before they are used | `test_submaps` |
| NEES, joint cost Σ rᵀP⁻¹r | the team's map | `test_map` |
| NEES, joint cost | a map with inter-robot measurements | `test_map` |
| NEES, χ² | the alignment of two frames | `test_map` |
| NEES | a robot's pose in the team's frame | `test_team_pose` |
| NEES | a map and the biases estimated with it | `test_map`, `test_range_scale` |

The mean over the worlds has to lie in the two-sided interval that it leaves with probability 0.001
(`team/estimation/consistency.py: chi2_interval`): above it the covariances are too small, below it
too large. Most tests also have power: the same statistic of a mutant that counts information twice,
or lacks a state, has to lie outside. `test_measures` tests the statistics and the interval
themselves, on errors of a given covariance.

    python -m pytest tests/consistency

The consistency of the comparison methods is in `tests/studies/estimators`, that of the monitor of
a running team in `tests/central/test_monitor.py`, that of the window's smoother in
`tests/estimation/association/test_clustering.py`.
"""
