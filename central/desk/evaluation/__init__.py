"""Evaluates a run from its log alone."""
