"""Worlds: the streams of any world, and a simulated one that shares no model with the filter."""
