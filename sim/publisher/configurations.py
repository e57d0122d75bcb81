"""Check that robots and centre run with the configurations that the world's scenario gives them.

Processes that were started by hand may have been given other options. The announcement of each
robot and of the centre is compared with the scenario, field by field.
"""

import json
from collections.abc import Collection, Iterator, Mapping
from typing import Any

from team.wire import messages as m

SHOWN = 3
"""Most differing fields that a warning names; with a whole other scenario there are dozens."""
REMEDY = "start it again with the same scenario and options"


class Configurations:
    """The expected configurations by node, and the announcements that have arrived.

    A node's newest announcement counts. Nothing is compared where nothing is expected.
    """

    def __init__(self, expected: Mapping[str, m.Configuration]) -> None:
        self._expected = expected
        self._announced: set[str] = set()
        self._right: set[str] = set()
        self._mismatches: dict[str, str] = {}

    def take(self, announced: m.Configuration) -> None:
        """Take one announcement."""
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
        """The nodes with another configuration, the fields in which it differs, and the remedy; by
        node.
        """
        return tuple(self._mismatches[node] for node in sorted(self._mismatches))

    @property
    def forbid(self) -> bool:
        """Whether a node of the scenario has announced another configuration, and never the right
        one.

        Where both have arrived, another process, or a stranger, uses the node's name: that is a
        warning, as for nodes that are not in the scenario, but the world begins.
        """
        return bool(self._mismatches.keys() & self._expected.keys() - self._right)

    def unheard(self, nodes: Collection[str]) -> list[str]:
        """Those of these nodes whose announcement is expected and has not arrived."""
        return sorted((self._expected.keys() & set(nodes)) - self._announced)


def differences(announced: str, expected: str) -> list[str]:
    """The fields in which two configurations in JSON differ, with both values, by name."""
    theirs, ours = dict(_fields(json.loads(announced))), dict(_fields(json.loads(expected)))
    return [
        f"{name} is {theirs.get(name, 'absent')} there and {ours.get(name, 'absent')} here"
        for name in sorted(theirs.keys() | ours.keys())
        if theirs.get(name) != ours.get(name)
    ]


def _fields(value: Any, at: str = "") -> Iterator[tuple[str, str]]:
    """(path, value in JSON) of every field that is not a table itself."""
    if isinstance(value, dict) and value:
        for name, part in value.items():
            yield from _fields(part, f"{at}.{name}" if at else name)
    else:
        yield at, json.dumps(value)
