"""Roster of a team: nodes with a certificate, and their common names.

A node is one sender: `robot-<name>`, `source-<name>` (its driver), `central`, `world`, `recorder`,
`viewer`, `operator` (commands such as `launch`, `withdraw`), `router`, and on request `replay`,
which may publish on every key.
"""

import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import msgspec

ROSTER = "roster.json"
STANDING = ("central", "operator", "recorder", "router", "viewer", "world")  # nodes of every team
REPLAY = "replay"
TEAM = re.compile("[A-Za-z0-9._-]{1,64}")
ROBOT = re.compile("[a-z][a-z0-9_]{0,31}")


class KeysError(RuntimeError):
    """Keys are missing, mismatched or cannot be created; the text has the remedy."""


class Issued(NamedTuple):
    """Issued certificate: generation, and Unix time of its end [ns]."""

    generation: int
    ends_ns: int


class Roster(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The roster file: certificate generations, hosts of the router, last revoked generations."""

    team: str
    nodes: dict[str, int]
    hosts: tuple[str, ...] = ()
    revoked: dict[str, int] = msgspec.field(default_factory=dict)

    def common_name(self, node: str) -> str:
        """Return the node's name at the router."""
        return common_name(node, self.nodes[node])

    @property
    def robots(self) -> list[str]:
        """Robot names, ascending."""
        return sorted(n.removeprefix("robot-") for n in self.nodes if n.startswith("robot-"))


def common_name(node: str, generation: int) -> str:
    """Name a node's certificate: `robot-r1`; its second generation is `robot-r1.2`."""
    return node if generation == 1 else f"{node}.{generation}"


def nodes_of(robots: Iterable[str]) -> list[str]:
    """Return the nodes of a team with these robots."""
    names = list(robots)
    return [*STANDING, *(f"{kind}-{name}" for name in names for kind in ("robot", "source"))]


def is_node(text: str) -> bool:
    """Return whether this is a valid node name."""
    kind, dash, name = text.partition("-")
    if not dash:
        return text in (*STANDING, REPLAY)
    return kind in ("robot", "source") and ROBOT.fullmatch(name) is not None


def load_roster(folder: Path) -> Roster:
    """Load the roster of a key folder; raises KeysError."""
    path = folder / ROSTER
    try:
        roster = msgspec.json.decode(path.read_bytes(), type=Roster)
    except OSError as error:
        raise KeysError(
            f"{path}: {error.strerror or error}; the router needs the roster: "
            f"copy it from where `teamslam keys` made it"
        ) from None
    except msgspec.DecodeError as error:
        raise KeysError(f"{path}: not a roster: {error}") from None
    wrong = [node for node in roster.nodes if not is_node(node)]
    if wrong or not TEAM.fullmatch(roster.team):
        raise KeysError(f"{path}: {(wrong or [roster.team])[0]!r} is no name of a node or a team")
    return roster


def roster_bytes(roster: Roster) -> bytes:
    """Encode the roster file."""
    return msgspec.json.format(msgspec.json.encode(roster, order="deterministic"), indent=2) + b"\n"


def choose_nodes(nodes: Sequence[str], roster: Roster) -> list[str]:
    """Select named nodes, or `all`; raises KeysError for one without a certificate."""
    if "all" in nodes:
        return sorted(roster.nodes)
    for node in nodes:
        if node not in roster.nodes:
            known = ", ".join(sorted(roster.nodes))
            raise KeysError(f"no certificate of {node!r}; there are: {known}")
    return list(nodes)
