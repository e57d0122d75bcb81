"""What holds in every test run: one BLAS thread, checked shapes, repeatable examples.

System tests run one by one, beside the others.
"""

import os

for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[variable] = "1"  # before NumPy is imported, here and in every child process

import pytest
from hypothesis import settings
from jaxtyping import install_import_hook
from xdist.remote import Producer
from xdist.scheduler import LoadScopeScheduling

import tests.kernels
import tests.shapes

# The same examples in every run: what fails once fails again. HYPOTHESIS_SEARCH=1 finds new ones.
settings.register_profile("repeatable", derandomize="HYPOTHESIS_SEARCH" not in os.environ)
settings.load_profile("repeatable")

install_import_hook(["team", "central", "sim"], f"{tests.shapes.__name__}.checked")


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup() -> None:
    """Before a test's own fixtures; those of a module are checked with its first test."""
    tests.shapes.begin_test()


SYSTEM = "tests/system/"


def pytest_collection_finish(session: pytest.Session) -> None:
    """Notes which kernels the import of the tests has called: test_compiled.py looks at it.

    In a fresh clone one worker would compile them, and the others wait for it.
    """
    session.config.stash[tests.kernels.AT_IMPORT] = tests.kernels.called()


FIRST = (SYSTEM, "tests/recording/", "tests/keys/", "tests/wire/")
"""The tests that start processes come first, theirs is the longest share; then tests that need few
kernels, so that in a fresh clone the first launch compiles them while nobody else does the same.
"""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Those of FIRST in its order, then the others in theirs."""

    def rank(item: pytest.Item) -> int:
        return next((k for k, at in enumerate(FIRST) if item.nodeid.startswith(at)), len(FIRST))

    items.sort(key=rank)


class Shares(LoadScopeScheduling):
    """A worker gets a file, whose tests share what is made for them, or all tests of processes.

    Those run one by one, so that they do not starve each other.
    """

    def _split_scope(self, nodeid: str) -> str:
        return SYSTEM if nodeid.startswith(SYSTEM) else nodeid.partition("::")[0]


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Producer) -> Shares:
    """Shares are given out in the order of the tests, not by how many tests they hold."""
    config.option.loadscopereorder = False
    return Shares(config, log)
