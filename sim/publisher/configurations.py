"""Check that robots and centre run with the configurations of the scenario."""

import json
from collections.abc import Collection, Iterator, Mapping
from typing import Any

from teamslam.team.wire import messages as m

SHOWN = 3
"""Most differing fields in a warning."""
REMEDY = "start it again with the same scenario and options"


class Configurations:
    """Expected configurations by node, and received announcements."""

    def __init__(self, expected: Mapping[str, m.Configuration]) -> None:
        self._expected = expected
        self._announced: set[str] = set()
        self._right: set[str] = set()
        self._mismatches: dict[str, str] = {}

    def take(self, announced: m.Configuration) -> None:
        """Compare an announcement."""
        if not self._expected:
            return
        node = announced.node
        self._announced.add(node)
        self._mismatches.pop(node, None)
        expected = self._expected.get(node)
        if expected is None:
            self._mismatches[node] = (
                f"{node} is not in the world's scenario, which has {', '.join(self._expected)}: "
                + REMEDY
            )
        elif announced.digest != expected.digest:
            found = differences(announced.configuration, expected.configuration)
            more = f", and {len(found) - SHOWN} more" if len(found) > SHOWN else ""
            self._mismatches[node] = (
                f"{node} differs from the world's scenario: {', '.join(found[:SHOWN])}{more}: "
                + REMEDY
            )
        else:
            self._right.add(node)

    @property
    def mismatches(self) -> tuple[str, ...]:
        """Deviating nodes, their fields and the remedy, by node."""
        return tuple(self._mismatches[node] for node in sorted(self._mismatches))

    @property
    def forbid(self) -> bool:
        """Whether a scenario's node announced only wrong configurations.

        If both arrived, another process uses the name: a warning, but the world begins.
        """
        return bool(self._mismatches.keys() & self._expected.keys() - self._right)

    def unheard(self, nodes: Collection[str]) -> list[str]:
        """Nodes whose expected announcement has not arrived."""
        return sorted((self._expected.keys() & set(nodes)) - self._announced)


def differences(announced: str, expected: str) -> list[str]:
    """Differing fields of two JSON configurations, with both values."""
    theirs, ours = dict(_fields(json.loads(announced))), dict(_fields(json.loads(expected)))
    return [
        f"{name} is {theirs.get(name, 'absent')} there and {ours.get(name, 'absent')} here"
        for name in sorted(theirs.keys() | ours.keys())
        if theirs.get(name) != ours.get(name)
    ]


def _fields(value: Any, at: str = "") -> Iterator[tuple[str, str]]:
    if isinstance(value, dict) and value:
        for name, part in value.items():
            yield from _fields(part, f"{at}.{name}" if at else name)
    else:
        yield at, json.dumps(value)
