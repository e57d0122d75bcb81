"""Reproduce the sources' tables and figures, and measure the team's accuracy.

To add an experiment:

1. Write a module here with two functions. `tasks(options)` lists the runs: each `Task` names a
function of this package with JSON parameters and a JSON result. A team's run is
`team_runs.team_task(scenario)`.
2. `outcome(options, results)` makes an `Outcome`. `results.of(task)` is None for a failed run;
`Outcome.missing` lists figures that need a data set.
3. Add an entry to `runner.py`.

Results are stored in the output folder by task and digest of the imported sources.
"""
