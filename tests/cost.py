"""`python -m pytest -p tests.cost …`: CPU seconds of each file and of the most expensive tests.

A test's processes count once they were waited for; a file's fixtures count with its first test.
"""

import resource
from collections import Counter
from collections.abc import Generator
from typing import Any

import pytest

DEAREST = 30
_began = 0.0
_costs: Counter[str] = Counter()


def cpu_s() -> float:
    """CPU time [s] of this process and its ended children."""
    used = map(resource.getrusage, (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(each.ru_utime + each.ru_stime for each in used)


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_logstart() -> None:
    global _began
    _began = cpu_s()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(call: pytest.CallInfo[Any]) -> Generator[None, Any, Any]:
    """Attach a test's cost to its last report, which xdist transfers."""
    report = yield
    if call.when == "teardown":
        report.user_properties.append(("cpu_s", cpu_s() - _began))
    return report


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    for name, value in report.user_properties:
        if name == "cpu_s" and report.when == "teardown":
            _costs[report.nodeid] += value


def pytest_terminal_summary(terminalreporter: Any) -> None:
    files: Counter[str] = Counter()
    for test, cost in _costs.items():
        files[test.partition("::")[0]] += cost
    for title, costs in (("files", files), ("tests", _costs)):
        terminalreporter.section(f"CPU seconds of {title}, {sum(costs.values()):.0f} in all")
        for name, cost in costs.most_common(DEAREST):
            terminalreporter.write_line(f"{cost:7.1f}  {name}")
