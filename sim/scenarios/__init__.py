"""Scenarios: user document, resolved form for processes, and streams of the world."""
