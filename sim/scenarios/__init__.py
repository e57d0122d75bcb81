"""Scenarios: what a user writes, what processes hand on, and the streams that come of it."""
