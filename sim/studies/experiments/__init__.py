"""Reproduce the sources' tables and figures, and measure the team's accuracy.

To add an experiment, write a module with a function `outcome(options, results)` that makes an
`Outcome`, and add an entry to `catalogue.py`. It asks for each run by `results.of(task)`, None for
a failed run, and for every run before all have been made. A `Task` names a function of this package
with JSON parameters and result; a team's run is `team_runs.team_task(scenario)`. Results are stored
by task and digest of the imported sources.
"""
