"""Reproduce the sources' tables and figures, and measure the team's accuracy.

To add an experiment:

1. Write a module here with two functions. `tasks(options)` lists the runs: each `Task` names a
function of this package with JSON parameters and a JSON result. A run of a team is
`team_runs.team_task(scenario)`; runs that two experiments share are computed once.
2. `outcome(options, results)` makes an `Outcome` of them: figures for machines, tables, pictures,
goals, remarks on differences from the source and their reasons. `results.of(task)` is None where a
run failed; `Outcome.missing` lists figures that need a data set.
3. Add an entry to `catalogue.py`.

A result is stored in the output folder under its task and the digest of the sources that its
function imports: the same command again computes only missing or outdated results.
"""
