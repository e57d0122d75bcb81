"""Recorded runs for other programs: paths as files."""
