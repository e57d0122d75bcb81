"""Access control at the router: each node may publish its own keys, and receive those of its team.

Zenoh's rules select by message, direction (as the router sees it) and key; a subject is the common
name of a certificate. There are no templates, so each node has a rule. Beside its own keys a node
needs those of the caches and heartbeats of its advanced publishers, `…/@adv/**`.
"""

from collections.abc import Sequence
from typing import Any

from team.keys.roster import REPLAY, Roster
from team.wire.zenoh.session import DOOR

_SAYS = ("put", "reply", "declare_queryable", "liveliness_token")
_LISTENS = ("declare_subscriber", "query", "declare_liveliness_subscriber", "liveliness_query")
_HEARS = ("put", "reply", "liveliness_token", "declare_subscriber", "query")
TRUTH = ("truth/**", "truth_landmarks", "truth_labels/**", "truth_positions/**")
"""Keys that no estimator may receive."""


def owned(node: str) -> tuple[str, ...]:
    """The keys, relative to the team, that only this node may publish, answer and hold tokens on.

    The world is the driver of every robot's sensors, so it shares those with each `source-…`.
    """
    kind, _, name = node.partition("-")
    if name:
        return (f"{kind}/{name}/**",)
    if node == "world":
        return ("world/**", "source/**", *TRUTH)
    if node == "viewer":
        return ("viewer/**", "view/**")
    return ("**",) if node == REPLAY else (f"{node}/**",)


def access_control(roster: Roster) -> dict[str, Any]:
    """Zenoh's `access_control` for a team: whatever no rule allows is refused."""
    prefix = f"team/{roster.team}/"
    every = _keys(prefix, ("**",))
    rules = [
        _rule("listen", "ingress", _LISTENS, every),
        _rule("hear", "egress", _HEARS, every),
        _rule("no truth", "egress", ("put", "reply"), _keys(prefix, TRUTH), allow=False),
    ]
    door = [f"{prefix}{DOOR}/*"]
    rules += [
        _rule("ask at the door", "ingress", ("query",), door),
        _rule("be told at the door", "egress", ("reply",), door),
    ]
    # Who has no other rule, as a revoked certificate, is told so.
    subjects: list[dict[str, object]] = [{"id": "any certificate", "link_protocols": ["tls"]}]
    policies = [
        {"rules": ["ask at the door", "be told at the door"], "subjects": ["any certificate"]}
    ]
    for node in sorted(roster.nodes):
        rules.append(_rule(f"own {node}", "ingress", _SAYS, _keys(prefix, owned(node))))
        subjects.append({"id": node, "cert_common_names": [roster.common_name(node)]})
        blind = ["no truth"] if node == "central" or "-" in node else []
        policies.append({"rules": ["listen", "hear", *blind, f"own {node}"], "subjects": [node]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }


def _keys(prefix: str, keys: Sequence[str]) -> list[str]:
    """The keys and those of their publishers' caches; `**` does not match a part that begins with
    @.
    """
    return [f"{prefix}{key}{rest}" for key in keys for rest in ("", "/@adv/**")]


def _rule(
    name: str, flow: str, messages: Sequence[str], keys: Sequence[str], *, allow: bool = True
) -> dict[str, Any]:
    return {
        "id": name,
        "permission": "allow" if allow else "deny",
        "flows": [flow],
        "messages": list(messages),
        "key_exprs": list(keys),
    }
