"""The table of channels: the only place where a key is written.

Keys are relative to the team; a bus puts `team/<team name>/` before them. The sender of a message
owns the prefix of its key: a robot's process `robot/{robot}/…`, its driver `source/{robot}/…`, an
operator `operator/…`, the others that of their name. A certificate for a prefix therefore
authenticates a sender. The world is the source of every robot; the truth belongs to the world, too.

`{robot}` stands for a robot's name, `{node}` for `world`, `central`, `recorder`, `viewer`,
`robot/<name>` or `source/<name>`, `{view}` for a view (`team.wire.views`). In the rates an
incarnation is one life of a robot's stream (the messages' `incarnation`), a keyframe one instant of
observation.
"""

import re
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Literal

from team.wire import messages as m

Delivery = Literal["stream", "latest", "all"]
"""How a message is delivered. A publisher blocks while its link is busy. The router drops a message
to a receiver that is slower than the team; the receiver fetches it as after a cut link.

stream: a receiver requests a missed message from its source, by the measurement counter.
latest: a late joiner receives the newest message; after a cut link the missed ones are recovered.
all: a late joiner, and a receiver after a cut link, receives every message.
"""


_PLACE = re.compile(r"\{(robot|node|view)\}")
_NAME = "[a-z][a-z0-9_]{0,31}"
_PATTERNS = {"robot": _NAME, "node": f"{_NAME}(?:/{_NAME})?", "view": f"{_NAME}(?:/{_NAME})?"}


@dataclass(frozen=True)
class Channel:
    """One row: the message on a key, its rate, its delivery, and how a log treats it.

    alternatives: messages that may be sent on the key in the place of `message`, or mixed with it.
    """

    name: str
    template: str
    message: type[m.Message]
    rate: str
    delivery: Delivery
    recorded: bool
    recomputable: bool
    meaning: str
    alternatives: tuple[type[m.Message], ...] = ()

    @property
    def kinds(self) -> tuple[type[m.Message], ...]:
        """The types of messages that may be sent on the key."""
        return (self.message, *self.alternatives)

    def kind_of(self, tag: str) -> type[m.Message]:
        """The type of message with this tag; the first one where none has it."""
        return next((kind for kind in self.kinds if m.tag_of(kind) == tag), self.message)

    def key(self, name: str = "") -> str:
        """The key for one robot or node."""
        before, after = self._around
        return before + name + after if after is not None else before

    def selectors(self, name: str = "*") -> tuple[str, ...]:
        """The key expressions of one name; `*`: of all, where nodes and views have up to two parts.

        They match keys of a fixed depth only.
        """
        two = name == "*" and self._around[1] is not None and "{robot}" not in self.template
        return (self.key(name), self.key("*/*")) if two else (self.key(name),)

    def publisher(self, name: str) -> str:
        """The node that publishes the key for one robot or node."""
        first, _, rest = self.template.partition("/")
        if first == "{node}":
            return name
        return f"{first}/{name}" if first == "robot" and rest.startswith("{robot}") else first

    def owner(self, key: str) -> str | None:
        """The robot or node that `key` belongs to on this channel; None where the key is of another
        channel.
        """
        match = self._pattern.fullmatch(key)
        return None if match is None else match.groupdict().get("name", "")

    @cached_property
    def _around(self) -> tuple[str, str | None]:
        """The key before and behind the name; None behind it where the key has no name."""
        parts = _PLACE.split(self.template)
        return parts[0], parts[2] if len(parts) > 1 else None

    @cached_property
    def _pattern(self) -> re.Pattern[str]:
        parts = _PLACE.split(self.template)
        pattern = re.escape(parts[0])
        if len(parts) > 1:
            pattern += f"(?P<name>{_PATTERNS[parts[1]]}){re.escape(parts[2])}"
        return re.compile(pattern)


START = Channel(name="start", template="source/{robot}/start", message=m.InitialPose, rate="once per incarnation", delivery="all", recorded=True, recomputable=False,
                meaning="measurement 0: the initial pose, if known")  # fmt: skip
ODOMETRY = Channel(name="odometry", template="source/{robot}/odometry", message=m.Odometry, rate="8-100 Hz", delivery="stream", recorded=True,
                   recomputable=False, meaning="one odometry interval: speeds, a motion or a car's steering",
                   alternatives=(m.Increment, m.Steering))  # fmt: skip
OBSERVATIONS = Channel(name="observations", template="source/{robot}/observations", message=m.Observations, rate="1-30 Hz",
                       delivery="stream", recorded=True, recomputable=False, alternatives=(m.Points, m.Detections),
                       meaning="landmarks seen: range and bearing or points, with identities or without")  # fmt: skip
SIGHTINGS = Channel(name="sightings", template="source/{robot}/sightings", message=m.Sightings, rate="0-10 Hz", delivery="stream", recorded=True,
                    recomputable=False, meaning="teammates seen")  # fmt: skip
SENSORS = (START, ODOMETRY, OBSERVATIONS, SIGHTINGS)
HEAD = Channel(name="head", template="source/{robot}/head", message=m.StreamHead, rate="1 Hz while it measures", delivery="latest", recorded=True, recomputable=False,
               meaning="a driver's number of published measurements, and whether its stream has ended; a world publishes `end` instead")  # fmt: skip

TRUTH = Channel(name="truth", template="truth/{robot}", message=m.Truth, rate="1 Hz, batched", delivery="all", recorded=True, recomputable=False,
                meaning="true poses; the evaluator's only")  # fmt: skip
TRUTH_LANDMARKS = Channel(name="truth_landmarks", template="truth_landmarks", message=m.TruthLandmarks, rate="once", delivery="latest",
                          recorded=True, recomputable=False, meaning="true landmarks; the evaluator's only")  # fmt: skip
TRUTH_LABELS = Channel(name="truth_labels", template="truth_labels/{robot}", message=m.TruthLabels, rate="once", delivery="all",
                       recorded=True, recomputable=False, meaning="which landmarks detections are of; the evaluator's only")  # fmt: skip
TRUTH_POSITIONS = Channel(name="truth_positions", template="truth_positions/{robot}", message=m.TruthPositions, rate="once", delivery="all",
                          recorded=True, recomputable=False, meaning="positions by another sensor; the evaluator's only")  # fmt: skip

ROBOT_CONFIG = Channel(name="robot_config", template="robot/{robot}/config", message=m.Configuration, rate="once per incarnation",
                       delivery="latest", recorded=True, recomputable=False, meaning="the robot's configuration")  # fmt: skip
SUBMAP = Channel(name="submap", template="robot/{robot}/submap", message=m.Submap, rate="one per window", delivery="all", recorded=True, recomputable=True,
                 meaning="what the rule `join` consumes")  # fmt: skip
ASSOCIATION = Channel(name="association", template="robot/{robot}/association", message=m.Association, rate="0-1 per window", delivery="latest",
                      recorded=True, recomputable=True, meaning="the decision on each detection without identity")  # fmt: skip
SIGHTING_FACTOR = Channel(name="sighting_factor", template="robot/{robot}/sighting_factor", message=m.SightingFactor,
                          rate="0-1 per teammate and node", delivery="all", recorded=True, recomputable=True,
                          meaning="a teammate seen from a pose node; what the rule `join` consumes")  # fmt: skip
RENDEZVOUS = Channel(name="rendezvous", template="robot/{robot}/rendezvous", message=m.Rendezvous,
                     rate="0-1 per window and meeting", delivery="all", recorded=True, recomputable=False,
                     meaning="buffered submaps are released when a teammate is encountered; both robots transmit")  # fmt: skip
OWN_MAP = Channel(name="own_map", template="robot/{robot}/own/map", message=m.MapEstimate, rate="one per window (pose_s) or exchange",
                  delivery="latest", recorded=True, recomputable=True,
                  meaning="running landmark means and covariances; consumed by rules with feedback")  # fmt: skip
OWN_POSE = Channel(name="own_pose", template="robot/{robot}/own/pose", message=m.PoseEstimate, rate="one per keyframe", delivery="latest",
                   recorded=True, recomputable=True, meaning="running pose from own measurements alone")  # fmt: skip
TEAM_POSE = Channel(name="team_pose", template="robot/{robot}/team/pose", message=m.PoseEstimate, rate="one per keyframe",
                    delivery="latest", recorded=True, recomputable=True, meaning="pose given the fused map; never an input of fusion")  # fmt: skip
PARTICLES = Channel(name="particles", template="robot/{robot}/particles", message=m.ParticleCloud, rate="one per window (pose_s)",
                    delivery="latest", recorded=True, recomputable=True, meaning="thinned cloud, for viewers")  # fmt: skip
INNOVATION = Channel(name="innovation", template="robot/{robot}/innovation", message=m.Innovation, rate="one per window", delivery="latest",
                     recorded=True, recomputable=True, meaning="how well a window's measurements were predicted (NIS)")  # fmt: skip
ROBOT_PROGRESS = Channel(name="robot_progress", template="robot/{robot}/progress", message=m.Progress, rate="every 64 measurements",
                         delivery="latest", recorded=True, recomputable=False, meaning="credit for the world")  # fmt: skip
ROBOT_HEAD = Channel(name="robot_head", template="robot/{robot}/head", message=m.StreamHead, rate="when its driver leaves or ends", delivery="latest",
                     recorded=True, recomputable=False, meaning="its driver's last `head`, for a centre that is restarted after the driver has left")  # fmt: skip
ROBOT_DONE = Channel(name="robot_done", template="robot/{robot}/done", message=m.Done, rate="once per incarnation", delivery="latest", recorded=True,
                     recomputable=True, meaning="all measurements consumed, last submap sent")  # fmt: skip

CENTRAL_CONFIG = Channel(name="central_config", template="central/config", message=m.Configuration, rate="once", delivery="latest", recorded=True,
                         recomputable=False, meaning="the centre's configuration")  # fmt: skip
FUSED_MAP = Channel(name="fused_map", template="central/map", message=m.FusedMap, rate="one per broadcast", delivery="latest", recorded=True,
                    recomputable=True, meaning="the team's map")  # fmt: skip
PRIOR = Channel(name="prior", template="central/prior/{robot}", message=m.Prior, rate="with news, one of 8 broadcasts at least", delivery="latest", recorded=True,
                recomputable=True, meaning="the joint marginal that a robot needs")  # fmt: skip
ORDER = Channel(name="order", template="operator/withdrawal/{robot}", message=m.Withdrawal, rate="once", delivery="all", recorded=True, recomputable=False,
                meaning="an operator's order: the team goes on without the robot")  # fmt: skip
VERDICT = Channel(name="verdict", template="operator/verdict/{robot}", message=m.Verdict, rate="once per verdict", delivery="all", recorded=True,
                  recomputable=False, meaning="an operator's decision that two unnamed landmarks are one, or two")  # fmt: skip
WITHDRAWAL = Channel(name="withdrawal", template="central/withdrawal/{robot}", message=m.Withdrawal, rate="once", delivery="all", recorded=True, recomputable=False,
                     meaning="the team goes on without the robot; one for each order that the centre carries out")  # fmt: skip
WITHDRAWALS_HEARD = Channel(name="withdrawals_heard", template="robot/{robot}/withdrawals", message=m.WithdrawalHeard,
                            rate="in earlier versions", delivery="all", recorded=True, recomputable=False,
                            meaning="in logs of earlier versions: an order that the robot had received; nothing publishes or receives it")  # fmt: skip
GIVEN_UP = Channel(name="given_up", template="operator/given_up/{node}", message=m.GivenUp, rate="once", delivery="all", recorded=True, recomputable=False,
                   meaning="an operator's order: no process waits for the node any more")  # fmt: skip
END_ORDER = Channel(name="end_order", template="operator/end", message=m.TeamEnd, rate="once", delivery="all", recorded=True, recomputable=False,
                    meaning="an operator's order: a live team ends now")  # fmt: skip
TEAM_END = Channel(name="team_end", template="central/end", message=m.TeamEnd, rate="once", delivery="latest", recorded=True, recomputable=False,
                   meaning="the order to end, repeated by the centre for late joiners")  # fmt: skip
FINAL_MAP = Channel(name="final_map", template="central/final", message=m.FusedMap, rate="once", delivery="latest", recorded=True, recomputable=True,
                    meaning="the team's map with its joint covariance")  # fmt: skip
TRAJECTORY = Channel(name="trajectory", template="central/trajectory/{robot}", message=m.Trajectory, rate="once per incarnation",
                     delivery="all", recorded=True, recomputable=True, meaning="smoothed end poses of the submaps, or of all keyframes")  # fmt: skip
CENTRAL_POSE = Channel(name="central_pose", template="central/pose/{robot}", message=m.PoseEstimate, rate="one per keyframe or broadcast",
                       delivery="latest", recorded=True, recomputable=True, meaning="running pose by a rule on raw measurements")  # fmt: skip
CENTRAL_PROGRESS = Channel(name="central_progress", template="central/progress/{robot}", message=m.Progress,
                           rate="one per submap", delivery="latest", recorded=True, recomputable=False, meaning="credit for the robots")  # fmt: skip

WORLD_CONFIG = Channel(name="world_config", template="world/config", message=m.Configuration, rate="once", delivery="latest", recorded=True, recomputable=False,
                       meaning="the scenario")  # fmt: skip
KNOWN_MAP = Channel(name="known_map", template="world/known_map", message=m.KnownMap, rate="once", delivery="latest", recorded=True, recomputable=False,
                    meaning="prior map for localisation-only robots")  # fmt: skip
END = Channel(name="end", template="world/end", message=m.End, rate="once", delivery="latest", recorded=True, recomputable=False,
              meaning="everything is published; the last counters")  # fmt: skip
RADIO = Channel(name="radio", template="world/radio", message=m.RadioPlan, rate="once", delivery="latest", recorded=True, recomputable=False,
                meaning="connections of a simulated radio over time")  # fmt: skip
RECORDER_PROGRESS = Channel(name="recorder_progress", template="recorder/progress/{robot}", message=m.Progress,
                            rate="every 256 measurements, every submap", delivery="latest", recorded=False, recomputable=False,
                            meaning="credit for the world, and that a robot may leave")  # fmt: skip
STATUS = Channel(name="status", template="{node}/status", message=m.Status, rate="1 Hz", delivery="latest", recorded=True, recomputable=False,
                 meaning="a node's state, for people")  # fmt: skip
FAULT = Channel(name="fault", template="{node}/fault", message=m.Fault, rate="when a handling raises", delivery="all", recorded=True, recomputable=False,
                meaning="a message that a node could not handle and set aside")  # fmt: skip
ALIVE = Channel(name="alive", template="{node}/alive", message=m.Liveliness, rate="on change", delivery="latest", recorded=True, recomputable=False,
                meaning="liveliness token; its changes are logged as messages")  # fmt: skip

TALLY = Channel(name="tally", template="{node}/tally", message=m.Tally, rate="once, at its end", delivery="latest", recorded=True, recomputable=False,
                meaning="how many messages the node's process has published on each key")  # fmt: skip
RECORDED = Channel(name="recorded", template="recorder/recorded/{node}", message=m.Tally, rate="1 Hz, once the node's process has ended", delivery="latest",
                   recorded=False, recomputable=False,
                   meaning="the keys of the node's tally of which the recorder lacks messages, and how many it has: with none, the process may leave")  # fmt: skip

MEASUREMENTS = Channel(name="readings", template="source/{robot}/readings", message=m.MeasurementsRequest, rate="query", delivery="stream", recorded=False,
                   recomputable=False, meaning="a query; the replies are the measurements")  # fmt: skip
SUBMAPS = Channel(name="submaps", template="central/submaps", message=m.SubmapsRequest, rate="query", delivery="stream", recorded=False, recomputable=False,
                  meaning="a query; the replies are the initial poses, submaps and inter-robot factors in the centre's set")  # fmt: skip
SENT = Channel(name="sent", template="robot/{robot}/submaps", message=m.SubmapsRequest, rate="query", delivery="stream", recorded=False, recomputable=False,
               meaning="a query; the replies are the initial poses, submaps and inter-robot factors that the robot has sent")  # fmt: skip

KEPT = Channel(name="kept", template="router/kept", message=m.KeptRequest, rate="query", delivery="stream", recorded=False, recomputable=False,
               meaning="a query; the replies are `kept` samples of others: the ends of the team, and the operators' orders")  # fmt: skip

TEAM_CONFIG = Channel(name="team_config", template="robot/{robot}/team/config", message=m.Configuration, rate="once", delivery="latest", recorded=True,
                      recomputable=False, meaning="the configuration of the peer's own fold: a centre's")  # fmt: skip
TEAM_MAP = Channel(name="team_map", template="robot/{robot}/team/map", message=m.FusedMap, rate="one per broadcast", delivery="latest", recorded=True,
                   recomputable=True, meaning="the team's map by the peer's own fold")  # fmt: skip
TEAM_PRIOR = Channel(name="team_prior", template="robot/{robot}/team/prior", message=m.Prior, rate="with news, one of 8 broadcasts at least", delivery="latest", recorded=True,
                     recomputable=True, meaning="the joint marginal that the peer needs, by its own fold")  # fmt: skip
TEAM_FINAL = Channel(name="team_final", template="robot/{robot}/team/final", message=m.FusedMap, rate="once", delivery="latest", recorded=True,
                     recomputable=True, meaning="the final map by the peer's own fold")  # fmt: skip
TEAM_TRAJECTORY = Channel(name="team_trajectory", template="robot/{robot}/team/trajectory", message=m.Trajectory, rate="once per incarnation",
                          delivery="all", recorded=True, recomputable=True, meaning="the peer's smoothed path in its final map")  # fmt: skip
TEAM_WITHDRAWAL = Channel(name="team_withdrawal", template="robot/{robot}/team/withdrawal", message=m.Withdrawal, rate="once per robot that it withdraws",
                          delivery="all", recorded=True, recomputable=False, meaning="the team goes on without a robot, by the peer's own fold")  # fmt: skip
SET_SUMMARY = Channel(name="set_summary", template="{node}/set", message=m.SetSummary, rate="at most 1 Hz, when it has changed", delivery="latest",
                      recorded=True, recomputable=False, meaning="the members of the team's set that a peer has")  # fmt: skip
CONCLUDED = Channel(name="concluded", template="robot/{robot}/concluded", message=m.Concluded, rate="once", delivery="all", recorded=True, recomputable=False,
                    meaning="a peer has its final map")  # fmt: skip
CERTIFICATE = Channel(name="certificate", template="robot/{robot}/certificate", message=m.Certificate, rate="once, with keys", delivery="all", recorded=True,
                      recomputable=False, meaning="the certificate with which a robot's signatures are checked")  # fmt: skip
SIGNATURE = Channel(name="signature", template="robot/{robot}/signature", message=m.Signature, rate="one per member, with keys", delivery="all", recorded=False,
                    recomputable=False, meaning="a robot's signature of one of its members of the set, for peers that relay it")  # fmt: skip
ORDER_SIGNATURE = Channel(name="order_signature", template="operator/signature/{robot}", message=m.Signature, rate="one per order, with keys", delivery="all", recorded=False,
                          recomputable=False, meaning="an operator's signature of an order about a robot, for peers that relay it")  # fmt: skip
FOLD = Channel(name="fold", template="robot/{robot}/fold", message=m.FoldRequest, rate="query", delivery="stream", recorded=False, recomputable=False,
               meaning="a query to a peer: it folds the set that it has; the reply is the map")  # fmt: skip
MEMBERS = Channel(name="members", template="{node}/members", message=m.MembersRequest, rate="query", delivery="stream", recorded=False, recomputable=False,
                  meaning="a query to a peer; the replies are members of the set, as `carried`")  # fmt: skip
CARRIED = Channel(name="carried", template="{node}/carried", message=m.Members, rate="as asked for", delivery="stream", recorded=False, recomputable=False,
                  meaning="members of the set, of any robot, from a peer that has them")  # fmt: skip

VIEW = Channel(name="view", template="view/{view}", message=m.Message, rate="about 1 Hz of team time", delivery="latest", recorded=True, recomputable=False,
               meaning="figures for viewers, in Foxglove's schemas; see Views")  # fmt: skip

CHANNELS: tuple[Channel, ...] = tuple(v for v in list(globals().values()) if isinstance(v, Channel))
ENDS = (FINAL_MAP, TEAM_FINAL, CONCLUDED)
"""Messages that end a team: the centre's; without a centre each robot's, about itself."""
ORDERS = (GIVEN_UP, ORDER, VERDICT, END_ORDER, ORDER_SIGNATURE)
"""Operators' orders, and the signatures with which peers relay them."""
QUERIES = (MEASUREMENTS, SUBMAPS, SENT, KEPT, MEMBERS, FOLD)
REPLIES = {
    MEASUREMENTS: SENSORS,
    SUBMAPS: (START, SUBMAP, SIGHTING_FACTOR),
    SENT: (START, SUBMAP, SIGHTING_FACTOR),
    KEPT: (*ENDS, *ORDERS),
    MEMBERS: (CARRIED,),
    FOLD: (TEAM_MAP,),
}
"""The channels whose messages answer a query."""
UNOPENED = (*QUERIES, VIEW)
"""Rows whose traffic is not decoded: queries have no samples, and a view is no message of ours."""


def robot_node(robot: str) -> str:
    """The node name of a robot, as liveliness tokens and status carry it."""
    return f"robot/{robot}"


def source_node(robot: str) -> str:
    """The node name of a robot's driver, as liveliness tokens and status carry it."""
    return f"source/{robot}"


def robot_of(node: str) -> str | None:
    """The robot of a node's name; None if the node is not a robot."""
    kind, _, robot = node.partition("/")
    return robot if kind == "robot" else None


_OPENED = tuple(each for each in CHANNELS if each not in UNOPENED)


@lru_cache(maxsize=16_384)
def channel_of(key: str) -> tuple[Channel, str] | None:
    """The channel that a relative key belongs to, and the robot or node in it."""
    for channel in _OPENED:
        if (name := channel.owner(key)) is not None:
            return channel, name
    return None


def row_of(key: str) -> Channel | None:
    """The row of a relative key, also of a view's."""
    found = channel_of(key)
    if found is not None:
        return found[0]
    return VIEW if VIEW.owner(key) is not None else None
