"""Settings of every test run: one BLAS thread, checked shapes, repeatable examples."""

import os
from pathlib import Path

for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[variable] = "1"  # before NumPy is imported, in child processes too

import pytest
from hypothesis import HealthCheck, settings
from jaxtyping import install_import_hook
from xdist.remote import Producer
from xdist.scheduler import LoadScopeScheduling
from xdist.workermanage import WorkerController

import tests.shapes

# The same examples in every run; HYPOTHESIS_SEARCH=1 draws new ones.
settings.register_profile(
    "repeatable",
    derandomize="HYPOTHESIS_SEARCH" not in os.environ,
    deadline=None,  # no deadline on a loaded machine
    suppress_health_check=[HealthCheck.too_slow],
)
settings.load_profile("repeatable")

DEFECTS = Path(__file__).with_name("open_defects.txt")
"""Names of the tests that fail because of known defects."""

install_import_hook(tests.shapes.modules_with_shapes(), f"{tests.shapes.__name__}.checked")


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    tests.shapes.begin_test()
    from teamslam.team.wire.logs import LIMITS  # after the import hook

    LIMITS.forget()
    if "PYTEST_XDIST_WORKER" in os.environ and not item.nodeid.startswith(SYSTEM):
        os.setpriority(os.PRIO_PROCESS, 0, max(BESIDE, os.getpriority(os.PRIO_PROCESS, 0)))


SYSTEM = "tests/system/"


LAUNCHED = tuple(f"{SYSTEM}test_{name}.py" for name in ("launch", "replay"))
"""They look at the same launches, which are made once for the worker that runs both."""
FIRST = (
    *LAUNCHED, f"{SYSTEM}test_bad_input.py", SYSTEM,
    "tests/recording/", "tests/keys/", "tests/wire/", "tests/sim/", "tests/central/", "tests/test_",
    "tests/studies/", "tests/estimation/", "tests/hostile/",
)  # fmt: skip
"""The tests that start processes come first, since they take longest; short files are last, so that
the workers end together."""
TEAMS = 2
"""So many workers run tests of processes at a time; the third has what they leave of the time."""
BESIDE = 5
"""Niceness of the tests that start no processes: those of a team are punctual on a busy machine."""


def pytest_configure(config: pytest.Config) -> None:
    """Let each worker of a full run collect another part first, so that they share byte code."""
    number = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
    if number and config.args == config.getini("testpaths"):
        (folder,) = config.args
        parts = sorted(str(each) for each in config.rootpath.joinpath(folder).iterdir())
        parts = [
            each for each in parts if "__" not in each and (os.path.isdir(each) or "test_" in each)
        ]
        at = len(parts) * number // int(os.environ["PYTEST_XDIST_WORKER_COUNT"])
        config.args = parts[at:] + parts[:at]


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    def rank(item: pytest.Item) -> tuple[int, str]:
        first = (k for k, at in enumerate(FIRST) if item.nodeid.startswith(at))
        return next(first, len(FIRST)), item.nodeid.partition("::")[0]

    items.sort(key=rank)
    defects = DEFECTS.read_text("utf-8").splitlines()
    for item in items:
        if item.nodeid in defects:
            reason = "an open defect: tests/open_defects.txt"
            item.add_marker(pytest.mark.xfail(reason=reason, strict=True))


class Shares(LoadScopeScheduling):
    """Scheduler that gives a worker whole files, whose fixtures are shared.

    Files of tests/system go to the first TEAMS workers while others are left: few teams at a time.
    """

    def _split_scope(self, nodeid: str) -> str:
        file = nodeid.partition("::")[0]
        return SYSTEM if file in LAUNCHED else file

    def _assign_work_unit(self, node: WorkerController) -> None:
        if list(self.registered_collections).index(node) >= TEAMS:
            others = (each for each in self.workqueue if not each.startswith(SYSTEM))
            if (other := next(others, None)) is not None:
                self.workqueue.move_to_end(other, last=False)
        super()._assign_work_unit(node)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Producer) -> Shares:
    config.option.loadscopereorder = False
    return Shares(config, log)
