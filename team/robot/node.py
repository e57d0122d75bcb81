"""The robot's node: messages in, messages out; no I/O, no clock.

Law 1 lives here: what is published for fusion (`submap`) depends on the robot's own measurements
alone. The fused map comes in as a prior and goes out as `team/pose`, and nowhere else. Only a rule
with feedback (`kalman`, `kalman-per-axis`, `covariance-intersection`) absorbs the fused map into
the map that the robot publishes; such a robot waits for the answer of each exchange before it goes
on.
"""

from collections import Counter
from collections.abc import Sequence

import numpy as np

from team import translate
from team.config import Exchange, RobotConfig
from team.door import absurd
from team.estimation.gaussian import LandmarkGaussian, NotACovarianceError
from team.estimation.hybrid_slam.closed_window import ClosedWindow
from team.estimation.hybrid_slam.innovation import Innovation
from team.estimation.map_joining.gauss_newton import NotDeterminedError
from team.estimation.plausible import prior_beyond, start_beyond
from team.estimation.scans import sensible
from team.estimation.submap import LocalMap, Slipped
from team.pairs import FEEDBACK, NEEDS_MAP, PAIRS
from team.rejection import UNMEASURED, Rejection
from team.robot.estimator import (
    AT_ORIGIN,
    NOTHING_KNOWN,
    NOTHING_NEW,
    AbsorbsMaps,
    Associates,
    Estimates,
    InitialPose,
    KnownMap,
    MakesSubmaps,
    RobotEstimator,
    estimator_of,
)
from team.robot.pace import Pace
from team.robot.rendezvous import Held
from team.robot.sent import Sent
from team.robot.statements import Speaker
from team.robot.team_map import TeamMap
from team.stream.inbox import Inbox
from team.stream.judge import StreamJudge
from team.wire import channels as ch
from team.wire import messages as m
from team.wire.bus import Outgoing
from team.wire.codec import decoded, encoded, unsound
from team.wire.newer import is_newer_prior, later_end, later_head

AHEAD = 64
"""Submaps of an earlier life that the centre may have taken since it was asked for them."""
IN_SIGHTING = "in a sighting factor"
"""The disposition of a measurement of teammates that was used."""
MOST_SET_ASIDE = 8
"""Measurements of one window after which the estimator is not put back behind them any more."""
UNEXPECTED = 3.0
"""NIS per degree of freedom above which measurements are not what the models say: 1 is right, and
5 % of outliers give 3 with a coarse sensor, a hundred with an accurate one."""
UNEXPECTED_DOF = 60
"""… judged from so many degrees of freedom on."""
JOINT_LANDMARKS = 2000
"""An own map of more landmarks carries their own covariances only: a message has 64 MiB at most."""


class RobotNode:
    """One robot: `begin`, then `handle` for every message, until `finished`."""

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

    def __init__(self, config: RobotConfig, exchange: Exchange = "continuous") -> None:
        self.config = config
        self._held = Held(exchange == "rendezvous")
        self.robot = config.id
        self._inbox = Inbox()
        self._announcement = translate.configured(ch.robot_node(config.id), 0, 0, config)
        self._consumer = PAIRS[config.estimator, config.fusion]
        self._pace = Pace(config.fusion in FEEDBACK, self._consumer == "submap")
        self._known = NOTHING_KNOWN if config.estimator not in NEEDS_MAP else None
        self._known_ns: int | None = None
        self._estimator: RobotEstimator
        self._windows: MakesSubmaps | None
        self._begin_estimator(0, AT_ORIGIN)
        self._locals: list[LocalMap] = []
        self._prior: m.Prior | None = None
        self._team_map = TeamMap()
        self._sent = Sent()
        self._incarnation = 0
        self._consumed = 0
        self._steps = 0
        self._last_map = -1
        self._ledger: Counter[str] = Counter()
        self._judge = StreamJudge(config.bounds)
        self._unused: Rejection | None = None
        self._sighted: set[int] = set()
        self._withdrawn: set[str] = set()
        self._ended: list[m.Done] = []
        self._end: m.StreamEnd | None = None
        self._world_end: m.End | None = None
        self._head: m.StreamHead | None = None
        self._driver_is_there: bool | None = None
        self._is_to_end = False
        self._exchange_ns: int | None = None
        self._map_ns: int | None = None
        self._pose_ns: int | None = None
        self._now_ns = 0
        self._passed_ns = 0
        self._done = False
        self._start: m.InitialPose | None = None
        self._closed: list[ClosedWindow] = []
        self._window: list[m.Measurement] = []
        self._taking: m.Measurement | None = None
        self._aside = 0
        self._pending: list[Outgoing] = []
        self._said_done = False
        self.steps = 0
        self.finished = False
        self.final: m.FusedMap | None = None
        self.withheld = 0
        self.warnings: list[str] = []

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
        """How many submaps of this incarnation have been sent, in this life or an earlier one."""
        return len(self._locals) - self._held.submaps

    @property
    def overhears(self) -> tuple[ch.Channel, ...]:
        """The channels to subscribe to whoever they name: orders, and teammates that meet."""
        orders = (ch.ORDER, ch.WITHDRAWAL)
        return (*orders, ch.RENDEZVOUS) if self._held.waits else orders

    def wanted(self) -> m.MeasurementsRequest | None:
        """The measurements that are missing and must be asked for at their source."""
        missing = None if self.waits_for_driver else self._inbox.missing(self._known_end)
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

    @property
    def waits_for_driver(self) -> bool:
        """Its measurements come from a driver, and that is not there to be asked."""
        return self._head is not None and self._driver_is_there is False

    @property
    def _known_end(self) -> m.StreamEnd | None:
        """The stream's last counter that anybody has told, whether it has ended or not."""
        head = self._head
        if self._end is not None or head is None:
            return self._end
        return m.StreamEnd(
            robot=head.robot, incarnation=head.incarnation, measurements=head.measurements
        )

    def begin(self) -> list[Outgoing]:
        """What the node says first: its configuration."""
        return [Outgoing(ch.ROBOT_CONFIG, self.robot, self._announcement)]

    def take_over(self, kept: Sequence[m.Message]) -> None:
        """Go on where the centre's set of this robot ends: the latest incarnation comes first.

        What an earlier life has sent can be asked of this one, too.
        """
        start = kept[0]
        assert isinstance(start, m.InitialPose)
        of_it = (s for s in kept if isinstance(s, m.Submap) and s.incarnation == start.incarnation)
        self.resume(start, list(of_it))
        for message in kept:
            self._sent.take(message)

    def answer_submaps(self, request: bytes) -> list[bytes]:
        """The answer to `SubmapsRequest`: all that was sent, of an earlier life too."""
        wanted = decoded(request, m.SubmapsRequest)
        if wanted.robot != self.robot:
            return []
        return [encoded(message) for message in self._sent.wanted(wanted)]

    def resume(self, start: m.InitialPose, submaps: Sequence[m.Submap]) -> None:
        """Go on after the last of this robot's own submaps, as an earlier life sent them.

        `submaps` are those of the latest incarnation, without a gap from sequence 0.
        """
        self._begin_incarnation(start)
        for submap in submaps:
            local = translate.local_map_of(submap)
            self._locals.append(local.named)
            closed = ClosedWindow(
                sequence=submap.sequence,
                first_measurement=submap.first_measurement,
                last_measurement=submap.last_measurement,
                start_ns=submap.start_ns,
                end_ns=submap.stamp_ns,
                local=local,
            )
            self._closed.append(closed)
            self._submap_estimator.resume(closed)
        last = submaps[-1]
        self._ledger["in a submap"] = self._consumed = last.last_measurement + 1
        self._pace.acknowledged = len(submaps)
        self._now_ns = self._passed_ns = last.stamp_ns
        self._judge = StreamJudge(self.config.bounds, last.stamp_ns)
        self._inbox.resume(last.incarnation, last.last_measurement + 1)

    def refusal(self, message: m.Message) -> str | None:
        """Why a message can not be true of this robot: another's, an absurd count, an early end."""
        refused = absurd(message)
        if refused is not None:
            return refused
        match message:
            case m.Measurement():
                own = message.robot == self.robot
                return self._inbox.refusal(message) if own else f"a measurement of {message.robot}"
            case m.Progress() if message.incarnation == self._incarnation:
                if message.submaps > self.submaps + AHEAD:
                    return f"acknowledges {message.submaps} submaps of {self.submaps}"
            case m.End():
                return self._inbox.contradicts(message, self.robot)
            case m.StreamHead() if message.robot != self.robot:
                return f"how far {message.robot} is"
            case m.StreamHead() if message.state == "ended":
                return self._inbox.contradicts(_end_at(message), self.robot)
            case _:
                pass
        return None

    def handle(self, message: m.Message, now_ns: int) -> list[Outgoing]:
        """Take one message; `now_ns` is the team time of its arrival (unused: stamps are time)."""
        return self._sound(self._handled(message))

    def _sound(self, out: Sequence[Outgoing]) -> list[Outgoing]:
        """What every receiver takes; the rest is withheld and named."""
        sound = []
        for each in out:
            why = unsound(each.message)
            if why is None:
                sound.append(each)
            else:
                self.withheld += 1
                self.warnings.append(f"withheld: {each.key}, {why}")
        return sound

    def _handled(self, message: m.Message) -> list[Outgoing]:
        match message:
            case m.Measurement():
                self._inbox.put(message)
            case m.Prior():
                self._take_prior(message)
            case m.KnownMap():
                self._take_known(message)
            case m.FusedMap():
                return self._take_fused(message) + self._go_on()
            case m.Progress():
                if message.incarnation == self._incarnation:
                    acknowledged = max(self._pace.acknowledged, message.submaps)
                    self._pace.acknowledged = acknowledged
            case m.Rendezvous():
                return self._met(message) + self._go_on()
            case m.Withdrawal():
                return self._kept(message) + self._go_on()
            case _:
                self._hear(message)
        return self._go_on()

    def _hear(self, message: m.Message) -> None:
        """Who is there, and where the stream ends."""
        match message:
            case m.Liveliness() if message.node == ch.source_node(self.robot):
                self._driver_is_there = message.alive
            case m.Liveliness():
                if message.node == "central":
                    self._pace.centre_alive = message.alive
            case m.End():
                self._take_end(message)
            case m.StreamHead():
                self._take_head(message)
            case m.TeamEnd():
                self._is_to_end = True
            case _:
                self.warnings.append(f"no use for a {type(message).__name__}")

    def window_closed(self, closed: ClosedWindow) -> None:
        """A window has become a submap: what else is made of it is not the robot's task."""

    def status(self) -> m.Status:
        """What the robot is doing, for people."""
        figures = {
            "steps": float(self.steps),
            "measurements": float(self._inbox.next_measurement),
            "submaps": float(self.submaps),
            "particles": float(self.config.front_end.particles),
            "landmarks": float(len(self._estimator.own_map().ids)),
            "pose_sigma_m": self._pose_sigma,
            "withheld": float(self.withheld),
        }
        nis = self._estimator.innovation
        if self._held.waits:
            figures["held_submaps"] = float(self._held.submaps)
        if nis.per_dof is not None:
            figures |= {"nis_per_dof": nis.per_dof, "nis_dof": float(nis.dof)}
        if self._prior is not None:
            figures["landmarks_refused"] = float(self._team_map.refused)
        if self.config.front_end.garbage:
            figures["gated"] = float(self._gated)
        state = "done" if self._done else "mapping" if self._inbox.next_measurement else "waiting"
        node = ch.robot_node(self.robot)
        waiting = ("no measurements of this team yet",) if state == "waiting" else ()
        if self.waits_for_driver and not self._done:
            waiting = (
                f"its driver is away after measurement {self._inbox.next_measurement - 1}: start "
                "it again, or end the team by `teamslam end`",
            )
        doubt = (self._team_map.doubt,) if self._team_map.doubt else ()
        warnings = (*waiting, *doubt, *self._unexpected(nis), *self.warnings[-3:])
        told = {name: value for name, value in figures.items() if abs(value) <= 1e300}
        return m.Status(
            stamp_ns=self._now_ns, node=node, state=state, figures=told, warnings=warnings
        )

    def _unexpected(self, nis: Innovation) -> tuple[str, ...]:
        """Says that measurements lie far from their predictions, and what to configure then."""
        ratio = nis.per_dof
        if ratio is None or ratio < UNEXPECTED or nis.dof < UNEXPECTED_DOF:
            return ()
        share = self.config.front_end.garbage
        remedy = (
            f"is front_end.garbage = {share:g} too few, or the sensor's noise too small?"
            if share
            else "outliers, or noise that is larger than the sensor's sigmas? Outliers need "
            "front_end.garbage (their share), central.robust_c = 2, central.landmark_submaps = 2"
        )
        return (
            f"measurements lie far from their predictions, NIS {ratio:.0f} per degree of freedom "
            f"(1 is right): {remedy}",
        )

    def set_aside(self, message: m.Message, why: str) -> list[Outgoing]:
        """Go on behind a measurement whose handling raised, as if it had never been there.

        An estimator of submaps is put back: to its last submap, and the window's other
        measurements. One that raises as it closes its last window says `Done` without it.
        """
        if self._taking is not None:
            self._taking = None
            self._ledger[Rejection.SET_ASIDE.disposition] += 1
            self._aside += 1
            if self._consumer == "submap" and self._start and self._aside <= MOST_SET_ASIDE:
                self._put_back(self._start)
        if self._done and not self._said_done:
            self._pending += self._last_words()
        return self._sound(self._go_on())

    def _put_back(self, start: m.InitialPose) -> None:
        self._begin_estimator(start.incarnation, self._believed(start))
        self._goes_in(start)
        for closed in self._closed:
            self._submap_estimator.resume(closed)
        self._judge = StreamJudge(
            self.config.bounds, self._closed[-1].end_ns if self._closed else None
        )
        for measurement in self._window:
            self._goes_in(measurement)
            match measurement:
                case m.Odometry() | m.Increment() | m.Steering():
                    self._go(measurement)
                case m.Observations() | m.Points() | m.Detections():
                    self._look(measurement)
                case m.Sightings():
                    self._see(measurement)
                case _:
                    pass

    # The stream.

    _pose_sigma = 0.0
    _gated = 0

    def _go_on(self) -> list[Outgoing]:
        """Take the measurements whose turn has come; what there is to say is kept until it is
        said.
        """
        measurements = self._inbox.taken()
        while not self._blocked:
            measurement = next(measurements, None)
            if measurement is None:
                break
            self._pending += self._take(measurement)
        self._end_without_driver()
        if not self._done and not self._blocked and self._complete:
            self._pending += self._finish()
        self._pending += self._credit()
        out, self._pending = self._pending, []
        return out

    @property
    def _blocked(self) -> bool:
        """Waits for a map that it is to be told, or for the centre: its answer or its credit."""
        return self._known is None or self._pace.holds(self.submaps)

    def _credit(self) -> list[Outgoing]:
        """A robot that waits for an exchange still reports what it has received."""
        waits = self._pace.lockstep and self._blocked
        if waits and self._pace.owes(self._inbox.received, self._consumed):
            return [self._progress()]
        return []

    @property
    def _complete(self) -> bool:
        return self._end is not None and self._inbox.complete(self._end)

    def _take(self, measurement: m.Measurement) -> list[Outgoing]:
        out: list[Outgoing] = []
        if isinstance(measurement, m.InitialPose):
            out += self._leave_incarnation()
            self._begin_incarnation(measurement)
        self._taking = measurement
        self._consumed = measurement.number + 1
        stamp_ns = self._team_time(measurement)
        self._now_ns = max(self._now_ns, stamp_ns)
        # What was seen at a stamp comes before the odometry that ends there, and may end a window.
        ahead = 0 if isinstance(measurement, m.AnyOdometry) else 1
        self._passed_ns = max(self._passed_ns, stamp_ns - ahead)
        match measurement:
            case m.InitialPose():
                self._ledger["start pose"] += 1
            case m.Odometry() | m.Increment() | m.Steering():
                out += self._drive(measurement)
            case m.Observations() | m.Points() | m.Detections():
                self._observe(measurement)
            case m.Sightings():
                out += self._sight(measurement)
        if self._taking is not None:
            self._taken(measurement)
        if self._pace.counted():
            out.append(self._progress())
        return out

    def _taken(self, measurement: m.Measurement) -> None:
        """The open window has the measurement."""
        self._taking = None
        if self._consumer == "submap":
            self._window.append(measurement)

    def _team_time(self, measurement: m.Measurement) -> int:
        """The measurement's stamp; the odometry's put right."""
        if isinstance(measurement, m.AnyOdometry):
            return translate.end_of(measurement, self.config.clock_offset_s)
        return measurement.stamp_ns

    def _begin_incarnation(self, start: m.InitialPose) -> None:
        initial = self._believed(start)
        self._judge = StreamJudge(self.config.bounds)
        self._begin_estimator(start.incarnation, initial)
        self._goes_in(start)
        self._sent.take(start)
        self._locals = []
        self._start, self._closed, self._window, self._aside = start, [], [], 0
        self._last_map = -1
        self._ledger = Counter()
        self._incarnation, self._consumed, self._steps = start.incarnation, 0, 0
        self._pace.begin_incarnation()
        if self._prior is not None and self._prior.incarnation < start.incarnation:
            self._prior = None
        self._now_ns = max(self._now_ns, start.stamp_ns)
        self._passed_ns = start.stamp_ns - 1

    def _begin_estimator(self, incarnation: int, initial: InitialPose) -> None:
        known = self._known or NOTHING_KNOWN
        estimator = estimator_of(self.config, incarnation, initial, known)
        self._estimator = estimator
        self._windows = estimator if isinstance(estimator, MakesSubmaps) else None

    @property
    def _submap_estimator(self) -> MakesSubmaps:
        """The estimator, which is to go on from a submap; raises ValueError where it has none."""
        if self._windows is None:
            raise ValueError(f"the estimator {self.config.estimator} has no submaps to resume from")
        return self._windows

    def _goes_in(self, measurement: m.Measurement) -> None:
        """The open window, if there is one, names the measurement among its inputs."""
        if self._windows is not None:
            self._windows.consumed(measurement.number)

    def _believed(self, start: m.InitialPose) -> InitialPose:
        """The initial pose and its covariance; one beyond the bounds is taken as unknown."""
        value = translate.start_of(start)
        why = None if value is None else start_beyond(value, self.config.bounds)
        if why is not None:
            self.warnings.append(f"the initial pose is refused, taken as unknown: {why}")
            return InitialPose(None, None)
        return InitialPose(*translate.pose_of(start))

    def _sensible(self, known: KnownMap) -> KnownMap:
        """A known map without the landmarks beyond the bounds."""
        inside = np.abs(known.landmarks).max(axis=1, initial=0.0) <= self.config.bounds.coordinate_m
        if not inside.all():
            self.warnings.append(f"{np.count_nonzero(~inside)} known landmarks beyond the bounds")
        return KnownMap(known.ids[inside], known.landmarks[inside])

    def _observe(self, measurement: m.AnyScan | m.Detections) -> None:
        self._goes_in(measurement)
        reason = self._look(measurement)
        self._ledger[self._estimator.used if reason is None else reason.disposition] += 1

    def _sight(self, measurement: m.Sightings) -> list[Outgoing]:
        self._goes_in(measurement)
        reason = self._see(measurement)
        if reason is None:
            self._sighted.add(measurement.number)
        self._ledger[IN_SIGHTING if reason is None else reason.disposition] += 1
        return self._release(measurement.teammates)

    def _drive(self, measurement: m.AnyOdometry) -> list[Outgoing]:
        self._steps += 1
        self.steps += 1
        self._goes_in(measurement)
        driven = self._go(measurement)
        if driven.closed is None:
            self._used(measurement)
        return self._told(driven)

    # A measurement within the bounds goes to the estimator; of one beyond them the reason is said.

    def _look(self, measurement: m.AnyScan | m.Detections) -> Rejection | None:
        if isinstance(measurement, m.Detections) and not self._associates:
            return Rejection.NO_ASSOCIATION
        scan = translate.scan_of(measurement)
        near = self._judge.near(scan.ranges) & sensible(scan.own, scan.ranges, self.config.bounds)
        reason = self._judge.time(measurement.stamp_ns)
        if reason is None and len(near) and not near.any():
            reason = Rejection.RANGE
        if reason is None:
            reason = self._estimator.observe(measurement.stamp_ns, scan.only(near))
        return reason

    def _see(self, measurement: m.Sightings) -> Rejection | None:
        teammates, ranges, bearings = translate.looks_of(measurement)
        others = np.array([name != self.robot for name in teammates], dtype=np.bool_)
        near = self._judge.near(ranges) & others
        reason = self._judge.time(measurement.stamp_ns)
        if reason is None and len(near) and not near.any():
            reason = Rejection.RANGE if others.any() else Rejection.ITSELF
        if reason is None:
            seen = tuple(name for name, is_near in zip(teammates, near, strict=True) if is_near)
            looks = seen, ranges[near], bearings[near]
            windows = self._windows
            reason = (
                Rejection.NO_TEAMMATES
                if windows is None
                else windows.sight(measurement.stamp_ns, measurement.number, looks)
            )
        return reason

    def _go(self, measurement: m.AnyOdometry) -> Estimates:
        motion = translate.motion_of(measurement, self.config)
        self._unused = self._judge.odometry(*motion)
        if self._unused not in UNMEASURED:
            return NOTHING_NEW
        return self._estimator.drive(*motion, measured=self._unused is None)

    @property
    def _associates(self) -> bool:
        """Whether detections without identities are of use: only `join` knows what to do then."""
        return isinstance(self._estimator, Associates) and self.config.fusion == "join"

    # What goes out.

    @property
    def _speaker(self) -> Speaker:
        return Speaker(self.robot, self._incarnation, self._announcement.digest)

    def _used(self, measurement: m.Measurement) -> None:
        """The ledger has an interval of odometry; it is used, or rejected with its reason."""
        unused = self._unused
        self._ledger[self._estimator.used if unused is None else unused.disposition] += 1
        self._taken(measurement)

    def _told(self, driven: Estimates) -> list[Outgoing]:
        """What there is to say of what the estimator has given."""
        if driven.closed is not None:
            cloud = self._speaker.cloud(driven.closed.end_ns, driven.cloud)
            return [*cloud, *self._send(driven.closed)]
        out = self._poses(driven.pose_ns)
        if driven.judged is not None:
            judged, stamp_ns = driven.judged
            out.append(self._speaker.innovation(stamp_ns, self._estimator.sequence, judged))
        if driven.map_ns is None:
            return out
        out += self._speaker.cloud(driven.map_ns, driven.cloud)
        return out + self._mapped(driven.map_ns)

    def _send(self, closed: ClosedWindow) -> list[Outgoing]:
        """Send a submap; it is among what is to be said before anything else of it can raise."""
        said = [self._speaker.sighting(closed, each) for each in closed.sightings]
        said.append(self._speaker.submap(closed))
        if self._taking is not None:
            self._used(self._taking)
        self._sighted_in(closed)
        if closed.late:
            self._ledger[self._estimator.used] -= closed.late
            self._ledger[Rejection.LATE.disposition] += closed.late
        for count, reason in (
            (closed.unconfirmed, Rejection.UNCONFIRMED),
            (closed.clutter, Rejection.CLUTTER),
        ):
            if count:
                self._ledger[self._estimator.used] -= count
                self._ledger[reason.disposition] += count
        self.warnings += [_slipped(slip) for slip in closed.slips]
        self._locals.append(closed.local.named)
        self._judge = StreamJudge(self.config.bounds, closed.end_ns)
        if closed.unsolved:
            self._ledger[self._estimator.used] -= closed.unsolved
            self._ledger[Rejection.UNSOLVED.disposition] += closed.unsolved
        plain = ClosedWindow(
            sequence=closed.sequence,
            first_measurement=closed.first_measurement,
            last_measurement=closed.last_measurement,
            start_ns=closed.start_ns,
            end_ns=closed.end_ns,
            local=closed.local,
        )
        self._closed.append(plain)
        self.window_closed(closed)
        self._window, self._aside = [], 0
        released = self._held.put(said)
        self._sent.note(released)
        self._pending += released
        out = [self._speaker.innovation(closed.end_ns, closed.sequence, closed.innovation)]
        out += self._speaker.association(closed)
        self._gated += closed.gated
        out += self._poses(closed.end_ns)
        out += self._mapped(closed.end_ns)
        return [*out, self._progress()]

    def _met(self, rendezvous: m.Rendezvous) -> list[Outgoing]:
        """A teammate sends what it holds: who is seen by it does so too."""
        return self._release(()) if self.robot in rendezvous.teammates else []

    def _kept(self, order: m.Withdrawal) -> list[Outgoing]:
        """Repeat it once, so that a centre that is started again hears of it."""
        if order.robot in self._withdrawn:
            return []
        self._withdrawn.add(order.robot)
        heard = m.WithdrawalHeard(
            stamp_ns=order.stamp_ns,
            robot=self.robot,
            withdrawn=order.robot,
            by=order.by,
            reason=order.reason,
        )
        return [Outgoing(ch.WITHDRAWALS_HEARD, self.robot, heard)]

    def _release(self, seen: tuple[str, ...]) -> list[Outgoing]:
        """Send what is held; `seen`: who is to do so too."""
        ended_ns, submaps = self._held.ended_ns(), self._held.submaps
        waited_s = 0.0 if ended_ns is None else max(0.0, 1e-9 * (self._now_ns - ended_ns))
        if not self._held.waits or not (submaps or set(seen) - self._held.greeted):
            return []
        self._held.greeted.update(seen)
        told = m.Rendezvous(
            stamp_ns=self._now_ns,
            robot=self.robot,
            incarnation=self._incarnation,
            teammates=seen,
            submaps=submaps,
            waited_s=waited_s,
        )
        out = [Outgoing(ch.RENDEZVOUS, self.robot, told), *self._held.released()]
        self._sent.note(out)
        return [*out, self._progress()]

    def _sighted_in(self, closed: ClosedWindow | None) -> None:
        """What becomes of the sightings of a window that ends and that reached no node."""
        used = set[int]()
        if closed is not None:
            used = used.union(*(each.measurements for each in closed.sightings))
        lost = len(self._sighted - used)
        if lost:
            self._ledger[IN_SIGHTING] -= lost
            self._ledger[Rejection.NO_NODE.disposition] += lost
        self._sighted.clear()

    def _mapped(self, stamp_ns: int) -> list[Outgoing]:
        """A new running map: for viewers, or what the rule consumes, when an exchange is due."""
        self._map_ns = stamp_ns
        if self._consumer != "own/map":
            return [self._own_map(stamp_ns)]
        since = None if self._exchange_ns is None else stamp_ns - self._exchange_ns
        if since is not None and since < self.config.exchange_s * 1e9:
            return []
        return self._exchange_map(stamp_ns)

    def _exchange_map(self, stamp_ns: int) -> list[Outgoing]:
        self._exchange_ns = stamp_ns
        self._last_map = self._estimator.sequence
        if self._pace.lockstep:
            self._pace.sent_map()
        return [self._own_map(stamp_ns)]

    def _own_map(self, stamp_ns: int) -> Outgoing:
        landmarks = self._estimator.own_map()
        joint = self._consumer == "own/map" and self._estimator.joint
        if joint and len(landmarks.ids) > JOINT_LANDMARKS:
            joint = False
            self.warnings.append("the own map is too large for a joint covariance")
        return self._speaker.own_map(
            stamp_ns,
            self._estimator.sequence,
            self._pace.awaited,
            landmarks,
            "joint" if joint else "blocks",
        )

    def _poses(self, stamp_ns: int | None) -> list[Outgoing]:
        """The running poses: from own measurements, and given the fused map."""
        if stamp_ns is None or (
            self._pose_ns is not None and stamp_ns - self._pose_ns < self.config.pose_s * 1e9
        ):
            return []
        self._pose_ns = stamp_ns
        own = self._estimator.own_pose()
        out = [self._pose(ch.OWN_POSE, stamp_ns, translate.NO_MAP, own)]
        prior = self._prior
        if prior is None or prior.incarnation != self._incarnation:
            return out
        window = None if self._windows is None else self._windows.open_window()
        try:
            with np.errstate(all="ignore"):  # what is no number is withheld
                posed = self._team_map.pose(prior, self._locals, window).pose
        except (NotACovarianceError, NotDeterminedError, np.linalg.LinAlgError) as error:
            self.warnings.append(f"no team pose from the fused map: {error}")
            return out
        self._pose_sigma = max(float(posed[1][0, 0] + posed[1][1, 1]), 0.0) ** 0.5
        return [*out, self._pose(ch.TEAM_POSE, stamp_ns, prior.digest, posed)]

    def _pose(
        self,
        channel: ch.Channel,
        stamp_ns: int,
        digest: bytes,
        pose: tuple[np.ndarray, np.ndarray],
    ) -> Outgoing:
        return self._speaker.pose(channel, stamp_ns, self._estimator.sequence, digest, pose)

    def _progress(self) -> Outgoing:
        self._pace.unreported = 0
        return Outgoing(
            ch.ROBOT_PROGRESS,
            self.robot,
            m.Progress(
                stamp_ns=self._passed_ns if self._held.since_ns is None else self._held.since_ns,
                node=ch.robot_node(self.robot),
                robot=self.robot,
                incarnation=self._incarnation,
                measurements=max(self._consumed, self._pace.credited),
                submaps=self.submaps,
            ),
        )

    # What comes back.

    def _take_fused(self, fused: m.FusedMap) -> list[Outgoing]:
        if fused.final:
            self.finished, self.final = True, fused
            return []
        if self._pace.answered(fused.exchange):
            estimator: object = self._estimator
            if not isinstance(estimator, AbsorbsMaps):
                raise ValueError(f"the estimator {self.config.estimator} absorbs no map")
            ids, means = translate.landmarks_of(fused)
            joint = translate.landmark_covariance_of(fused)
            try:
                estimator.absorb(LandmarkGaussian(ids, means, joint))
            except (NotACovarianceError, np.linalg.LinAlgError) as error:
                self.warnings.append(f"the fused map can not be absorbed: {error}")
        return []

    def _take_prior(self, prior: m.Prior) -> None:
        if not is_newer_prior(prior, self._prior):
            return
        whole = translate.prior_of(prior).whole
        why = prior_beyond(whole.mean, whole.covariance, self.config.bounds)
        if why is None:
            self._prior = prior
        else:
            self.warnings.append(f"the team's map is refused: {why}")

    def _take_known(self, told: m.KnownMap) -> None:
        """The newer one by its stamp; an equal one again changes nothing."""
        if self._known_ns is None or told.stamp_ns > self._known_ns:
            self._known_ns = told.stamp_ns
            self._known = self._sensible(KnownMap(*translate.landmarks_of(told)))

    # The end.

    def _take_end(self, end: m.End) -> None:
        self._world_end = end = later_end(end, self._world_end)
        mine = [s for s in end.streams if s.robot == self.robot]
        self._end = (
            mine[0]
            if mine
            else m.StreamEnd(robot=self.robot, incarnation=self.incarnation, measurements=0)
        )

    def _take_head(self, head: m.StreamHead) -> None:
        """A driver's stream ends when it says so, unless a later incarnation begins after that."""
        self._head = head = later_head(head, self._head)
        if head.state == "ended":
            self._take_end(_end_at(head))
        elif self._end is not None and head.incarnation > self._end.incarnation:
            self._end = None
        if head.state != "open":
            self._pending.append(Outgoing(ch.ROBOT_HEAD, self.robot, head))
        if self._consumed:
            self._pending.append(self._progress())

    def _end_without_driver(self) -> None:
        """A live team is to end and the driver is not there: the stream ends where it has come."""
        if self._is_to_end and self._end is None and not self._driver_is_there:
            self._end = m.StreamEnd(
                robot=self.robot, incarnation=self.incarnation, measurements=self._inbox.received
            )

    def _close_incarnation(self) -> list[Outgoing]:
        driven, uncovered = self._estimator.finish()
        out = self._told(driven)
        if driven.closed is None:
            self._sighted_in(None)
        if uncovered:
            self._ledger[self._estimator.used] -= uncovered
            self._ledger[Rejection.NOT_COVERED.disposition] += uncovered
        return out

    def _leave_incarnation(self) -> list[Outgoing]:
        """A later incarnation begins: close what is open of this one, if there is one."""
        if not self._consumed:
            return []
        self._passed_ns = self._now_ns
        if self._done:  # the driver had ended, and has come back: its last word is not the last
            self._done = self._said_done = False
            self._ended.append(self._incarnation_done())
            return []
        out = self._close_incarnation()
        out += self._release(())
        self._ended.append(self._incarnation_done())
        return [*out, self._progress()]

    def _finish(self) -> list[Outgoing]:
        """The last incarnation's `Done` goes first: with it the centre may conclude."""
        self._done = True
        self._passed_ns = self._now_ns
        out = self._close_incarnation()
        exchanged = self._consumer != "own/map" or self._map_ns == self._exchange_ns
        if self._map_ns is not None and not exchanged:
            out += self._exchange_map(self._map_ns)
        return out + self._last_words()

    def _last_words(self) -> list[Outgoing]:
        out = self._release(())
        dones = [self._incarnation_done(), *self._ended]
        self._said_done = True
        return [*out, self._progress(), *(Outgoing(ch.ROBOT_DONE, self.robot, d) for d in dones)]

    def _incarnation_done(self) -> m.Done:
        return m.Done(
            stamp_ns=self._now_ns,
            robot=self.robot,
            incarnation=self._incarnation,
            measurements=self._consumed,
            steps=self._steps,
            submaps=self.submaps,
            ledger=tuple(
                m.Disposition(disposition=k, measurements=n)
                for k, n in sorted(self._ledger.items())
                if n
            ),
            last_map=self._last_map,
        )


def _end_at(head: m.StreamHead) -> m.End:
    """The end of one robot's stream, as a world would say it."""
    last = m.StreamEnd(
        robot=head.robot, incarnation=head.incarnation, measurements=head.measurements
    )
    return m.End(stamp_ns=head.stamp_ns, streams=(last,))


def _slipped(slip: Slipped) -> str:
    """A slip of the odometry in words."""
    metres, turn = float(np.hypot(*slip.by[:2])), float(np.degrees(slip.by[2]))
    return (
        f"the odometry slipped by {metres:.2f} m, {turn:.0f}° before {slip.stamp_ns * 1e-9:.2f} s"
    )
