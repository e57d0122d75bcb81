"""The names that `teamslam.__getattr__` gives."""

from teamslam.team.driver.driver import Driver as Driver
from teamslam.team.driver.driver import DriverError as DriverError
from teamslam.team.driver.measurement_messages import DriverWarning as DriverWarning
from teamslam.team.driver.measurement_messages import MeasurementError as MeasurementError
from teamslam.team.library import *  # noqa: F403 - whatever the library names
