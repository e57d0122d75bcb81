import pytest

from tests.sim.logs import scenario
from tests.sim.reruns import team_samples


@pytest.fixture(scope="session")
def log():
    """Samples of a run of two robots in the small world of `tests.sim.logs`."""
    return team_samples(scenario(robots=2))
