"""Collect a log's contents for an evaluation, in one pass.

Measurements, most of a log, are counted and added to their stream's `Timed`.
"""

from collections import defaultdict
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from typing import TypeVar

from teamslam.central.config import TeamConfig, team_config
from teamslam.central.desk.evaluation.clocks import Timed
from teamslam.central.desk.evaluation.running import TrueLandmarks, TruthFrames
from teamslam.central.desk.logged import Logged, read_logged
from teamslam.central.desk.names import in_order
from teamslam.central.desk.peers_as_centre import Agreement, PeersAsCentre, as_centre_final
from teamslam.team import translate
from teamslam.team.config import SURVEY_FRAME
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.bus import Sample, with_printable_texts
from teamslam.team.wire.channels import Channel, channel_of

M = TypeVar("M", bound=m.Message)
_TIMED = (m.Odometry, m.Increment, m.Steering, m.Observations, m.Points)
_SENSORS = frozenset(ch.SENSORS)
_NEWEST = frozenset((
    ch.CONCLUDED, ch.WORLD_CONFIG, ch.ROBOT_CONFIG, ch.FINAL_MAP, ch.TRUTH_LANDMARKS, ch.END,
    ch.STATUS, ch.OWN_MAP,
))  # fmt: skip
"""Channels whose newest message is collected; of others all are."""
_COLLECTED = frozenset((
    ch.FAULT, ch.TRUTH, ch.TRUTH_LABELS, ch.TRUTH_POSITIONS, ch.ASSOCIATION, ch.TRAJECTORY,
    ch.OWN_POSE, ch.TEAM_POSE, ch.CENTRAL_POSE, ch.SUBMAP, ch.ROBOT_DONE, ch.VERDICT, ch.WITHDRAWAL,
    ch.ORDER, ch.START,
))  # fmt: skip
_OF_A_ROBOT = (ch.ROBOT_CONFIG, ch.TRUTH, ch.ROBOT_DONE)


@dataclass
class Traffic:
    """Messages and payload bytes of one key."""

    messages: int = 0
    bytes: int = 0


@dataclass
class Collected:
    """Contents of a log by channel and robot.

    measurements: whether each, by robot and (incarnation, number), is odometry. samples: by key,
    decoded on demand. first_ns: wall clock of the first sample that has one. disagreement: peers
    whose final map differs, as text.
    """

    traffic: dict[str, Traffic] = field(default_factory=lambda: defaultdict(Traffic))
    measurements: dict[str, dict[tuple[int, int], bool]] = field(
        default_factory=lambda: defaultdict(dict)
    )
    latest: dict[str, Logged] = field(default_factory=dict)
    samples: dict[str, list[Logged]] = field(default_factory=lambda: defaultdict(list))
    timed: dict[tuple[str, int], Timed] = field(default_factory=lambda: defaultdict(Timed))
    unsound: int = 0
    disagreement: tuple[str, ...] = ()
    first_ns: int | None = None
    _refused: set[int] = field(default_factory=set)

    @property
    def robots(self) -> list[str]:
        """Robots with measurements or truth."""
        found = filter(None, map(channel_of, self.traffic))
        return in_order(
            self.measurements.keys() | {name for channel, name in found if channel in _OF_A_ROBOT}
        )

    @cached_property
    def scenario(self) -> TeamConfig | None:
        """Scenario of the world, if this version can read it."""
        world = self.newest(ch.WORLD_CONFIG, m.Configuration)
        with suppress(ValueError):
            return None if world is None else team_config(world.configuration)
        return None

    @cached_property
    def final_map(self) -> m.FusedMap | None:
        """Final map, if any."""
        return self.newest(ch.FINAL_MAP, m.FusedMap)

    @cached_property
    def true_landmarks(self) -> TrueLandmarks:
        """True landmarks; none if unknown."""
        truth = self.newest(ch.TRUTH_LANDMARKS, m.TruthLandmarks)
        return TrueLandmarks() if truth is None else TrueLandmarks.of(truth)

    @cached_property
    def _frames(self) -> TruthFrames:
        frames = TruthFrames()
        for start in self.of_all(ch.START, m.InitialPose):
            frames.take(start)
        return frames

    @cached_property
    def is_arbitrary(self) -> bool:
        """Whether neither a known initial pose nor a survey fixes the final map's frame."""
        fused = self.final_map
        if fused is None or not fused.members:
            return self._frames.none_is_known
        names = (translate.frame_name(x.robot, x.incarnation) for x in fused.members)
        return fused.frame != SURVEY_FRAME and not any(map(self._frames.has, names))

    def is_in_frame(self, frame: str) -> bool:
        """Whether a frame has truth; if the final map's is arbitrary, whether it is that."""
        if not self.is_arbitrary:
            return self._frames.has(frame)
        fused = self.final_map
        return fused is None or not fused.ids or frame in {"", fused.frame}

    def newest(self, channel: Channel, kind: type[M], name: str = "") -> M | None:
        """Newest valid message of a channel."""
        found = self.sound(self.latest.get(channel.key(name)))
        return found if isinstance(found, kind) else None

    def messages(self, channel: Channel, kind: type[M], robot: str) -> list[M]:
        """Valid messages of a robot's channel."""
        found = map(self.sound, self.samples.get(channel.key(robot), []))
        return [each for each in found if isinstance(each, kind)]

    def of_all(self, channel: Channel, kind: type[M]) -> list[M]:
        """Valid messages of a channel, by key."""
        names = sorted(name for key in self.samples if (name := channel.owner(key)) is not None)
        return [each for name in names for each in self.messages(channel, kind, name)]

    def figures(self, node: str, prefix: str = "") -> dict[str, float]:
        """Newest figures of a node by name behind the prefix."""
        status = self.newest(ch.STATUS, m.Status, node)
        found = {} if status is None else status.figures
        return {k.removeprefix(prefix): v for k, v in found.items() if k.startswith(prefix)}

    def sound(self, each: Logged | None) -> m.Message | None:
        """Message with printable texts; an invalid one counts once."""
        if each is None:
            return None
        if each.message is None:
            self.unsound += id(each) not in self._refused
            self._refused.add(id(each))
            return None
        return with_printable_texts(each.message)

    def take(self, each: Logged, as_centre: Logged | None) -> None:
        """Count a sample, and store it, and the same as a centre's, if collected."""
        sample = each.sample
        if self.first_ns is None and sample.wall_ns:
            self.first_ns = sample.wall_ns
        traffic = self.traffic[sample.key]
        traffic.messages += 1
        traffic.bytes += len(sample.payload)
        known = channel_of(sample.key)
        if known is not None and known[0] in _SENSORS:
            self._count(each, known[1], odometry=known[0] is ch.ODOMETRY)
        self._keep(each)
        if as_centre is not None:
            self._keep(as_centre)

    def _keep(self, each: Logged) -> None:
        key = each.sample.key
        channel, _ = channel_of(key) or (None, "")
        if channel in _NEWEST:
            self.latest[key] = each
        elif channel in _COLLECTED:
            self.samples[key].append(each)

    def _count(self, each: Logged, robot: str, *, odometry: bool) -> None:
        numbered = each.numbered
        if numbered is None:
            self.unsound += 1
            return
        of_robot, name = self.measurements[robot], (numbered.incarnation, numbered.number)
        if name not in of_robot and isinstance(each.message, _TIMED):
            self.timed[robot, numbered.incarnation].take(each.message)
        of_robot[name] = odometry or of_robot.get(name, False)

    def conclude(self, agreement: Agreement) -> None:
        """Take the final map of most peers, in a log without a centre's."""
        self.disagreement = agreement.disagreement
        if ch.FINAL_MAP.key() not in self.latest and (largest := agreement.largest) is not None:
            self._keep(Logged(as_centre_final(largest)))


def collect_log(samples: Iterable[Sample]) -> Collected:
    """Collect a log's contents."""
    found, centre = Collected(), PeersAsCentre()
    for each, as_centre in read_logged(samples, centre):
        found.take(each, as_centre)
    found.conclude(centre.agreement)
    return found
