"""The sources' tables and figures, and the team's own accuracy, by one command each.

To add an experiment:

1. Write a module here with two functions. `tasks(options)` lists the runs: each `Task` names a
   function of this package, gives it parameters that are JSON, and gets JSON back. A run of a team
   is `team_runs.team_task(scenario)`; runs that two experiments share are computed once.
2. `outcome(options, results)` makes an `Outcome` of them: figures for machines, tables, pictures,
   goals, remarks on what differs from the source and why. `results.of(task)` is None where a run
   failed; what can not be had without a data set goes into `Outcome.missing`.
3. Give it a line in `catalogue.py`.

A result is kept in the output folder under its task and the digest of the sources that its function
imports: the same command again computes only what is missing or whose program has changed.
"""
