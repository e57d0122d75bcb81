"""Batch MAP over all raw measurements: the bound on a team's accuracy."""
