"""The names that `team.__getattr__` gives."""

from team.library import *  # noqa: F403 - whatever the library names
