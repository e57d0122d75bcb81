"""Streams of any world, and a simulated world that shares no model with the filter."""
