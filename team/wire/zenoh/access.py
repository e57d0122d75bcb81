"""Access control at the router: a node publishes its own keys and receives its team's.

Each node has a rule, for its certificate's common name, with its advanced publishers' caches and
heartbeats, `…/@adv/pub/*/*/*`.
"""

from collections.abc import Sequence
from typing import Any

from teamslam.team.keys.roster import REPLAY, Roster
from teamslam.team.wire import channels as ch
from teamslam.team.wire.zenoh.session import DOOR

_SAYS = ("put", "reply", "declare_queryable", "liveliness_token")
_LISTENS = ("declare_subscriber", "query", "declare_liveliness_subscriber", "liveliness_query")
_HEARS = ("put", "reply", "liveliness_token", "declare_subscriber", "query")
TRUTHS = (ch.TRUTH, ch.TRUTH_LANDMARKS, ch.TRUTH_LABELS, ch.TRUTH_POSITIONS)
"""Channels that no estimator may receive."""


def list_owned_keys(node: str) -> tuple[str, ...]:
    """Return the keys, relative to the team, that only this node may publish and answer on.

    The world drives every robot's sensors, so it shares those keys with each `source-…`.
    """
    kind, _, name = node.partition("-")
    if node == REPLAY:
        return tuple(key for channel in ch.CHANNELS for key in channel.selectors())
    found = [key for channel in ch.CHANNELS for key in _keys_of(channel, kind, name)]
    return tuple(dict.fromkeys(found))


def _keys_of(channel: ch.Channel, kind: str, name: str) -> tuple[str, ...]:
    first, _, rest = channel.template.partition("/")
    if first == "{node}":
        return channel.selectors(f"{kind}/{name}" if name else kind)
    if name:
        is_own = first == kind and rest.startswith("{robot}")
        return channel.selectors(name) if is_own else ()
    is_own = first == {"viewer": "view"}.get(kind, kind)
    is_worlds = kind == "world" and (first == "source" or channel in TRUTHS)
    return channel.selectors() if is_own or is_worlds else ()


def access_control(roster: Roster) -> dict[str, Any]:
    """Return Zenoh's `access_control` for a team; everything else is refused."""
    prefix = f"team/{roster.team}/"
    every = [f"{prefix}**", f"{prefix}**/@adv/**"]
    truths = [key for channel in TRUTHS for key in channel.selectors()]
    rules = [
        _rule("listen", "ingress", _LISTENS, every),
        _rule("hear", "egress", _HEARS, every),
        _rule("no truth", "egress", ("put", "reply"), _keys(prefix, truths), allow=False),
    ]
    door = [f"{prefix}{DOOR}/*"]
    rules += [
        _rule("ask at the door", "ingress", ("query",), door),
        _rule("be told at the door", "egress", ("reply",), door),
    ]
    # Answers nodes without a rule of their own, such as those with a revoked certificate.
    subjects: list[dict[str, object]] = [{"id": "any certificate", "link_protocols": ["tls"]}]
    policies = [
        {"rules": ["ask at the door", "be told at the door"], "subjects": ["any certificate"]}
    ]
    for node in sorted(roster.nodes):
        rules.append(_rule(f"own {node}", "ingress", _SAYS, _keys(prefix, list_owned_keys(node))))
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
    return [f"{prefix}{key}{rest}" for key in keys for rest in ("", "/@adv/pub/*/*/*")]


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
