"""The robot's node: messages in, messages out; no I/O, no clock.

A measurement passes a row of parts, each a module of its own:

    inbox → front_end → ledger → outbox, poses, maps
    order   estimate    account  what goes out

Law 1 lives here: what is published for fusion (`submap`) depends on the robot's own measurements
alone. The fused map comes in as a prior and goes out as `team/pose`, and nowhere else. Only a rule
with feedback (`kalman`, `kalman-per-axis`, `covariance-intersection`) absorbs the fused map into
the map that the robot publishes; such a robot waits for the answer of each exchange before it goes
on.
"""

from collections.abc import Callable, Sequence

import msgspec

from team import translate
from team.config import Exchange, RobotConfig
from team.door import absurd, another_time
from team.estimation.hybrid_slam.closed_window import ClosedWindow
from team.estimation.submap import LocalMap
from team.pairs import FEEDBACK, PAIRS
from team.rejection import UNMEASURED, Rejection
from team.robot.estimator import NOTHING_NEW, Estimates
from team.robot.front_end import BoundedEstimator
from team.robot.ledger import INITIAL_POSE, Ledger, OnDisposition, no_listener
from team.robot.maps import RunningMaps
from team.robot.outbox import Outbox
from team.robot.pace import Pace
from team.robot.poses import RunningPoses
from team.robot.statements import MessageWriter
from team.robot.stream_end import EndOfStream
from team.robot.warnings import driver_away, slipped, unexpected
from team.stream.inbox import Inbox
from team.wire import channels as ch
from team.wire import messages as m
from team.wire.bus import Outgoing
from team.wire.codec import unsound
from team.wire.digest import configured

AHEAD = 64
"""Number of submaps of an earlier process that the centre may have taken since it was asked for
them."""

Replaced = Callable[[ClosedWindow, m.Prior | None, Sequence[LocalMap]], ClosedWindow]
"""What is sent instead of a closed window, given the team's map and the submaps before it."""


class RobotNode:
    """The node of one robot: call `begin`, then `handle` for every message, until `finished`.

    For recomputing a log: announced, the digest under which the configuration was announced; poses,
    when and from which priors poses are published; replaced, what is sent instead of a window, to
    show what that costs; on_window is given each window that closes.
    """

    listens = (
        *ch.SENSORS,
        ch.HEAD,
        ch.KNOWN_MAP,
        ch.END,
        ch.TEAM_END,
        ch.PRIOR,
        ch.FUSED_MAP,
        ch.FINAL_MAP,
        ch.CENTRAL_PROGRESS,
    )

    def __init__(
        self,
        config: RobotConfig,
        exchange: Exchange = "continuous",
        *,
        announced: bytes | None = None,
        poses: RunningPoses | None = None,
        replaced: Replaced | None = None,
        on_window: Callable[[ClosedWindow], None] = lambda _: None,
        on_disposition: OnDisposition = no_listener,
    ) -> None:
        self.config = config
        self.robot = config.id
        self.warnings: list[str] = []
        self._announcement = configured(ch.robot_node(config.id), 0, 0, config)
        if announced is not None:
            self._announcement = msgspec.structs.replace(self._announcement, digest=announced)
        self._replaced = replaced
        self._on_window = on_window
        self._on_disposition = on_disposition
        self._inbox = Inbox()
        self._stream_end = EndOfStream(config.id, self._inbox)
        self._front = BoundedEstimator(config, self.warnings)
        self.ledger = Ledger(self._front.estimator.used, on_disposition=self._on_disposition)
        """Law 1's account of the incarnation that is being consumed."""
        self._outbox = Outbox(config.id, exchange)
        submaps = PAIRS[config.estimator, config.fusion] == "submap"
        self._pace = Pace(lockstep=config.fusion in FEEDBACK, credit=submaps)
        self._poses = RunningPoses(config, self.warnings) if poses is None else poses
        self._maps = RunningMaps(config, self._pace, self.warnings)
        self._incarnation = 0
        self._consumed = 0
        self._steps = 0
        self._steps_before = 0
        self._taking: m.Measurement | None = None
        self._rejected: Rejection | None = None
        self._now_ns = 0
        self._passed_ns = 0
        self._began_ns = 0
        self._pending: list[Outgoing] = []
        self._done = False
        self._has_sent_done = False
        self._dones: list[m.Done] = []
        self.finished = False
        self.final: m.FusedMap | None = None
        self.withheld = 0

    # What the shell asks.

    @property
    def incarnation(self) -> int:
        """The incarnation of the stream that is being consumed."""
        return self._inbox.incarnation

    @property
    def next_measurement(self) -> int:
        """The counter of the measurement that is consumed next."""
        return self._inbox.next_measurement

    @property
    def submaps(self) -> int:
        """Number of submaps of this incarnation that were sent, also by an earlier process."""
        return len(self._front.submaps) - self._outbox.submaps

    @property
    def overhears(self) -> tuple[ch.Channel, ...]:
        """Channels to subscribe to for all robots: teammates' encounters, if they matter."""
        return (ch.RENDEZVOUS,) if self._outbox.buffers else ()

    def request(self) -> m.MeasurementsRequest | None:
        """The measurements that are missing and must be asked for at their source."""
        missing = self._stream_end.missing()
        if missing is None:
            return None
        incarnation, first, last = missing
        return m.MeasurementsRequest(
            stamp_ns=self._now_ns,
            robot=self.robot,
            incarnation=incarnation,
            first=first,
            last=last,
        )

    def begin(self) -> list[Outgoing]:
        """The first messages of the node: its configuration."""
        return [Outgoing(ch.ROBOT_CONFIG, self.robot, self._announcement)]

    def take_over(self, stored: Sequence[m.Message]) -> None:
        """Continue where the centre's set of this robot ends; the latest incarnation comes first.

        The submaps of an earlier process can then be requested from this one, too.
        """
        start = stored[0]
        assert isinstance(start, m.InitialPose)
        of_it = (
            s for s in stored if isinstance(s, m.Submap) and s.incarnation == start.incarnation
        )
        self.resume(start, list(of_it))
        for message in stored:
            self._outbox.keep(message)

    def answer_submaps(self, request: bytes) -> list[bytes]:
        """The answer to `SubmapsRequest`: everything sent for fusion, also by an earlier
        process.
        """
        return self._outbox.answer(request)

    def resume(self, start: m.InitialPose, submaps: Sequence[m.Submap]) -> None:
        """Continue after the last of this robot's own submaps, as an earlier process sent them.

        `submaps` are those of the latest incarnation, without a gap from sequence 0.
        """
        self._begin_incarnation(start)
        for submap in submaps:
            self._front.resume(submap)
        last = submaps[-1]
        self._consumed = last.last_measurement + 1
        self.ledger = Ledger(self._front.estimator.used, self._consumed, self._on_disposition)
        self._pace.acknowledged = len(submaps)
        self._now_ns = self._passed_ns = last.stamp_ns
        self._inbox.resume(last.incarnation, last.last_measurement + 1)

    def refusal(self, message: m.Message) -> str | None:
        """Why a message can not be true of this robot: it is another's, its counts are absurd,
        or its end is too early.
        """
        refused = absurd(message)
        if refused is not None:
            return refused
        match message:
            case m.Measurement():
                own = message.robot == self.robot
                return self._inbox.refusal(message) if own else f"a measurement of {message.robot}"
            case m.Progress() if message.incarnation == self._incarnation:
                if message.submaps > self.submaps + AHEAD:
                    return (
                        f"acknowledges {message.submaps} submaps of {self.submaps}: the centre's "
                        "set is of another run; start the centre again with a new --set FILE"
                    )
            case m.End() | m.StreamHead():
                return self._stream_end.refusal(message)
            case _:
                pass
        return None

    def confirm(self, measurement: m.Measurement) -> None:
        """Note that a measurement comes in the source's own answer to a question."""
        self._inbox.confirm(measurement)

    def end_in(self, end: m.End) -> tuple[int, int]:
        """Incarnation and measurements at which an announced end ends this robot's stream.

        One that does not name the robot says that its stream has none.
        """
        ends = [(s.incarnation, s.measurements) for s in end.streams if s.robot == self.robot]
        return ends[0] if ends else (self.incarnation, 0)

    def confirm_end(self, incarnation: int, measurements: int) -> None:
        """Take the source's own answer that an incarnation ends so: what came behind it was not
        the source's.
        """
        self._stream_end.at_source = incarnation, measurements

    def status(self) -> m.Status:
        """The robot's status, for people."""
        measurements, outliers = self._inbox.next_measurement, self.config.front_end.outlier_share
        nis = self._front.estimator.innovation
        figures = {
            "steps": float(self._steps_before + self._steps),
            "measurements": float(measurements),
            "submaps": float(self.submaps),
            "particles": float(self.config.front_end.particles),
            "landmarks": float(len(self._front.estimator.own_map().ids)),
            "pose_sigma_m": self._poses.sigma_m,
            "withheld": float(self.withheld),
        }
        if self._outbox.buffers:
            figures["held_submaps"] = float(self._outbox.submaps)
        if nis.per_dof is not None:
            figures |= {"nis_per_dof": nis.per_dof, "nis_dof": float(nis.dof)}
        if self._poses.has_prior:
            figures["landmarks_refused"] = float(self._poses.team_map.refused)
        if outliers:
            figures["gated"] = float(self._front.gated)
        state = "done" if self._done else "mapping" if measurements else "waiting"
        warnings = ["no measurements of this team yet"] if state == "waiting" else []
        if self._stream_end.waits_for_driver and not self._done:
            warnings = [driver_away(measurements - 1)]
        if self._poses.team_map.doubt:
            warnings.append(self._poses.team_map.doubt)
        return m.Status(
            stamp_ns=self._now_ns,
            node=ch.robot_node(self.robot),
            state=state,
            figures={name: value for name, value in figures.items() if abs(value) <= 1e300},
            warnings=(
                *warnings,
                *unexpected(nis, outliers, self.config.estimator),
                *self.warnings[-3:],
            ),
        )

    # What comes in.

    def handle(self, message: m.Message, now_ns: int) -> list[Outgoing]:
        """Take one message; `now_ns` is the team time of its arrival (unused: stamps are time)."""
        out = [*self._handled(message), *self._go_on()]
        return self._sound(out) if out else out

    def set_aside(self, message: m.Message, why: str) -> list[Outgoing]:
        """Continue behind a measurement whose handling raised an exception, as if it had not come.

        An estimator of submaps is reset to its last submap and the window's other measurements. One
        that raises as it closes its last window ends with `Done` without it.
        """
        if self._taking is not None:
            self.ledger.count(self._taking, Rejection.SET_ASIDE)
            self._taking = None
            self._front.put_back()
        if self._done and not self._has_sent_done:
            self._pending += self._last_words()
        return self._sound(self._go_on())

    def _sound(self, out: Sequence[Outgoing]) -> list[Outgoing]:
        """The messages that every receiver accepts; others are withheld and named.

        Of a map what rounding has spoilt is left out.
        """
        sound = []
        for each in out:
            why = unsound(each.message)
            if why is not None and isinstance(each.message, m.MapEstimate):
                each = each._replace(message=translate.receivable(each.message)[0])
                why = unsound(each.message)
            if why is None:
                sound.append(each)
            else:
                self.withheld += 1
                self.warnings.append(f"withheld: {each.key}, {why}")
        return sound

    def _handled(self, message: m.Message) -> list[Outgoing]:
        """Handle a message at once; returns what to publish before further measurements are
        taken.
        """
        match message:
            case m.Measurement():
                self._inbox.put(message)
            case m.Prior():
                return self._poses.take(message)
            case m.KnownMap():
                self._front.know(message)
            case m.FusedMap() if message.final:
                self.finished, self.final = True, message
            case m.FusedMap():
                self._maps.absorb(message, self._front)
            case m.Progress():
                if message.incarnation == self._incarnation:
                    acknowledged = max(self._pace.acknowledged, message.submaps)
                    self._pace.acknowledged = acknowledged
            case m.Rendezvous():
                return self._release(()) if self.robot in message.teammates else []
            case _:
                self._hear_of_the_end(message)
        return []

    def _hear_of_the_end(self, message: m.Message) -> None:
        """Handle presence, and where the stream ends."""
        match message:
            case m.Liveliness() if message.node == ch.source_node(self.robot):
                self._stream_end.driver_is_there = message.alive
            case m.Liveliness():
                if message.node == "central":
                    self._pace.centre_alive = message.alive
            case m.End():
                self._stream_end.take(message)
            case m.StreamHead():
                head = self._stream_end.take_head(message)
                if head.state != "open":
                    self._pending.append(Outgoing(ch.ROBOT_HEAD, self.robot, head))
                if self._consumed:
                    self._pending.append(self._progress())
            case m.TeamEnd():
                self._stream_end.is_ordered = True
            case _:
                self.warnings.append(f"no use for a {type(message).__name__}")

    # The stream.

    def _go_on(self) -> list[Outgoing]:
        """Take the measurements whose turn has come; messages to publish are kept until they are
        out.
        """
        measurements = self._inbox.taken()
        blocked = self._blocked
        while not blocked and (measurement := next(measurements, None)) is not None:
            self._pending += self._take(measurement)
            blocked = self._blocked
        self._stream_end.end_without_driver()
        if not self._done and not blocked and self._stream_end.reached:
            self._pending += self._finish()
        self._pending += self._credit()
        out, self._pending = self._pending, []
        return out

    @property
    def _blocked(self) -> bool:
        """Whether the robot waits: for a prior map, for the centre's answer or for its credit."""
        return self._front.waits or self._pace.holds(self.submaps)

    def _credit(self) -> list[Outgoing]:
        """Report the measurements received; a robot that waits for an exchange does so, too."""
        waits = self._pace.lockstep and self._blocked
        if waits and self._pace.owes(self._inbox.received, self._consumed):
            return [self._progress()]
        return []

    def _take(self, measurement: m.Measurement) -> list[Outgoing]:
        out: list[Outgoing] = []
        if isinstance(measurement, m.InitialPose):
            out += self._leave_incarnation()
            self._begin_incarnation(measurement)
        self._taking, self._rejected = measurement, None
        self._consumed = measurement.number + 1
        stamp_ns = translate.team_time_of(measurement, self.config.clock_offset_s)
        if another_time(stamp_ns, self._began_ns) is None:  # the centre would refuse the last word
            self._now_ns = max(self._now_ns, stamp_ns)
            # What was seen at a stamp comes before the odometry that ends there, and may end a
            # window.
            ahead = 0 if isinstance(measurement, m.AnyOdometry) else 1
            self._passed_ns = max(self._passed_ns, stamp_ns - ahead)
        match measurement:
            case m.InitialPose():
                self.ledger.count(measurement, None, INITIAL_POSE)
            case m.Odometry() | m.Increment() | m.Steering():
                self._steps += 1
                estimates, self._rejected = self._front.drive(measurement)
                out += self._messages_of(estimates)
            case m.Observations() | m.Points() | m.Detections():
                self.ledger.count(measurement, self._front.observe(measurement))
            case m.Sightings():
                self.ledger.count(measurement, self._front.sight(measurement))
                out += self._release(measurement.teammates)
        self._taken()
        if self._pace.counted():
            out.append(self._progress())
        return out

    def _taken(self) -> None:
        """Account for the measurement in progress and add it to the open window."""
        if self._taking is not None:
            if isinstance(self._taking, m.AnyOdometry):
                self.ledger.count(self._taking, self._rejected)
                if not self._front.makes_submaps and self._rejected in UNMEASURED:
                    offset_s = self.config.clock_offset_s
                    self.ledger.cover(translate.team_time_of(self._taking, offset_s))
            self._front.keep(self._taking)
            self._taking = None

    def _messages_of(self, estimates: Estimates) -> list[Outgoing]:
        """The messages for what the estimator has produced."""
        if estimates is NOTHING_NEW:
            self._taken()
            return []
        closed, writer = estimates.closed, self._writer
        if closed is not None:
            cloud = estimates.cloud if self._maps.due(closed.start_ns, closed.end_ns) else None
            return [*writer.cloud(closed.end_ns, cloud), *self._send(closed)]
        self._taken()
        out: list[Outgoing] = []
        if estimates.pose_ns is not None:
            out += self._poses.at(estimates.pose_ns, self._front, writer)
        if estimates.judged is not None:
            judged, stamp_ns = estimates.judged
            out.append(writer.innovation(stamp_ns, self._front.estimator.sequence, judged))
        if estimates.map_ns is not None:
            out += writer.cloud(estimates.map_ns, estimates.cloud)
            out += self._maps.at(estimates.map_ns, self._front, writer)
        sequence = self._front.estimator.sequence
        return out + writer.association(sequence, self._now_ns, estimates.became)

    def _send(self, closed: ClosedWindow) -> list[Outgoing]:
        """Queue a submap for publication before anything else can raise an exception."""
        writer = self._writer
        if self._replaced is not None:
            prior = self._poses.prior_of(self._incarnation)
            closed = self._replaced(closed, prior, self._front.submaps)
        factors = [writer.sighting(closed, each) for each in closed.sightings]
        messages = [*factors, writer.submap(closed)]
        self._taken()
        self.ledger.close(closed)
        self.warnings += [slipped(slip) for slip in closed.slips]
        self._front.close(closed)
        self._on_window(closed)
        self._pending += self._outbox.put(messages)
        shown = self._maps.due(closed.start_ns, closed.end_ns)
        return [
            writer.innovation(closed.end_ns, closed.sequence, closed.innovation),
            *writer.association(closed.sequence, closed.end_ns, closed.became),
            *self._poses.at(closed.end_ns, self._front, writer),
            *(self._maps.at(closed.end_ns, self._front, writer) if shown else ()),
            self._progress(),
        ]

    def _release(self, seen: tuple[str, ...]) -> list[Outgoing]:
        """Release the submaps buffered for an encounter; `seen`: the teammates that are to do
        so, too.
        """
        released = self._outbox.release(seen, self._now_ns, self._incarnation)
        return [*released, self._progress()] if released else []

    @property
    def _writer(self) -> MessageWriter:
        digest = self._announcement.digest
        return MessageWriter(self.robot, self._incarnation, digest, self._front.started)

    def _progress(self) -> Outgoing:
        self._pace.unreported = 0
        since_ns = self._outbox.since_ns
        return Outgoing(
            ch.ROBOT_PROGRESS,
            self.robot,
            m.Progress(
                stamp_ns=self._passed_ns if since_ns is None else since_ns,
                node=ch.robot_node(self.robot),
                robot=self.robot,
                incarnation=self._incarnation,
                measurements=max(self._consumed, self._pace.credited),
                submaps=self.submaps,
            ),
        )

    # An incarnation begins and ends.

    def _begin_incarnation(self, start: m.InitialPose) -> None:
        self._front.begin(start)
        self.ledger = Ledger(self._front.estimator.used, on_disposition=self._on_disposition)
        self._outbox.keep(start)
        self._maps.begin_incarnation()
        self._pace.begin_incarnation()
        self._poses.begin_incarnation(start.incarnation)
        self._incarnation, self._consumed = start.incarnation, 0
        self._steps_before, self._steps = self._steps_before + self._steps, 0
        self._now_ns = max(self._now_ns, start.stamp_ns)
        self._passed_ns = start.stamp_ns - 1
        self._began_ns = start.stamp_ns

    def _leave_incarnation(self) -> list[Outgoing]:
        """Close the current incarnation, if there is one, because a later one begins."""
        if not self._consumed:
            return []
        self._passed_ns = self._now_ns
        if self._done:  # the driver had ended, and has come back: its last word is not the last
            self._done = self._has_sent_done = False
            self._dones.append(self._incarnation_done())
            return []
        out = self._close_incarnation()
        out += self._release(())
        self._dones.append(self._incarnation_done())
        return [*out, self._progress()]

    def _close_incarnation(self) -> list[Outgoing]:
        estimates, uncovered = self._front.estimator.finish()
        out = self._messages_of(estimates)
        if estimates.closed is None:
            self.ledger.leave_out(set())
        self.ledger.uncover(uncovered)
        return out

    def _finish(self) -> list[Outgoing]:
        """Finish: the last incarnation's `Done` goes first, since with it the centre may
        conclude.
        """
        self._done = True
        self._passed_ns = self._now_ns
        out = self._close_incarnation()
        out += self._maps.finish(self._front, self._writer)
        return out + self._last_words()

    def _last_words(self) -> list[Outgoing]:
        out = self._release(())
        dones = [self._incarnation_done(), *self._dones]
        self._has_sent_done = True
        return [*out, self._progress(), *(Outgoing(ch.ROBOT_DONE, self.robot, d) for d in dones)]

    def _counted(self) -> int:
        """The measurements of this incarnation, without what was consumed behind its end."""
        last = self._stream_end.last_of(self._incarnation)
        return self._consumed if last is None else min(self._consumed, last)

    def _incarnation_done(self) -> m.Done:
        return m.Done(
            stamp_ns=self._now_ns,
            robot=self.robot,
            incarnation=self._incarnation,
            measurements=self._counted(),
            steps=self._steps,
            submaps=self.submaps,
            ledger=self.ledger.entries(),
            last_map=self._maps.last,
        )
