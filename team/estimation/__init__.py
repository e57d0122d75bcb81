"""Estimation on arrays: no network, no files, no clock."""
