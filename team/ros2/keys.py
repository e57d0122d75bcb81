"""The Zenoh keys of ROS 2 topics: those of rmw_zenoh and of zenoh-bridge-ros2dds.

rmw_zenoh   <domain>/<topic>/<pkg>::msg::dds_::<Type>_/<hash of the type>
bridge      <topic>, and a liveliness token @/<id>/@ros2_lv/MP/<topic>/<type>/<QoS>, with § for /
"""

import re
from collections.abc import Iterable

RMW_TYPE = re.compile(r"^(\w+)::(msg)::dds_::(\w+)_$")
BRIDGE_TOKENS = "@/*/@ros2_lv/MP/**"
SLASH = "§"
STATIC = "tf_static"
MOVING = "tf"


def expressions(topics: Iterable[str], domain: int) -> list[str]:
    """Key expressions to subscribe to, of both kinds."""
    names = [topic.strip("/") for topic in topics]
    return [*names, *(f"{domain}/{name}/*/*" for name in names)]


def of_rmw(key: str, domain: int) -> tuple[str, str] | None:
    """Topic and type from a key of rmw_zenoh; None for any other key."""
    parts = key.split("/")
    if len(parts) < 4 or parts[0] != str(domain):
        return None
    match = RMW_TYPE.match(parts[-2])
    return None if match is None else ("/" + "/".join(parts[1:-2]), "/".join(match.groups()))


def of_token(key: str) -> tuple[str, str] | None:
    """Topic and type from the key of a bridge's liveliness token; None for any other key."""
    parts = key.split("/")
    if len(parts) < 6 or parts[2:4] != ["@ros2_lv", "MP"]:
        return None
    return "/" + parts[4].replace(SLASH, "/").strip("/"), parts[5].replace(SLASH, "/")


def static_topics(odometry: str) -> set[str]:
    """The topics of a robot's static transforms: /tf_static, and those in its namespaces."""
    return _in_spaces(odometry, STATIC)


def moving_topics(odometry: str) -> set[str]:
    """The topics of a robot's other transforms: /tf, and those in its namespaces."""
    return _in_spaces(odometry, MOVING)


def _in_spaces(odometry: str, name: str) -> set[str]:
    spaces = odometry.strip("/").split("/")[:-1]
    return {"/" + "/".join([*spaces[:k], name]) for k in range(len(spaces) + 1)}
