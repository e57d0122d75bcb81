"""The names that `teamslam.__getattr__` gives."""

from teamslam.team.driver.driver import Driver as Driver, DriverError as DriverError
from teamslam.team.driver.measurement_messages import (
    DriverWarning as DriverWarning,
    MeasurementError as MeasurementError,
)
from teamslam.team.library import *  # noqa: F403 - whatever the library names
