"""The table of channels: the only place where a key is spelt.

Keys are relative to the team; a bus puts `team/<team name>/` before them. Who says something owns
the key's prefix: a robot's process `robot/{robot}/…`, its driver `source/{robot}/…`, an operator
`operator/…`, the others those of their name. So a certificate for a prefix is one for a voice. The
world is the source of every robot, and the truth is its own too.

`{robot}` stands for a robot's name, `{node}` for `world`, `central`, `recorder`, `viewer` or
`robot/<name>`, `{view}` for a view (`team.wire.views`). In the rates an incarnation is one life of
a robot's stream (the messages' `incarnation`), a keyframe one incarnation of observation.
"""

import re
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

from team.wire import messages as m

Delivery = Literal["stream", "latest", "all"]
"""How a message must arrive. Nothing is ever dropped by congestion; beyond that:

stream: what a receiver misses it asks its source for, by the measurement counter.
latest: a late joiner gets the newest one, a cut link recovers what it missed.
all:    a late joiner and a cut link get every one.
"""


_PLACE = re.compile(r"\{(robot|node|view)\}")
_NAME = "[a-z][a-z0-9_]{0,31}"
_PATTERNS = {"robot": _NAME, "node": f"{_NAME}(?:/{_NAME})?", "view": ".+"}


@dataclass(frozen=True)
class Channel:
    """One row: what travels on a key, how often, how, and what a log does with it."""

    name: str
    template: str
    message: type[m.Message]
    rate: str
    delivery: Delivery
    recorded: bool
    recomputable: bool
    meaning: str

    def key(self, name: str = "") -> str:
        """The key for one robot or node."""
        return _PLACE.sub(name, self.template)

    def speaker(self, name: str) -> str:
        """The node that publishes the key for one robot or node."""
        first, _, rest = self.template.partition("/")
        if first == "{node}":
            return name
        return f"robot/{name}" if first == "robot" and rest.startswith("{robot}") else first

    def owner(self, key: str) -> str | None:
        """The robot or node that `key` belongs to on this channel; None when it is another's."""
        parts = _PLACE.split(self.template)
        pattern = re.escape(parts[0])
        if len(parts) > 1:
            pattern += f"(?P<name>{_PATTERNS[parts[1]]}){re.escape(parts[2])}"
        match = re.fullmatch(pattern, key)
        return None if match is None else match.groupdict().get("name", "")


START = Channel("start", "source/{robot}/start", m.InitialPose, "once per incarnation", "all", True, False,
                "measurement 0: the initial pose, if known")  # fmt: skip
ODOMETRY = Channel("odometry", "source/{robot}/odometry", m.Odometry, "8-100 Hz", "stream", True,
                   False, "one odometry interval")  # fmt: skip
OBSERVATIONS = Channel("observations", "source/{robot}/observations", m.Observations, "1-30 Hz",
                       "stream", True, False, "landmarks seen")  # fmt: skip
SIGHTINGS = Channel("sightings", "source/{robot}/sightings", m.Sightings, "0-10 Hz", "stream", True,
                    False, "teammates seen")  # fmt: skip
SENSORS = (START, ODOMETRY, OBSERVATIONS, SIGHTINGS)

TRUTH = Channel("truth", "truth/{robot}", m.Truth, "1 Hz, batched", "all", True, False,
                "true poses; the evaluator's only")  # fmt: skip
TRUTH_LANDMARKS = Channel("truth_landmarks", "truth_landmarks", m.TruthLandmarks, "once", "latest",
                          True, False, "true landmarks; the evaluator's only")  # fmt: skip

ROBOT_CONFIG = Channel("robot_config", "robot/{robot}/config", m.Configuration, "once per incarnation",
                       "latest", True, False, "the robot's configuration")  # fmt: skip
SUBMAP = Channel("submap", "robot/{robot}/submap", m.Submap, "one per window", "all", True, True,
                 "what the rule `join` consumes")  # fmt: skip
SIGHTING_FACTOR = Channel("sighting_factor", "robot/{robot}/sighting_factor", m.SightingFactor,
                          "0-1 per teammate and node", "all", True, True,
                          "a teammate seen from a pose node; what the rule `join` consumes")  # fmt: skip
RENDEZVOUS = Channel("rendezvous", "robot/{robot}/rendezvous", m.Rendezvous,
                     "0-1 per window and meeting", "all", True, False,
                     "held submaps are sent, since a teammate is seen; who is seen sends too")  # fmt: skip
OWN_MAP = Channel("own_map", "robot/{robot}/own/map", m.MapEstimate, "one per window or exchange",
                  "latest", True, True,
                  "running landmark means and covariances; consumed by rules with feedback")  # fmt: skip
OWN_POSE = Channel("own_pose", "robot/{robot}/own/pose", m.PoseEstimate, "one per keyframe", "latest",
                   True, True, "running pose from own measurements alone")  # fmt: skip
TEAM_POSE = Channel("team_pose", "robot/{robot}/team/pose", m.PoseEstimate, "one per keyframe",
                    "latest", True, True, "pose given the fused map; never an input of fusion")  # fmt: skip
PARTICLES = Channel("particles", "robot/{robot}/particles", m.ParticleCloud, "one per window",
                    "latest", True, True, "thinned cloud, for viewers")  # fmt: skip
INNOVATION = Channel("innovation", "robot/{robot}/innovation", m.Innovation, "one per window", "latest",
                     True, True, "how well a window's measurements were predicted (NIS)")  # fmt: skip
ROBOT_PROGRESS = Channel("robot_progress", "robot/{robot}/progress", m.Progress, "every 64 measurements",
                         "latest", True, False, "credit for the world")  # fmt: skip
ROBOT_DONE = Channel("robot_done", "robot/{robot}/done", m.Done, "once per incarnation", "latest", True,
                     True, "all measurements consumed, last submap sent")  # fmt: skip

CENTRAL_CONFIG = Channel("central_config", "central/config", m.Configuration, "once", "latest", True,
                         False, "the centre's configuration")  # fmt: skip
FUSED_MAP = Channel("fused_map", "central/map", m.FusedMap, "one per broadcast", "latest", True,
                    True, "the team's map")  # fmt: skip
PRIOR = Channel("prior", "central/prior/{robot}", m.Prior, "one per broadcast", "latest", True,
                True, "the joint marginal that a robot needs")  # fmt: skip
ORDER = Channel("order", "operator/withdrawal/{robot}", m.Withdrawal, "once", "all", True, False,
                "an operator's order: the team goes on without the robot")  # fmt: skip
WITHDRAWAL = Channel("withdrawal", "central/withdrawal/{robot}", m.Withdrawal, "once", "all", True, False,
                     "the team goes on without the robot; every order that the centre follows")  # fmt: skip
WITHDRAWALS_HEARD = Channel("withdrawals_heard", "robot/{robot}/withdrawals", m.WithdrawalHeard,
                            "once per order", "all", True, False,
                            "an order that the robot has heard, for a centre that is started again")  # fmt: skip
GIVEN_UP = Channel("given_up", "operator/given_up/{node}", m.GivenUp, "once", "all", True, False,
                   "an order: nobody waits for the node any more")  # fmt: skip
FINAL_MAP = Channel("final_map", "central/final", m.FusedMap, "once", "latest", True, True,
                    "the team's map with its joint covariance")  # fmt: skip
TRAJECTORY = Channel("trajectory", "central/trajectory/{robot}", m.Trajectory, "once per incarnation",
                     "all", True, True, "smoothed end poses of the submaps, or of all keyframes")  # fmt: skip
CENTRAL_POSE = Channel("central_pose", "central/pose/{robot}", m.PoseEstimate, "one per keyframe or broadcast",
                       "latest", True, True, "running pose by a rule on raw measurements")  # fmt: skip
CENTRAL_PROGRESS = Channel("central_progress", "central/progress/{robot}", m.Progress,
                           "one per submap", "latest", True, False, "credit for the robots")  # fmt: skip

WORLD_CONFIG = Channel("world_config", "world/config", m.Configuration, "once", "latest", True, False,
                       "the scenario")  # fmt: skip
KNOWN_MAP = Channel("known_map", "world/known_map", m.KnownMap, "once", "latest", True, False,
                    "the map that robots are told that only localise themselves")  # fmt: skip
END = Channel("end", "world/end", m.End, "once", "latest", True, False,
              "everything is published; the last counters")  # fmt: skip
RECORDER_PROGRESS = Channel("recorder_progress", "recorder/progress/{robot}", m.Progress,
                            "every 256 measurements", "latest", False, False,
                            "credit for the world")  # fmt: skip
STATUS = Channel("status", "{node}/status", m.Status, "1 Hz", "latest", True, False,
                 "what a node is doing, for people")  # fmt: skip
FAULT = Channel("fault", "{node}/fault", m.Fault, "when a handling raises", "all", True, False,
                "a message that a node could not handle and set aside")  # fmt: skip
ALIVE = Channel("alive", "{node}/alive", m.Liveliness, "on change", "latest", True, False,
                "liveliness token; its changes are logged as messages")  # fmt: skip

TALLY = Channel("tally", "{node}/tally", m.Tally, "once, at its end", "latest", True, False,
                "how many messages the node's process has published on each key")  # fmt: skip

MEASUREMENTS = Channel("readings", "source/{robot}/readings", m.MeasurementsRequest, "query", "stream", False,
                   False, "a query; the replies are the measurements")  # fmt: skip
SUBMAPS = Channel("submaps", "central/submaps", m.SubmapsRequest, "query", "stream", False, False,
                  "a query; the replies are the starts, submaps and sightings in the centre's set")  # fmt: skip
SENT = Channel("sent", "robot/{robot}/submaps", m.SubmapsRequest, "query", "stream", False, False,
               "a query; the replies are the starts, submaps and sightings that the robot has sent")  # fmt: skip

FINAL_KEPT = Channel("final_kept", "router/final", m.FinalMapRequest, "query", "stream", False, False,
                     "a query; the reply is the final map, when the centre has left, too")  # fmt: skip

ORDERS_KEPT = Channel("orders_kept", "router/orders", m.OrdersRequest, "query", "stream", False, False,
                      "a query; the replies are the orders `given_up` that hold, when who gave them has left, too")  # fmt: skip

VIEW = Channel("view", "view/{view}", m.Message, "about 1 Hz of team time", "latest", True, False,
               "what viewers draw, by Foxglove's schemas; see Views")  # fmt: skip

CHANNELS: tuple[Channel, ...] = tuple(v for v in list(globals().values()) if isinstance(v, Channel))
QUERIES = (MEASUREMENTS, SUBMAPS, SENT, FINAL_KEPT, ORDERS_KEPT)
REPLIES = {
    MEASUREMENTS: SENSORS,
    SUBMAPS: (START, SUBMAP, SIGHTING_FACTOR),
    SENT: (START, SUBMAP, SIGHTING_FACTOR),
    ORDERS_KEPT: (GIVEN_UP,),
}
"""The channels whose messages answer a query."""
UNOPENED = (*QUERIES, VIEW)
"""Rows whose traffic is not opened: queries have no samples, a view is no message of ours."""
EVERYTHING = "**"


def robot_node(robot: str) -> str:
    """The node name of a robot, as liveliness tokens and status carry it."""
    return f"robot/{robot}"


def robot_of(node: str) -> str | None:
    """The robot of a node's name; None if the node is none."""
    kind, _, robot = node.partition("/")
    return robot if kind == "robot" else None


@lru_cache(maxsize=4096)
def channel_of(key: str) -> tuple[Channel, str] | None:
    """The channel that a relative key belongs to, and the robot or node in it."""
    for channel in CHANNELS:
        if channel not in UNOPENED and (name := channel.owner(key)) is not None:
            return channel, name
    return None


def row_of(key: str) -> Channel | None:
    """The row of a relative key, a view's too."""
    found = channel_of(key)
    if found is not None:
        return found[0]
    return VIEW if VIEW.owner(key) is not None else None
