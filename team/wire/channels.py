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
START = Channel(name="start", template="source/{robot}/start", message=m.InitialPose, rate="once per incarnation", delivery="all",
                meaning="measurement 0: the initial pose, if known")
ODOMETRY = Channel(name="odometry", template="source/{robot}/odometry", message=m.Odometry, rate="8-100 Hz", delivery="stream",
                   meaning="an odometry interval: speeds, a motion, or a car's steering", alternatives=(m.Increment, m.Steering))
OBSERVATIONS = Channel(name="observations", template="source/{robot}/observations", message=m.Observations, rate="1-30 Hz", delivery="stream",
                       alternatives=(m.Points, m.Detections), meaning="landmarks: range and bearing or points, with or without identities")
SIGHTINGS = Channel(name="sightings", template="source/{robot}/sightings", message=m.Sightings, rate="0-10 Hz", delivery="stream",
                    meaning="range and bearing to teammates")
FIXES = Channel(name="fixes", template="source/{robot}/fixes", message=m.Fix, rate="0-10 Hz", delivery="stream",
                meaning="absolute positions, as by GNSS")
SENSORS = (START, ODOMETRY, OBSERVATIONS, SIGHTINGS, FIXES)
HEAD = Channel(name="head", template="source/{robot}/head", message=m.StreamHead, rate="1 Hz", delivery="latest",
               meaning="a driver's count of measurements, and the state of its stream")

TRUTH = Channel(name="truth", template="truth/{robot}", message=m.Truth, rate="1 Hz, batched", delivery="all",
                meaning="true poses, for the evaluation only")
TRUTH_LANDMARKS = Channel(name="truth_landmarks", template="truth_landmarks", message=m.TruthLandmarks, rate="once", delivery="latest",
                          meaning="true landmarks, for the evaluation only")
TRUTH_LABELS = Channel(name="truth_labels", template="truth_labels/{robot}", message=m.TruthLabels, rate="once", delivery="all",
                       meaning="true landmarks of detections, for the evaluation only")
TRUTH_POSITIONS = Channel(name="truth_positions", template="truth_positions/{robot}", message=m.TruthPositions, rate="once", delivery="all",
                          meaning="positions by another sensor, for the evaluation only")

ROBOT_CONFIG = Channel(name="robot_config", template="robot/{robot}/config", message=m.Configuration, rate="once per incarnation", delivery="latest",
                       meaning="the robot's configuration")
SUBMAP = Channel(name="submap", template="robot/{robot}/submap", message=m.Submap, rate="one per window", delivery="all", recomputable=True,
                 meaning="a submap; input of the rule `join`")
ASSOCIATION = Channel(name="association", template="robot/{robot}/association", message=m.Association, rate="0-1 per window", delivery="latest",
                      recomputable=True, meaning="the association of each detection")
SIGHTING_FACTOR = Channel(name="sighting_factor", template="robot/{robot}/sighting_factor", message=m.SightingFactor,
                          rate="0-1 per teammate and node", delivery="all", recomputable=True,
                          meaning="an inter-robot factor; input of the rule `join`")
RENDEZVOUS = Channel(name="rendezvous", template="robot/{robot}/rendezvous", message=m.Rendezvous, rate="0-1 per window and meeting", delivery="all",
                     meaning="release of buffered submaps at an encounter")
OWN_MAP = Channel(name="own_map", template="robot/{robot}/own/map", message=m.MapEstimate, rate="one per window (pose_s) or exchange",
                  delivery="latest", recomputable=True, meaning="running map; input of rules with feedback")
OWN_POSE = Channel(name="own_pose", template="robot/{robot}/own/pose", message=m.PoseEstimate, rate="one per keyframe", delivery="latest",
                   recomputable=True, meaning="running pose from own measurements")
TEAM_POSE = Channel(name="team_pose", template="robot/{robot}/team/pose", message=m.PoseEstimate, rate="one per keyframe", delivery="latest",
                    recomputable=True, meaning="running pose in the team's map; never an input of fusion")
PARTICLES = Channel(name="particles", template="robot/{robot}/particles", message=m.ParticleCloud, rate="one per window (pose_s)", delivery="latest",
                    recomputable=True, meaning="thinned particles, for viewers")
INNOVATION = Channel(name="innovation", template="robot/{robot}/innovation", message=m.Innovation, rate="one per window", delivery="latest",
                     recomputable=True, meaning="NIS of a window's measurements")
ROBOT_PROGRESS = Channel(name="robot_progress", template="robot/{robot}/progress", message=m.Progress, rate="every 64 measurements",
                         delivery="latest", meaning="credit for the world")
ROBOT_HEAD = Channel(name="robot_head", template="robot/{robot}/head", message=m.StreamHead, rate="at the driver's end", delivery="latest",
                     meaning="its driver's last `head`, for a restarted centre")
ROBOT_DONE = Channel(name="robot_done", template="robot/{robot}/done", message=m.Done, rate="once per incarnation", delivery="latest",
                     recomputable=True, meaning="all measurements are consumed, the last submap is sent")

CENTRAL_CONFIG = Channel(name="central_config", template="central/config", message=m.Configuration, rate="once", delivery="latest",
                         meaning="the centre's configuration")
FUSED_MAP = Channel(name="fused_map", template="central/map", message=m.FusedMap, rate="one per broadcast", delivery="latest", recomputable=True,
                    meaning="the team's map")
PRIOR = Channel(name="prior", template="central/prior/{robot}", message=m.Prior, rate="with news, at least each 8th broadcast", delivery="latest",
                recomputable=True, meaning="the joint marginal for a robot")
ORDER = Channel(name="order", template="operator/withdrawal/{robot}", message=m.Withdrawal, rate="once", delivery="all",
                meaning="an operator's order to withdraw a robot")
VERDICT = Channel(name="verdict", template="operator/verdict/{robot}", message=m.Verdict, rate="once per verdict", delivery="all",
                  meaning="an operator's statement that two unnamed landmarks are one, or two")
WITHDRAWAL = Channel(name="withdrawal", template="central/withdrawal/{robot}", message=m.Withdrawal, rate="once", delivery="all",
                     meaning="a withdrawal that the centre carries out")
WITHDRAWALS_HEARD = Channel(name="withdrawals_heard", template="robot/{robot}/withdrawals", message=m.WithdrawalHeard, rate="never", delivery="all",
                            meaning="not published; read from logs of earlier versions")
GIVEN_UP = Channel(name="given_up", template="operator/given_up/{node}", message=m.GivenUp, rate="once", delivery="all",
                   meaning="an operator's order that no process waits for a node")
END_ORDER = Channel(name="end_order", template="operator/end", message=m.TeamEnd, rate="once", delivery="all",
                    meaning="an operator's order to end a live team")
TEAM_END = Channel(name="team_end", template="central/end", message=m.TeamEnd, rate="once", delivery="latest",
                   meaning="the order to end, repeated for late joiners")
FINAL_MAP = Channel(name="final_map", template="central/final", message=m.FusedMap, rate="once", delivery="latest", recomputable=True,
                    meaning="the final map with its joint covariance")
SAVED_MAP = Channel(name="saved_map", template="central/saved_map/{robot}", message=m.SavedMap, rate="once", delivery="all",
                    meaning="a map of an earlier day; a member of the set")
TRAJECTORY = Channel(name="trajectory", template="central/trajectory/{robot}", message=m.Trajectory, rate="once per incarnation", delivery="all",
                     recomputable=True, meaning="smoothed ends of the submaps, or all keyframes")
CENTRAL_POSE = Channel(name="central_pose", template="central/pose/{robot}", message=m.PoseEstimate, rate="one per keyframe or broadcast",
                       delivery="latest", recomputable=True, meaning="running pose by a rule on measurements")
CENTRAL_PROGRESS = Channel(name="central_progress", template="central/progress/{robot}", message=m.Progress, rate="one per submap", delivery="latest",
                           meaning="credit for the robots")

WORLD_CONFIG = Channel(name="world_config", template="world/config", message=m.Configuration, rate="once", delivery="latest", meaning="the scenario")
KNOWN_MAP = Channel(name="known_map", template="world/known_map", message=m.KnownMap, rate="once", delivery="latest",
                    meaning="prior map of robots that only localise")
END = Channel(name="end", template="world/end", message=m.End, rate="once", delivery="latest", meaning="end of all streams, with their last counters")
RADIO = Channel(name="radio", template="world/radio", message=m.RadioPlan, rate="once", delivery="latest",
                meaning="links of a simulated radio over time")
RECORDER_PROGRESS = Channel(name="recorder_progress", template="recorder/progress/{robot}", message=m.Progress,
                            rate="every 256 measurements, every submap", delivery="latest", recorded=False,
                            meaning="credit for the world; a robot may leave")
STATUS = Channel(name="status", template="{node}/status", message=m.Status, rate="1 Hz", delivery="latest", meaning="state of a node, for people")
FAULT = Channel(name="fault", template="{node}/fault", message=m.Fault, rate="per exception", delivery="all",
                meaning="a message that a node could not handle")
ALIVE = Channel(name="alive", template="{node}/alive", message=m.Liveliness, rate="on change", delivery="latest",
                meaning="liveliness token; a log has its changes as messages")

TALLY = Channel(name="tally", template="{node}/tally", message=m.Tally, rate="once, at the end", delivery="latest",
                meaning="number of messages that the process has published on each key")
RECORDED = Channel(name="recorded", template="recorder/recorded/{node}", message=m.Tally, rate="1 Hz, after the process's end", delivery="latest",
                   recorded=False, meaning="keys of the tally of which the recorder lacks messages; with none the process may leave")

MEASUREMENTS = Channel(name="readings", template="source/{robot}/readings", message=m.MeasurementsRequest, rate="query", delivery="stream",
                       recorded=False, meaning="measurements of a stream")
SUBMAPS = Channel(name="submaps", template="central/submaps", message=m.SubmapsRequest, rate="query", delivery="stream", recorded=False,
                  meaning="initial poses, submaps and inter-robot factors of the centre's set")
SENT = Channel(name="sent", template="robot/{robot}/submaps", message=m.SubmapsRequest, rate="query", delivery="stream", recorded=False,
               meaning="initial poses, submaps and inter-robot factors that the robot has sent")

KEPT = Channel(name="kept", template="router/kept", message=m.KeptRequest, rate="query", delivery="stream", recorded=False,
               meaning="stored ends of the team and orders, as `kept`")

TEAM_CONFIG = Channel(name="team_config", template="robot/{robot}/team/config", message=m.Configuration, rate="once", delivery="latest",
                      meaning="the configuration of the peer's fold")
TEAM_MAP = Channel(name="team_map", template="robot/{robot}/team/map", message=m.FusedMap, rate="one per broadcast", delivery="latest",
                   recomputable=True, meaning="the team's map by the peer's fold")
TEAM_PRIOR = Channel(name="team_prior", template="robot/{robot}/team/prior", message=m.Prior, rate="with news, at least each 8th broadcast",
                     delivery="latest", recomputable=True, meaning="the prior by the peer's fold")
TEAM_FINAL = Channel(name="team_final", template="robot/{robot}/team/final", message=m.FusedMap, rate="once", delivery="latest", recomputable=True,
                     meaning="the final map by the peer's fold")
TEAM_TRAJECTORY = Channel(name="team_trajectory", template="robot/{robot}/team/trajectory", message=m.Trajectory, rate="once per incarnation",
                          delivery="all", recomputable=True, meaning="the peer's smoothed path in its final map")
TEAM_WITHDRAWAL = Channel(name="team_withdrawal", template="robot/{robot}/team/withdrawal", message=m.Withdrawal,
                          rate="once per robot that it withdraws", delivery="all", meaning="a withdrawal by the peer's fold")
SET_SUMMARY = Channel(name="set_summary", template="{node}/set", message=m.SetSummary, rate="1 Hz at most, on change", delivery="latest",
                      meaning="summary of a peer's set")
CONCLUDED = Channel(name="concluded", template="robot/{robot}/concluded", message=m.Concluded, rate="once", delivery="all",
                    meaning="a peer has its final map")
CERTIFICATE = Channel(name="certificate", template="robot/{robot}/certificate", message=m.Certificate, rate="once, with keys", delivery="all",
                      meaning="the certificate of a robot's signatures")
SIGNATURE = Channel(name="signature", template="robot/{robot}/signature", message=m.Signature, rate="one per member, with keys", delivery="all",
                    recorded=False, meaning="a robot's signature of one of its members")
ORDER_SIGNATURE = Channel(name="order_signature", template="operator/signature/{robot}", message=m.Signature, rate="one per order, with keys",
                          delivery="all", recorded=False, meaning="an operator's signature of an order")
FOLD = Channel(name="fold", template="robot/{robot}/fold", message=m.FoldRequest, rate="query", delivery="stream", recorded=False,
               meaning="the map of the peer's set as it is now")
SITE = Channel(name="site", template="central/site", message=m.FoldRequest, rate="query", delivery="stream", recorded=False,
               meaning="the map of the centre's set as it is now, as `saved_map`")
MEMBERS = Channel(name="members", template="{node}/members", message=m.MembersRequest, rate="query", delivery="stream", recorded=False,
                  meaning="members of the peer's set, as `carried`")
CARRIED = Channel(name="carried", template="{node}/carried", message=m.Members, rate="on request", delivery="stream", recorded=False,
                  meaning="members of any robot from a peer's set")

VIEW = Channel(name="view", template="view/{view}", message=m.Message, rate="1 Hz of team time", delivery="latest", meaning="figures for viewers")
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
