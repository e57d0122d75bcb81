"""What holds in every test run: one BLAS thread, checked shapes, repeatable examples.

System tests run one by one.
"""

import os

for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[variable] = "1"  # before NumPy is imported, here and in every child process

import pytest
from hypothesis import settings
from jaxtyping import install_import_hook

import tests.shapes

# The same examples in every run: what fails once fails again. HYPOTHESIS_SEARCH=1 finds new ones.
settings.register_profile("repeatable", derandomize="HYPOTHESIS_SEARCH" not in os.environ)
settings.load_profile("repeatable")

install_import_hook(["team", "central", "sim"], f"{tests.shapes.__name__}.checked")


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup() -> None:
    """Before a test's own fixtures; those of a module are checked with its first test."""
    tests.shapes.begin_test()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Tests that start processes share one worker, so that they do not starve each other."""
    for item in items:
        if "system" in item.path.relative_to(item.config.rootpath).parts:
            item.add_marker(pytest.mark.xdist_group("system"))
