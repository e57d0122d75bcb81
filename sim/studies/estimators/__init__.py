"""Estimators of the sources, for comparison."""
