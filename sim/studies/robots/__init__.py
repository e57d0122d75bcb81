"""Robots with the sources' estimators, for comparison."""
