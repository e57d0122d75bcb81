"""Reproduce the sources' tables and figures, and measure the team's accuracy.

To add an experiment:

1. Write a module here with a function `outcome(options, results)` that makes an `Outcome`.
2. It asks for each run by `results.of(task)`, which is None for a failed run, and for every run
before all have been made. A `Task` names a function of this package with JSON parameters and a JSON
result; a team's run is `team_runs.team_task(scenario)`. `Outcome.missing` lists figures that need a
data set.
3. Add an entry to `catalogue.py`.

Results are stored in the output folder by task and digest of the imported sources.
"""
