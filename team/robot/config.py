"""Moved to `team.config`."""

from team.config import *  # noqa: F403 - removed with the last import of it
