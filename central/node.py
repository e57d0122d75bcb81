"""The centre's node: receive, file, fold, publish; no I/O, no clock.

    message ──> attendance   progress, presence and end of the robots' streams
            ──> store        submaps, inter-robot measurements, initial poses, orders, verdicts
            ──> fold         the ticks behind the watermark
            ──> maps         map, priors, withdrawals; at the end the final map

The node subscribes to nothing that contains the fused map. The centre of a comparison method
(`teamslam.sim.studies.rules`) is a subclass.
"""

from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import ClassVar

import msgspec

from teamslam.central.attendance import TeamAttendance
from teamslam.central.config import CentralConfig
from teamslam.central.fused_map import fused_message
from teamslam.central.map_publisher import MapPublisher
from teamslam.central.submap_fold import SubmapFold
from teamslam.team.door import Door, absurd
from teamslam.team.estimation.gaussian import NO_LANDMARKS
from teamslam.team.pairs import RULES
from teamslam.team.registry import load
from teamslam.team.store import SubmapStore
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.bus import Outgoing
from teamslam.team.wire.codec import decoded, encoded
from teamslam.team.wire.digest import announce_configuration

MOST_ROBOTS = 100
"""Most robots of a team, admitted ones included."""


class CentralNode:
    """The node of the centre: call `begin`, then `handle` for every message, until `finished`.

    inputs: the channels of the set. announcement: the configuration, whose digest maps carry.
    admit: accept robots that the scenario does not name.
    """

    inputs: ClassVar[tuple[ch.Channel, ...]] = (
        ch.START,
        ch.SUBMAP,
        ch.SIGHTING_FACTOR,
        ch.ORDER,
        ch.VERDICT,
        ch.SAVED_MAP,
    )
    fold_class: ClassVar[type[SubmapFold]] = SubmapFold

    def __init__(
        self, config: CentralConfig, robots: Sequence[str], *, admit: bool = False
    ) -> None:
        self.config = config
        self.announcement = announce_configuration("central", 0, 0, config)
        self.config_digest = self.announcement.digest
        self.attendance = TeamAttendance(
            robots, self.has_received, lambda stream: self.store.processed(stream)
        )
        self._door = Door(robots)
        self._admits = admit
        self._loaded: tuple[m.SavedMap, ...] = ()
        self._admitted: list[str] = []
        self._broadcasts = 0
        self._begin_set()

    def _begin_set(self) -> None:
        self.store = SubmapStore()
        self.maps = MapPublisher(self.fold_class(self.config, self.config_digest, self.store))
        self.warnings = self.maps.warnings
        self._newest_map: m.FusedMap | None = None
        self._credit: list[Outgoing] | None = None
        self._concluding = False
        self.finished = False
        self.final: m.FusedMap | None = None

    def restart(self) -> None:
        """Begin with an empty set; the attendance stays."""
        self._begin_set()
        self.attendance.forget_members()

    @property
    def listens(self) -> tuple[ch.Channel, ...]:
        """The channels to subscribe to."""
        own = (ch.ROBOT_PROGRESS, ch.ROBOT_DONE, ch.END, ch.GIVEN_UP, ch.HEAD, ch.ROBOT_HEAD,
               ch.END_ORDER)  # fmt: skip
        others = (ch.ROBOT_CONFIG,) if self._admits else ()
        return tuple(dict.fromkeys((*self.inputs, *own, *others)))

    def load_maps(self, maps: Sequence[m.SavedMap]) -> None:
        """Load saved maps, before `begin`."""
        self._loaded = tuple(maps)

    def begin(self) -> list[Outgoing]:
        """Make the first messages: configuration and saved maps."""
        for saved in self._loaded:
            self.file(saved)
        maps = [Outgoing(ch.SAVED_MAP, saved.author, saved) for saved in self._loaded]
        return [Outgoing(ch.CENTRAL_CONFIG, "", self.announcement), *maps]

    # Receive.

    def refusal(self, message: m.Message) -> str | None:
        """Return the reason why a message cannot be true of this team."""
        self._admit(message)
        refused = self._door.refusal(message)
        if refused is None and isinstance(message, m.End):
            refused = self.attendance.contradicts(message)
            if refused is not None:
                self.attendance.note_end(message)
                # Where the robots' `Done` messages confirm it, no further message may follow.
                refused = None if self.attendance.is_concluded() else refused
        return refused

    def _admit(self, message: m.Message) -> None:
        robot = message.robot if isinstance(message, m.InitialPose) else None
        if isinstance(message, m.Configuration):
            robot = ch.robot_of(message.node)
        if not self._admits or robot is None or robot in self.robots or absurd(message):
            return
        if len(self.robots) < MOST_ROBOTS:
            self._door.admit(robot)
            self.attendance.admit(robot)
            self._admitted.append(robot)

    def handle(self, message: m.Message) -> list[Outgoing]:
        """Process one message; its stamp is the time."""
        if isinstance(message, m.FusedMap):
            return self._take_final(message)
        self._credit = None
        is_repeated = self.attendance.ordered
        self.attendance.take(message)
        if isinstance(message, m.TeamEnd):  # a node that joins later gets it from the centre
            order = [] if is_repeated else [Outgoing(ch.TEAM_END, "", message)]
            return order + self._advance()
        self._credit = self.file(message)
        return self._advance() + self._credit  # the credit comes after the map that it gave

    def set_aside(self, message: m.Message, why: str) -> list[Outgoing]:
        """Continue after an exception in `handle`: a member that was not filed counts as refused,
        and the newest map replaces a failed final one.
        """
        out, self._credit = self._credit, []
        self.attendance.note_change(message)
        if out is None:
            out = self._refuse(message, why)
        if self.finished or not self._is_over:
            return out
        return out + (self._conclude_anyway(why) if self._concluding else self._conclude())

    def _take_final(self, final: m.FusedMap) -> list[Outgoing]:
        if final.final and not self.finished:
            self.finished, self.final = True, final
        return []

    # File.

    def file(self, message: m.Message) -> list[Outgoing]:
        """File a member; return its sender's credit, or the order to repeat."""
        match message:
            case m.Submap() | m.SightingFactor():
                return self._file_member(message)
            case m.Withdrawal():
                return self._follow(message)
            case _:
                self._warn_of_refusal(self.store.add(message))
                return []

    def _file_member(self, member: m.Submap | m.SightingFactor) -> list[Outgoing]:
        stream = member.robot, member.incarnation
        before = self.store.processed(stream)
        self._warn_of_refusal(self.store.add(member))
        count = self.store.acknowledged(stream)
        is_counted = isinstance(member, m.Submap) or count > before
        return self._credit_of(member, count) if is_counted else []

    def _refuse(self, message: m.Message, why: str) -> list[Outgoing]:
        if not isinstance(message, m.Submap | m.SightingFactor):
            return []
        self.store.refuse(message)
        self._warn_of_refusal(why)
        processed = self.store.processed((message.robot, message.incarnation))
        return self._credit_of(message, processed)

    def _warn_of_refusal(self, reason: str | None) -> None:
        if reason is not None:
            self.warnings.append(f"refused: {reason}")

    def _credit_of(self, member: m.Submap | m.SightingFactor, count: int) -> list[Outgoing]:
        progress = m.Progress(
            stamp_ns=self.attendance.now_ns,
            node="central",
            robot=member.robot,
            incarnation=member.incarnation,
            measurements=0,
            submaps=count,
        )
        return [Outgoing(ch.CENTRAL_PROGRESS, member.robot, progress)]

    def _follow(self, order: m.Withdrawal) -> list[Outgoing]:
        """Follow an order, and repeat it for later robots: the operator's command has exited."""
        if order.by == "central" or not self.maps.withdraw(order):
            return []
        return [Outgoing(ch.WITHDRAWAL, order.robot, order)]

    # Fold and publish.

    def _advance(self) -> list[Outgoing]:
        if self.finished:
            return []
        self.attendance.withdrawn = frozenset(self.maps.withdrawn)
        out = self._counted(self.publish_due())
        return out + self._conclude() if self._is_over else out

    def publish_due(self) -> list[Outgoing]:
        """Fold the closed ticks; make the due maps."""
        return self.maps.publish_due(self.attendance.watermark_ns, self.attendance.now_ns)

    def publish_newest(self) -> list[Outgoing]:
        """Make a map of the whole set, unless the last one has it."""
        return self.maps.publish_newest(self.attendance.watermark_ns, self.attendance.now_ns)

    def publish_final(self) -> list[Outgoing]:
        """Make the last messages, the final map last."""
        return self.maps.publish_final(self.attendance.now_ns)

    def _counted(self, out: list[Outgoing]) -> list[Outgoing]:
        maps = [o.message for o in out if isinstance(o.message, m.FusedMap)]
        self._broadcasts += bool(maps)
        self._newest_map = maps[-1] if maps else self._newest_map
        return out

    def refresh(self) -> list[Outgoing]:
        """Make a map of the whole set when there is time."""
        return [] if self.finished else self._counted(self.publish_newest())

    # Conclude.

    def has_received(self, done: m.Done) -> bool:
        """Whether every input in a robot's `Done` has arrived."""
        return self.store.processed((done.robot, done.incarnation)) >= done.submaps

    @property
    def has_all_measurements(self) -> bool:
        """Whether all raw measurements have arrived: the centre consumes none."""
        return True

    @property
    def _is_over(self) -> bool:
        return self.attendance.is_concluded() and self.has_all_measurements

    def _conclude(self) -> list[Outgoing]:
        self._concluding = True
        *out, last = self.publish_final()
        final = last.message
        assert isinstance(final, m.FusedMap)
        self.finished = True
        lost = tuple(self.attendance.missing())
        if lost:
            final = msgspec.structs.replace(final, provisional=True, lost=lost)
        self.final = final
        return [*out, Outgoing(ch.FINAL_MAP, "", final)]

    def _conclude_anyway(self, why: str) -> list[Outgoing]:
        newest = self._newest_map or fused_message(
            self.config,
            self.config_digest,
            NO_LANDMARKS,
            (),
            stamp_ns=self.attendance.now_ns,
            joint=False,
        )
        reasons = (*newest.reasons, f"not the final map, which raised: {why}")
        lost = tuple(self.attendance.missing())
        final = msgspec.structs.replace(
            newest, final=True, provisional=True, reasons=reasons, lost=lost
        )
        self.finished, self.final = True, final
        return [Outgoing(ch.FINAL_MAP, "", final)]

    # Answers to the shell.

    @property
    def robots(self) -> Collection[str]:
        """The robots of the team."""
        return self.attendance.robots.keys()

    @property
    def awaited(self) -> list[str]:
        """The absent robots that the map awaits."""
        return [] if self.finished else self.attendance.awaited()

    @property
    def ends(self) -> bool:
        """Whether all streams have ended, by the world or the drivers."""
        return self.attendance.end is not None

    def requests(self) -> list[m.MeasurementsRequest]:
        """Requests for raw measurements: the centre consumes none."""
        return []

    def lacking(self) -> list[m.SubmapsRequest]:
        """Request the submaps that robots have announced and no map can have."""
        if self.finished:
            return []
        sent: dict[tuple[str, int], int] = {}
        for robot in self.attendance.robots.values():
            for each in (robot.progress, robot.done):
                if each is not None:
                    stream = (each.robot, each.incarnation)
                    sent[stream] = max(sent.get(stream, 0), each.submaps)
        return [
            m.SubmapsRequest(
                stamp_ns=self.attendance.now_ns, robot=robot, incarnation=incarnation, first=first
            )
            for (robot, incarnation), count in sorted(sent.items())
            if (first := self.store.processed((robot, incarnation))) < count
        ]

    def answer_submaps(self, request: bytes) -> Iterable[bytes]:
        """Answer with a robot's members, the latest incarnation first."""
        robot = decoded(request, m.SubmapsRequest).robot
        return [encoded(message) for message in self.store.messages_of(robot)]

    def answer_site(self, request: bytes) -> Iterable[bytes]:
        """Answer a `FoldRequest` with a saved map of the present set; raises NothingToSaveError."""
        decoded(request, m.FoldRequest)
        fold = self.maps.fold
        if not self.finished:
            fold = self.fold_class(self.config, self.config_digest, self.store)
            fold.make_map("final")
        return [encoded(fold.save_map("site"))]

    # Status.

    @property
    def landmarks(self) -> int:
        """Number of landmarks in the newest map."""
        return self.maps.fold.landmarks

    @property
    def figures(self) -> Mapping[str, float]:
        """The monitor's figures."""
        return self.maps.fold.figures

    @property
    def findings(self) -> tuple[str, ...]:
        """Warnings for readers of the map."""
        return self.maps.fold.findings

    def status(self) -> m.Status:
        """Report the centre's status, for people."""
        now_ns = self.attendance.now_ns
        figures = {
            "broadcasts": float(self._broadcasts),
            "submaps": float(self.store.submaps),
            "landmarks": float(self.landmarks),
            "team_time_s": now_ns * 1e-9,
            "refused": float(self.store.refused + self.maps.fold.not_folded),
        }
        given_up = [
            f"{robot} is given up: nobody waits for it, and the final map will be provisional"
            for robot in self.attendance.given_up
        ]
        names = ", ".join(self._admitted)
        admitted = [f"admitted, though not in the scenario: {names}"] if names else []
        return m.Status(
            stamp_ns=now_ns,
            node="central",
            state="done" if self.finished else "joining",
            figures=figures | dict(self.figures),
            warnings=(*given_up, *admitted, *self.findings, *self.warnings[-3:]),
        )


def node_class(config: CentralConfig) -> type[CentralNode]:
    """Return the fusion rule's node class; raises NotInstalledError."""
    found: type[CentralNode] = load(
        RULES[config.fusion].made_by, f"the fusion rule {config.fusion}"
    )
    return found


def make_centre(
    config: CentralConfig,
    robots: Sequence[str],
    *,
    admit: bool = False,
    maps: Sequence[m.SavedMap] = (),
) -> CentralNode:
    """Make the fusion rule's node; raises NotInstalledError."""
    centre = node_class(config)(config, robots, admit=admit)
    centre.load_maps(maps)
    return centre
