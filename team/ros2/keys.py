"""The Zenoh keys of ROS 2 topics: those of rmw_zenoh and of zenoh-bridge-ros2dds.

rmw_zenoh   <domain>/<topic>/<pkg>::msg::dds_::<Type>_/<hash of the type>
bridge      <topic>, and a liveliness token @/<id>/@ros2_lv/MP/<topic>/<type>/<QoS>, with § for /
"""

import re
from collections.abc import Iterable
from typing import NamedTuple

RMW_TYPE = re.compile(r"^(\w+)::(msg)::dds_::(\w+)_$")
BRIDGE_TOKENS = "@/*/@ros2_lv/MP/**"
SLASH = "§"
ESCAPED = "%"  # stands for / in the liveliness tokens of rmw_zenoh
STATIC = "tf_static"
MOVING = "tf"


def expressions(topics: Iterable[str], domain: int) -> list[str]:
    """Return the key expressions of topics, of both kinds."""
    names = [topic.strip("/") for topic in topics]
    return [*names, *(f"{domain}/{name}/*/*" for name in names)]


def of_rmw(key: str, domain: int) -> tuple[str, str] | None:
    """Return topic and type of a key of rmw_zenoh, or None."""
    parts = key.split("/")
    if len(parts) < 4 or parts[0] != str(domain):
        return None
    match = RMW_TYPE.match(parts[-2])
    return None if match is None else ("/" + "/".join(parts[1:-2]), "/".join(match.groups()))


def of_token(key: str) -> tuple[str, str] | None:
    """Return topic and type of a bridge's liveliness token, or None."""
    parts = key.split("/")
    if len(parts) < 6 or parts[2:4] != ["@ros2_lv", "MP"]:
        return None
    return "/" + parts[4].replace(SLASH, "/").strip("/"), parts[5].replace(SLASH, "/")


def static_topics(odometry: str) -> set[str]:
    """Return /tf_static and its equivalents in a robot's namespaces."""
    return _in_spaces(odometry, STATIC)


def moving_topics(odometry: str) -> set[str]:
    """Return /tf and its equivalents in a robot's namespaces."""
    return _in_spaces(odometry, MOVING)


def _in_spaces(odometry: str, name: str) -> set[str]:
    spaces = odometry.strip("/").split("/")[:-1]
    return {"/" + "/".join([*spaces[:k], name]) for k in range(len(spaces) + 1)}


class Publication(NamedTuple):
    """Keys for subscribers by rmw_zenoh and behind the bridge, and the topic's tokens."""

    rmw: str
    bridge: str
    tokens: tuple[str, ...]


def publication(
    topic: str,
    kind: str,
    type_hash: str,
    *,
    latched: bool,
    domain: int,
    node: str,
    session: str,
    entity: int,
) -> Publication:
    """Return keys and tokens of a topic of the node `node` (without namespace) in a Zenoh session.

    rmw_zenoh, docs/design.md: <domain>/<topic>/<type>/<hash>, and tokens

      @ros2_lv/<domain>/<session>/<node>/<entity>/{NN,MP}/<enclave>/<namespace>/<node>
      [/<topic>/<type>/<hash>/<QoS>]

    with the QoS as reliability:durability:history,depth:deadline:lifespan:liveliness (empty:
    default). zenoh-plugin-ros2dds: <topic>, and

      @/<session>/@ros2_lv/MP/<topic>/<type>/
      <keyless>:<reliability>:<durability>:<history>,<depth>:<user data>

    Every topic is reliable; a latched one is transient local with a depth of 1, another one
    volatile with a depth of 10.
    """
    name = topic.strip("/")
    package, _, short = kind.partition("/msg/")
    dds = f"{package}::msg::dds_::{short}_"
    depth = 1 if latched else 10
    of_node = f"@ros2_lv/{domain}/{session}/0"
    quality = f":{1 if latched else ''}:,{depth}:,:,:,,"
    about = f"{ESCAPED}{name.replace('/', ESCAPED)}/{dds}/{type_hash}/{quality}"
    bridged = f"{name.replace('/', SLASH)}/{kind.replace('/', SLASH)}"
    return Publication(
        f"{domain}/{name}/{dds}/{type_hash}",
        name,
        (
            f"{of_node}/0/NN/{ESCAPED}/{ESCAPED}/{node}",
            f"{of_node}/{entity}/MP/{ESCAPED}/{ESCAPED}/{node}/{about}",
            f"@/{session}/@ros2_lv",
            f"@/{session}/@ros2_lv/MP/{bridged}/:1:{int(latched)}:0,{depth}:typehash={type_hash};",
        ),
    )
