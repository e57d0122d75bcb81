"""The names that `team.__getattr__` gives."""

from team.driver.driver import Driver as Driver
from team.driver.driver import DriverError as DriverError
from team.driver.measured import DriverWarning as DriverWarning
from team.driver.measured import MeasurementError as MeasurementError
from team.library import *  # noqa: F403 - whatever the library names
