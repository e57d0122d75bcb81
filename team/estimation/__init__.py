"""Estimation on arrays: no network, no files, no clock."""

from team.estimation import one_thread as one_thread
