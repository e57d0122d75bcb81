"""The driver's node: publish the file's measurements, answer requests, track the receivers."""

from collections.abc import Callable
from typing import ClassVar

import msgspec

from teamslam.team.config import RobotConfig
from teamslam.team.door import absurd
from teamslam.team.driver.journal import Journal
from teamslam.team.driver.source import (
    BATCH,
    CREDIT_MEASUREMENTS,
    CREDIT_RECORDER,
    answer_request,
    channel_of,
)
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.arrays import floats
from teamslam.team.wire.bus import Outgoing
from teamslam.team.wire.codec import decoded

DAY_NS = 86_400 * 10**9
Stream = tuple[int, int]  # (incarnation, measurements) that a receiver has consumed


class SourceNode:
    """Call `begin`, then `publish` and `handle` in turn until `finished`.

    An incarnation is published once the robot has consumed the one before. delivered, recorded:
    progress of robot and recorder. done: incarnation, measurements and submaps of the robot's
    `Done`. joined: submaps acknowledged by the centre. is_peer: the robot keeps a set of its own.
    concluded: it has its final map. models: the robot's configuration.
    """

    def __init__(self, journal: Journal) -> None:
        self._robot = journal.robot
        self.replace(journal)
        self.finished = self.ordered_to_end = self.is_peer = self.concluded = False
        self.delivered: Stream = (0, 0)
        self.recorded: Stream = (0, 0)
        self.joined: Stream = (0, 0)
        self.done = (0, 0, 0)
        self.pose: m.PoseEstimate | None = None
        self.models: RobotConfig | None = None
        self.warnings: list[str] = []
        self.alive: set[str] = set()  # the nodes of the team that are present
        self.run = ""  # the team's run by its recorder; empty: none is known
        self._said: m.StreamHead | None = None
        self._others: set[str] = set()
        self.fed: tuple[dict[str, float], tuple[str, ...]] = {}, ()
        """Figures and warnings of the driver's input, such as a ROS 2 robot's topics."""
        self.on_message: Callable[[m.Message], None] | None = None
        """Called in the link's thread with each message of the team, for a program's own use."""
        self.maps: tuple[m.SavedMap, ...] = ()  # saved maps of earlier days, for the team's set
        self.listening = True  # true until the robot's earlier progress has been received

    def replace(self, journal: Journal) -> None:
        """Publish another journal from its beginning."""
        self.journal = journal
        self._incarnation = next(iter(journal.incarnations), 0)
        self._published = journal.count(self._incarnation)

    listens: ClassVar[tuple[ch.Channel, ...]] = (
        ch.ROBOT_PROGRESS,
        ch.ROBOT_DONE,
        ch.ROBOT_CONFIG,
        ch.CENTRAL_PROGRESS,
        ch.RECORDER_PROGRESS,
        ch.CONCLUDED,
        ch.TEAM_POSE,
        ch.TEAM_END,
        ch.FINAL_MAP,
    )
    """Channels of this robot or the team; the link adds all heads, the robot's set summary and the
    recorder's status.
    """

    results: ClassVar[tuple[ch.Channel, ...]] = (
        ch.FUSED_MAP,
        ch.TEAM_MAP,
        ch.TEAM_FINAL,
        ch.TRAJECTORY,
        ch.TEAM_TRAJECTORY,
    )
    """Channels of the team's results, for a program that has subscribed to them."""

    def begin(self) -> list[Outgoing]:
        """Publish the saved maps, and the stream's initial pose and head, for late receivers."""
        maps = [Outgoing(ch.SAVED_MAP, saved.author, saved) for saved in self.maps]
        if not self._incarnation:
            return maps
        start = self.journal.message(self._incarnation, 0)
        return [*maps, Outgoing(ch.START, self._robot, start), *self.head(again=True)]

    def publish(self) -> list[Outgoing]:
        """Publish the next measurements that credit allows, at most BATCH."""
        out: list[Outgoing] = []
        while len(out) < BATCH and self._has_credit and (number := self._next()) is not None:
            message = self.journal.message(self._incarnation, number)
            out.append(Outgoing(channel_of(message), self._robot, message))
            self._published = number + 1
        return out

    def _next(self) -> int | None:
        if self._published < self.journal.count(self._incarnation):
            return self._published
        if self._incarnation == self.journal.incarnation:
            return None
        if self._incarnation and self.delivered < (self._incarnation, self._published):
            return None
        self._incarnation = min(i for i in self.journal.incarnations if i > self._incarnation)
        self._published = 0
        return self._next()

    @property
    def _has_credit(self) -> bool:
        return all(
            node not in self.alive
            or self._published - (consumed[1] if consumed[0] == self._incarnation else 0) < credit
            for node, consumed, credit in (
                (ch.robot_node(self._robot), self.delivered, CREDIT_MEASUREMENTS),
                ("recorder", self.recorded, CREDIT_RECORDER),
            )
        )

    def head(self, *, again: bool = False) -> list[Outgoing]:
        """Publish the stream's head if it has changed, or again."""
        if not self._incarnation:
            return []
        last = self._incarnation == self.journal.incarnation
        count = self.journal.count(self._incarnation)
        newest = self.journal.message(self._incarnation, count - 1)
        said = m.StreamHead(
            stamp_ns=newest.stamp_ns,
            robot=self._robot,
            incarnation=self._incarnation,
            measurements=count,
            state=self.journal.state if last else "open",
        )
        if said == self._said and not again:
            return []
        self._said = said
        return [Outgoing(ch.HEAD, self._robot, said)]

    @property
    def has_new_state(self) -> bool:
        """Whether the stream's end, or the driver's leaving, is unpublished."""
        return self._said is not None and self._said.state != self.journal.state

    @property
    def has_more(self) -> bool:
        """Whether there are measurements to publish and credit for them."""
        return self._has_credit and self._published < self.journal.count(self._incarnation)

    def refusal(self, message: m.Message) -> str | None:
        """Reason to refuse a message that claims more than was numbered, or None."""
        refused = absurd(message)
        if refused is not None or not isinstance(message, m.Progress | m.Done):
            return refused
        if message.robot != self._robot or (isinstance(message, m.Progress) and self.listening):
            return None
        at, here = (message.incarnation, message.measurements), self._newest
        if at > here:
            return (
                f"consumed {at[1]} measurements of incarnation {at[0]}; "
                f"{self.journal.path} has {here[1]} of incarnation {here[0]}"
            )
        return None

    def handle(self, message: m.Message) -> list[Outgoing]:
        """Update the state by progress, liveliness, orders and the final map."""
        if isinstance(message, m.Status) and message.node == "recorder":
            self.run = message.run or self.run
            return []
        if self.on_message is not None:
            self.on_message(message)
        self._update(message)
        return []

    def _update(self, message: m.Message) -> None:
        match message:
            case m.Progress() if message.robot != self._robot:
                pass
            case m.Progress() if message.node == "central":
                self.joined = max(self.joined, (message.incarnation, message.submaps))
            case m.Done() if message.robot == self._robot:
                self.done = max(
                    self.done, (message.incarnation, message.measurements, message.submaps)
                )
            case m.Progress() if message.node == "recorder":
                self.recorded = max(self.recorded, (message.incarnation, message.measurements))
            case m.Progress():
                self.delivered = max(self.delivered, (message.incarnation, message.measurements))
            case m.Liveliness():
                (self.alive.add if message.alive else self.alive.discard)(message.node)
            case m.TeamEnd():
                self.ordered_to_end = True
            case m.FusedMap() if message.final:
                self.finished = True
            case m.SetSummary() | m.Concluded():
                self.is_peer = True
                self.concluded |= isinstance(message, m.Concluded) and message.robot == self._robot
            case m.PoseEstimate() | m.Configuration():
                self._update_robot(message)
            case m.StreamHead() if message.robot != self._robot:
                self._compare(message)
            case _:
                pass

    def _update_robot(self, message: m.PoseEstimate | m.Configuration) -> None:
        if isinstance(message, m.PoseEstimate):
            self.pose = message
        elif message.node == ch.robot_node(self._robot):
            self.models = _models(message)

    def _compare(self, head: m.StreamHead) -> None:
        if not self.journal.incarnation or head.robot in self._others:
            return
        apart_ns = self.journal.newest_ns - head.stamp_ns
        if abs(apart_ns) > DAY_NS:
            self._others.add(head.robot)
            years = apart_ns / (365.25 * DAY_NS)
            way = "ahead of" if apart_ns > 0 else "behind"
            self.warnings.append(
                f"the clock of {self._robot} is {abs(years):.2f} years {way} that of {head.robot}: "
                "all robots of a team stamp with one clock; Unix time will do"
            )

    def measurements(self, request: bytes) -> list[bytes]:
        """Answer a `MeasurementsRequest`."""
        requested = decoded(request, m.MeasurementsRequest)
        incarnation = requested.incarnation or self._incarnation
        if requested.robot != self._robot or incarnation not in self.journal.incarnations:
            return []
        count = self.journal.count(incarnation)
        return answer_request(
            requested, count, lambda number: self.journal.message(incarnation, number)
        )

    @property
    def is_delivered(self) -> bool:
        """Whether no process can request the measurements again.

        The robot has consumed them, the centre has acknowledged its submaps (a peer has its final
        map), and a present recorder has everything.
        """
        incarnation, measurements, submaps = self.done
        is_joined = self.joined >= (incarnation, submaps) or not submaps or self.concluded
        has_all = (incarnation, measurements) >= self._newest
        return has_all and is_joined and not self.recorder_lacks

    @property
    def recorder_lacks(self) -> bool:
        """Whether a present recorder lacks measurements."""
        return "recorder" in self.alive and self.recorded < self._newest

    @property
    def _newest(self) -> Stream:
        return self.journal.incarnation, self.journal.count(self.journal.incarnation)

    @property
    def waits_for(self) -> str:
        """The required nodes that are absent, in words."""
        needed = [ch.robot_node(self._robot), *([] if self.is_peer else ["central"])]
        missing = [node for node in needed if node not in self.alive]
        return " and ".join(missing)

    def status(self) -> m.Status:
        """Return the driver's status."""
        figures = {
            "measurements": float(self.journal.count(self.journal.incarnation)),
            "incarnation": float(self.journal.incarnation),
            "published": float(self._published),
            "delivered": float(self.delivered[1]),
            "team_time_s": 1e-9 * self.journal.newest_ns if self.journal.incarnation else 0.0,
            **self.fed[0],
        }
        state = self.journal.state if self.journal.incarnation else "waiting"
        waits = (f"waiting for {self.waits_for}",) if self.waits_for else ()
        idle = () if self.journal.incarnation else ("nothing measured yet",)
        return m.Status(
            stamp_ns=max(self.journal.newest_ns, 0),
            node=ch.source_node(self._robot),
            state="measuring" if state == "open" else state,
            figures=figures,
            warnings=(*waits, *idle, *self.fed[1], *self.warnings[-3:]),
        )

    @property
    def team_pose(self) -> tuple[float, tuple[float, float, float]] | None:
        """Time [s] and pose last published in the team's frame; None: not joined."""
        if self.pose is None or not self.pose.in_team_frame:
            return None
        x, y, theta = (float(v) for v in floats(self.pose.pose, "pose"))
        return 1e-9 * self.pose.stamp_ns, (x, y, theta)


def _models(message: m.Configuration) -> RobotConfig | None:
    try:
        return msgspec.json.decode(message.configuration, type=RobotConfig)
    except (msgspec.MsgspecError, ValueError):
        return None
