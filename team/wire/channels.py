"""The table of channels, the only place of keys.

A bus puts `team/<team name>/` before a key. The first part of a key names its sender:
`robot/{robot}/…` a robot's process, `source/{robot}/…` its driver, `operator/…` an operator, the
others themselves; a certificate for that prefix authenticates the sender. The world is the source
of every robot, and owns the truth.

`{robot}`: a robot's name, or a saved map as `map-<name>`. `{node}`: `world`, `central`, `recorder`,
`viewer`, `robot/<name>` or `source/<name>`. `{view}`: a view (`teamslam.team.wire.views`).
"""

import re
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Literal

from teamslam.team.wire import messages as m

Delivery = Literal["stream", "latest", "all"]
"""Delivery of messages. A publisher blocks while its link is busy; the router drops messages to a
slower receiver, which fetches them as after a cut link.

stream: a receiver requests a missed message from its source, by the measurement counter.
latest: a late joiner receives the newest message; after a cut link the missed ones are recovered.
all: a late joiner, and a receiver after a cut link, receives every message.
"""


_PLACE = re.compile(r"\{(robot|node|view)\}")
_NAME = "[a-z][a-z0-9_]{0,31}"
_PATTERNS = {
    "robot": f"(?:map-)?{_NAME}",
    "node": f"{_NAME}(?:/{_NAME})?",
    "view": f"{_NAME}(?:/{_NAME})?",
}


@dataclass(frozen=True, eq=False)
class Channel:
    """One row: the message on a key, its rate, its delivery, and its place in a log.

    alternatives: further messages on the key. Rows are compared by identity.
    """

    name: str
    template: str
    message: type[m.Message]
    rate: str
    delivery: Delivery
    meaning: str
    recorded: bool = True
    recomputable: bool = False
    alternatives: tuple[type[m.Message], ...] = ()

    @cached_property
    def kinds(self) -> tuple[type[m.Message], ...]:
        """The types of messages on the key."""
        return (self.message, *self.alternatives)

    def kind_of(self, tag: str) -> type[m.Message]:
        """Return the type of message with this tag, or the first type."""
        return next((kind for kind in self.kinds if m.tag_of(kind) == tag), self.message)

    def key(self, name: str = "") -> str:
        """Return the key for one robot or node."""
        before, after = self._around
        return before + name + after if after is not None else before

    def selectors(self, name: str = "*") -> tuple[str, ...]:
        """Return the key expressions of one name, or of all (`*`), each of a fixed depth."""
        two = name == "*" and self._around[1] is not None and "{robot}" not in self.template
        return (self.key(name), self.key("*/*")) if two else (self.key(name),)

    def publisher(self, name: str) -> str:
        """Return the node that publishes the key for one robot or node."""
        first, _, rest = self.template.partition("/")
        if first == "{node}":
            return name
        return f"{first}/{name}" if first == "robot" and rest.startswith("{robot}") else first

    def owner(self, key: str) -> str | None:
        """Return the robot or node of `key`; None if it belongs to another channel."""
        match = self._pattern.fullmatch(key)
        return None if match is None else match.groupdict().get("name", "")

    @cached_property
    def _around(self) -> tuple[str, str | None]:
        parts = _PLACE.split(self.template)
        return parts[0], parts[2] if len(parts) > 1 else None

    @cached_property
    def _pattern(self) -> re.Pattern[str]:
        parts = _PLACE.split(self.template)
        pattern = re.escape(parts[0])
        if len(parts) > 1:
            pattern += f"(?P<name>{_PATTERNS[parts[1]]}){re.escape(parts[2])}"
        return re.compile(pattern)


# fmt: off
# name, key, message, rate, delivery, meaning
START = Channel("start", "source/{robot}/start", m.InitialPose, "once per incarnation", "all", "measurement 0: the initial pose, if known")
ODOMETRY = Channel("odometry", "source/{robot}/odometry", m.Odometry, "8-100 Hz", "stream",
                   "an odometry interval: speeds, a motion, or a car's steering", alternatives=(m.Increment, m.Steering))
OBSERVATIONS = Channel("observations", "source/{robot}/observations", m.Observations, "1-30 Hz", "stream",
                       "landmarks: range and bearing or points, with or without identities", alternatives=(m.Points, m.Detections))
SIGHTINGS = Channel("sightings", "source/{robot}/sightings", m.Sightings, "0-10 Hz", "stream", "range and bearing to teammates")
FIXES = Channel("fixes", "source/{robot}/fixes", m.Fix, "0-10 Hz", "stream", "absolute positions, as by GNSS")
SENSORS = (START, ODOMETRY, OBSERVATIONS, SIGHTINGS, FIXES)
HEAD = Channel("head", "source/{robot}/head", m.StreamHead, "1 Hz", "latest", "a driver's count of measurements, and the state of its stream")

TRUTH = Channel("truth", "truth/{robot}", m.Truth, "1 Hz, batched", "all", "true poses, for the evaluation only")
TRUTH_LANDMARKS = Channel("truth_landmarks", "truth_landmarks", m.TruthLandmarks, "once", "latest", "true landmarks, for the evaluation only")
TRUTH_LABELS = Channel("truth_labels", "truth_labels/{robot}", m.TruthLabels, "once", "all", "true landmarks of detections, for the evaluation only")
TRUTH_POSITIONS = Channel("truth_positions", "truth_positions/{robot}", m.TruthPositions, "once", "all",
                          "positions by another sensor, for the evaluation only")

ROBOT_CONFIG = Channel("robot_config", "robot/{robot}/config", m.Configuration, "once per incarnation", "latest", "the robot's configuration")
SUBMAP = Channel("submap", "robot/{robot}/submap", m.Submap, "one per window", "all", "a submap; input of the rule `join`", recomputable=True)
ASSOCIATION = Channel("association", "robot/{robot}/association", m.Association, "0-1 per window", "latest", "the association of each detection",
                      recomputable=True)
SIGHTING_FACTOR = Channel("sighting_factor", "robot/{robot}/sighting_factor", m.SightingFactor, "0-1 per teammate and node", "all",
                          "an inter-robot factor; input of the rule `join`", recomputable=True)
RENDEZVOUS = Channel("rendezvous", "robot/{robot}/rendezvous", m.Rendezvous, "0-1 per window and meeting", "all",
                     "release of buffered submaps at an encounter")
OWN_MAP = Channel("own_map", "robot/{robot}/own/map", m.MapEstimate, "one per window (pose_s) or exchange", "latest",
                  "running map; input of rules with feedback", recomputable=True)
OWN_POSE = Channel("own_pose", "robot/{robot}/own/pose", m.PoseEstimate, "one per keyframe", "latest", "running pose from own measurements",
                   recomputable=True)
TEAM_POSE = Channel("team_pose", "robot/{robot}/team/pose", m.PoseEstimate, "one per keyframe", "latest",
                    "running pose in the team's map; never an input of fusion", recomputable=True)
PARTICLES = Channel("particles", "robot/{robot}/particles", m.ParticleCloud, "one per window (pose_s)", "latest", "thinned particles, for viewers",
                    recomputable=True)
INNOVATION = Channel("innovation", "robot/{robot}/innovation", m.Innovation, "one per window", "latest", "NIS of a window's measurements",
                     recomputable=True)
ROBOT_PROGRESS = Channel("robot_progress", "robot/{robot}/progress", m.Progress, "every 64 measurements", "latest", "credit for the world")
ROBOT_HEAD = Channel("robot_head", "robot/{robot}/head", m.StreamHead, "at the driver's end", "latest",
                     "its driver's last `head`, for a restarted centre")
ROBOT_DONE = Channel("robot_done", "robot/{robot}/done", m.Done, "once per incarnation", "latest",
                     "all measurements are consumed, the last submap is sent", recomputable=True)

CENTRAL_CONFIG = Channel("central_config", "central/config", m.Configuration, "once", "latest", "the centre's configuration")
FUSED_MAP = Channel("fused_map", "central/map", m.FusedMap, "one per broadcast", "latest", "the team's map", recomputable=True)
PRIOR = Channel("prior", "central/prior/{robot}", m.Prior, "with news, at least each 8th broadcast", "latest", "the joint marginal for a robot",
                recomputable=True)
ORDER = Channel("order", "operator/withdrawal/{robot}", m.Withdrawal, "once", "all", "an operator's order to withdraw a robot")
VERDICT = Channel("verdict", "operator/verdict/{robot}", m.Verdict, "once per verdict", "all",
                  "an operator's statement that two unnamed landmarks are one, or two")
WITHDRAWAL = Channel("withdrawal", "central/withdrawal/{robot}", m.Withdrawal, "once", "all", "a withdrawal that the centre carries out")
WITHDRAWALS_HEARD = Channel("withdrawals_heard", "robot/{robot}/withdrawals", m.WithdrawalHeard, "never", "all",
                            "not published; read from logs of earlier versions")
GIVEN_UP = Channel("given_up", "operator/given_up/{node}", m.GivenUp, "once", "all", "an operator's order that no process waits for a node")
END_ORDER = Channel("end_order", "operator/end", m.TeamEnd, "once", "all", "an operator's order to end a live team")
TEAM_END = Channel("team_end", "central/end", m.TeamEnd, "once", "latest", "the order to end, repeated for late joiners")
FINAL_MAP = Channel("final_map", "central/final", m.FusedMap, "once", "latest", "the final map with its joint covariance", recomputable=True)
SAVED_MAP = Channel("saved_map", "central/saved_map/{robot}", m.SavedMap, "once", "all", "a map of an earlier day; a member of the set")
TRAJECTORY = Channel("trajectory", "central/trajectory/{robot}", m.Trajectory, "once per incarnation", "all",
                     "smoothed ends of the submaps, or all keyframes", recomputable=True)
CENTRAL_POSE = Channel("central_pose", "central/pose/{robot}", m.PoseEstimate, "one per keyframe or broadcast", "latest",
                       "running pose by a rule on measurements", recomputable=True)
CENTRAL_PROGRESS = Channel("central_progress", "central/progress/{robot}", m.Progress, "one per submap", "latest", "credit for the robots")

WORLD_CONFIG = Channel("world_config", "world/config", m.Configuration, "once", "latest", "the scenario")
KNOWN_MAP = Channel("known_map", "world/known_map", m.KnownMap, "once", "latest", "prior map of robots that only localise")
END = Channel("end", "world/end", m.End, "once", "latest", "end of all streams, with their last counters")
RADIO = Channel("radio", "world/radio", m.RadioPlan, "once", "latest", "links of a simulated radio over time")
RECORDER_PROGRESS = Channel("recorder_progress", "recorder/progress/{robot}", m.Progress, "every 256 measurements, every submap", "latest",
                            "credit for the world; a robot may leave", recorded=False)
STATUS = Channel("status", "{node}/status", m.Status, "1 Hz", "latest", "state of a node, for people")
FAULT = Channel("fault", "{node}/fault", m.Fault, "per exception", "all", "a message that a node could not handle")
ALIVE = Channel("alive", "{node}/alive", m.Liveliness, "on change", "latest", "liveliness token; a log has its changes as messages")

TALLY = Channel("tally", "{node}/tally", m.Tally, "once, at the end", "latest", "number of messages that the process has published on each key")
RECORDED = Channel("recorded", "recorder/recorded/{node}", m.Tally, "1 Hz, after the process's end", "latest",
                   "keys of the tally of which the recorder lacks messages; with none the process may leave", recorded=False)

MEASUREMENTS = Channel("readings", "source/{robot}/readings", m.MeasurementsRequest, "query", "stream", "measurements of a stream", recorded=False)
SUBMAPS = Channel("submaps", "central/submaps", m.SubmapsRequest, "query", "stream",
                  "initial poses, submaps and inter-robot factors of the centre's set", recorded=False)
SENT = Channel("sent", "robot/{robot}/submaps", m.SubmapsRequest, "query", "stream",
               "initial poses, submaps and inter-robot factors that the robot has sent", recorded=False)

KEPT = Channel("kept", "router/kept", m.KeptRequest, "query", "stream", "stored ends of the team and orders, as `kept`", recorded=False)

TEAM_CONFIG = Channel("team_config", "robot/{robot}/team/config", m.Configuration, "once", "latest", "the configuration of the peer's fold")
TEAM_MAP = Channel("team_map", "robot/{robot}/team/map", m.FusedMap, "one per broadcast", "latest", "the team's map by the peer's fold",
                   recomputable=True)
TEAM_PRIOR = Channel("team_prior", "robot/{robot}/team/prior", m.Prior, "with news, at least each 8th broadcast", "latest",
                     "the prior by the peer's fold", recomputable=True)
TEAM_FINAL = Channel("team_final", "robot/{robot}/team/final", m.FusedMap, "once", "latest", "the final map by the peer's fold", recomputable=True)
TEAM_TRAJECTORY = Channel("team_trajectory", "robot/{robot}/team/trajectory", m.Trajectory, "once per incarnation", "all",
                          "the peer's smoothed path in its final map", recomputable=True)
TEAM_WITHDRAWAL = Channel("team_withdrawal", "robot/{robot}/team/withdrawal", m.Withdrawal, "once per robot that it withdraws", "all",
                          "a withdrawal by the peer's fold")
SET_SUMMARY = Channel("set_summary", "{node}/set", m.SetSummary, "1 Hz at most, on change", "latest", "summary of a peer's set")
CONCLUDED = Channel("concluded", "robot/{robot}/concluded", m.Concluded, "once", "all", "a peer has its final map")
CERTIFICATE = Channel("certificate", "robot/{robot}/certificate", m.Certificate, "once, with keys", "all", "the certificate of a robot's signatures")
SIGNATURE = Channel("signature", "robot/{robot}/signature", m.Signature, "one per member, with keys", "all",
                    "a robot's signature of one of its members", recorded=False)
ORDER_SIGNATURE = Channel("order_signature", "operator/signature/{robot}", m.Signature, "one per order, with keys", "all",
                          "an operator's signature of an order", recorded=False)
FOLD = Channel("fold", "robot/{robot}/fold", m.FoldRequest, "query", "stream", "the map of the peer's set as it is now", recorded=False)
SITE = Channel("site", "central/site", m.FoldRequest, "query", "stream", "the map of the centre's set as it is now, as `saved_map`", recorded=False)
MEMBERS = Channel("members", "{node}/members", m.MembersRequest, "query", "stream", "members of the peer's set, as `carried`", recorded=False)
CARRIED = Channel("carried", "{node}/carried", m.Members, "on request", "stream", "members of any robot from a peer's set", recorded=False)

VIEW = Channel("view", "view/{view}", m.Message, "1 Hz of team time", "latest", "figures for viewers")
# fmt: on

CHANNELS: tuple[Channel, ...] = tuple(v for v in list(globals().values()) if isinstance(v, Channel))
ENDS = (FINAL_MAP, TEAM_FINAL, CONCLUDED)
"""Messages that end a team: the centre's; without a centre each robot's, about itself."""
ORDERS = (GIVEN_UP, ORDER, VERDICT, END_ORDER, ORDER_SIGNATURE)
"""Operators' orders, and the signatures with which peers relay them."""
QUERIES = (MEASUREMENTS, SUBMAPS, SENT, KEPT, MEMBERS, FOLD, SITE)
REPLIES = {
    MEASUREMENTS: SENSORS,
    SUBMAPS: (START, SUBMAP, SIGHTING_FACTOR),
    SENT: (START, SUBMAP, SIGHTING_FACTOR),
    KEPT: (*ENDS, *ORDERS),
    MEMBERS: (CARRIED,),
    FOLD: (TEAM_MAP,),
    SITE: (SAVED_MAP,),
}
"""Channels of the replies to each query."""
UNOPENED = (*QUERIES, VIEW)
"""Rows whose traffic is not decoded: queries have no samples, views no messages of the team."""


def robot_node(robot: str) -> str:
    """Return the node name of a robot."""
    return f"robot/{robot}"


def source_node(robot: str) -> str:
    """Return the node name of a robot's driver."""
    return f"source/{robot}"


def robot_of(node: str) -> str | None:
    """Return the robot of a node's name; None if the node is not a robot."""
    kind, _, robot = node.partition("/")
    return robot if kind == "robot" else None


_OPENED = tuple(each for each in CHANNELS if each not in UNOPENED)


@lru_cache(maxsize=16_384)
def channel_of(key: str) -> tuple[Channel, str] | None:
    """Return the channel of a relative key, and the robot or node in it."""
    for channel in _OPENED:
        if (name := channel.owner(key)) is not None:
            return channel, name
    return None


def row_of(key: str) -> Channel | None:
    """Return the row of a relative key, also of a view."""
    found = channel_of(key)
    if found is not None:
        return found[0]
    return VIEW if VIEW.owner(key) is not None else None
