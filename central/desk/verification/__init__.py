"""Recompute a log's messages and compare them with the recording."""
