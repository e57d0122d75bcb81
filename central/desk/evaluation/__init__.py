"""Evaluate a run from its log alone."""
