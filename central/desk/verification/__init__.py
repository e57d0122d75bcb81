"""Recomputes a log message by message and compares it with the recording."""
