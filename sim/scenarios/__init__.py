"""Scenarios: what a user writes, its resolved form for processes, and the streams of its world."""
