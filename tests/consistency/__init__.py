"""Consistency: whether the estimator's covariances agree with its errors.

Each test simulates many worlds with known truth and evaluates a statistic per degree of freedom,
whose expectation is 1 if the covariances are right:

| statistic | of | module |
|---|---|---|
| NEES eᵀP⁻¹e | a window's submap: end pose and landmarks jointly | `test_submaps` |
| NIS νᵀS⁻¹ν | a window's measurements before they are used | `test_submaps` |
| NEES, joint cost Σ rᵀP⁻¹r | the team's map | `test_map` |
| NEES, joint cost | a map with inter-robot measurements | `test_map` |
| NEES, χ² | the alignment of two frames | `test_map` |
| NEES | a robot's pose in the team's frame | `test_team_pose` |
| NEES | a map and the biases estimated with it | `test_map`, `test_range_scale` |

The mean over the worlds must lie in the two-sided 99.9 % interval
(`team/estimation/consistency.py: chi2_interval`); above it the covariances are too small. Most
tests show their power by a mutant that counts information twice, or lacks a state, and must lie
outside. `test_measures` tests the statistics themselves.

    python -m pytest tests/consistency

Elsewhere: comparison methods in `tests/studies/estimators`, the monitor in
`tests/central/test_monitor.py`, the window's smoother in
`tests/estimation/association/test_clustering.py`.
"""
