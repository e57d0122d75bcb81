"""Fusion rules of the sources, for comparison."""
