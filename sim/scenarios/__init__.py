"""Scenarios: the user's document, its resolved form for processes, and the streams of its world."""
