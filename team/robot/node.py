"""The robot's node: messages in, messages out; no I/O, no clock.

Law 1 lives here: what is published for fusion (`submap`) depends on the robot's own readings alone.
The fused map comes in as a prior and goes out as `team/pose`, and nowhere else. Only a rule with
feedback (`kalman`, `kalman-per-axis`, `covariance-intersection`) absorbs the fused map into the map
that the robot publishes; such a robot waits for the answer of each exchange before it goes on.
"""

from collections import Counter
from collections.abc import Sequence

import numpy as np

from team import translate
from team.config import RobotConfig
from team.estimation.conditioning import RobotPrior, team_pose
from team.estimation.gaussian import NotACovarianceError
from team.estimation.sighting import Sighting
from team.estimation.submap import LocalMap
from team.estimation.whole_map import absorbed
from team.robot.inbox import Inbox
from team.robot.member import ClosedWindow, HybridMember
from team.robot.pose_grid import NO_NODE
from team.robot.thesis_member import ThesisMember
from team.wire import channels as ch
from team.wire import messages as m
from team.wire.arrays import from_floats, from_ids
from team.wire.bus import Outgoing

CREDIT_SUBMAPS = 4
"""A robot is at most this many submaps ahead of a living centre."""
IN_SIGHTING = "in a sighting factor"
"""The disposition of a reading of teammates that was used."""
PROGRESS_READINGS = 64
"""A robot reports its progress at least once per this many readings."""


class RobotNode:
    """One robot: `begin`, then `handle` for every message, until `finished`."""

    listens = (*ch.SENSORS, ch.END, ch.PRIOR, ch.FUSED_MAP, ch.FINAL_MAP, ch.CENTRAL_PROGRESS)

    def __init__(self, config: RobotConfig) -> None:
        self.config = config
        self.robot = config.id
        self._inbox = Inbox()
        self._announcement = translate.configured(ch.robot_node(config.id), 0, 0, config)
        self._hybrid = HybridMember(config, 0)
        self._thesis = ThesisMember(config, 0)
        self._locals: list[LocalMap] = []
        self._prior: m.Prior | None = None
        self._epoch = 0
        self._consumed = 0
        self._steps = 0
        self._ledger: Counter[str] = Counter()
        self._sighted: set[int] = set()
        self._ended: list[m.Done] = []
        self._end: m.StreamEnd | None = None
        self._centre_alive: bool | None = None
        self._acknowledged = 0
        self._credited = 0
        self._exchange = 0
        self._awaited = 0
        self._exchange_ns: int | None = None
        self._map_ns: int | None = None
        self._pose_ns: int | None = None
        self._reported = 0
        self._now_ns = 0
        self._passed_ns = 0
        self._done = False
        self.steps = 0
        self.finished = False
        self.warnings: list[str] = []

    # What the shell asks.

    @property
    def epoch(self) -> int:
        """The epoch of the stream that is being consumed."""
        return self._inbox.epoch

    @property
    def next_reading(self) -> int:
        """The counter of the reading that is consumed next."""
        return self._inbox.next_reading

    @property
    def submaps(self) -> int:
        """How many submaps of this epoch have been sent, in this life or an earlier one."""
        return len(self._locals)

    def wanted(self) -> m.ReadingsWanted | None:
        """The readings that are missing and must be asked for at their source."""
        gap = self._inbox.gap
        if gap is not None:
            return self._wanted(*gap)
        end = self._end
        if end is None or self._complete or self._inbox.waiting or end.epoch < self.epoch:
            return None
        first = self._inbox.next_reading if end.epoch == self.epoch else 0
        return self._wanted(end.epoch, first, end.readings - 1)

    def _wanted(self, epoch: int, first: int, last: int) -> m.ReadingsWanted:
        return m.ReadingsWanted(self._now_ns, self.robot, epoch, first, last)

    def begin(self) -> list[Outgoing]:
        """What the node says first: its configuration."""
        return [Outgoing(ch.ROBOT_CONFIG, self.robot, self._announcement)]

    def resume(self, start: m.Start, submaps: Sequence[m.Submap]) -> None:
        """Go on after the last of this robot's own submaps, as an earlier life sent them.

        `submaps` are those of the latest epoch, without a gap from sequence 0.
        """
        self._begin_epoch(start)
        for submap in submaps:
            local = translate.local_map_of(submap)
            self._locals.append(local)
            self._hybrid.resume(
                ClosedWindow(
                    submap.sequence,
                    submap.first_reading,
                    submap.last_reading,
                    submap.start_ns,
                    submap.stamp_ns,
                    local,
                )
            )
        last = submaps[-1]
        self._ledger["in a submap"] = self._consumed = last.last_reading + 1
        self._acknowledged = len(submaps)
        self._now_ns = self._passed_ns = last.stamp_ns
        self._inbox.resume(last.epoch, last.last_reading + 1)

    def handle(self, message: m.Message, now_ns: int) -> list[Outgoing]:
        """Take one message; `now_ns` is the team time of its arrival (unused: stamps are time)."""
        match message:
            case m.Reading():
                self._inbox.put(message)
            case m.Prior():
                self._prior = message
            case m.FusedMap():
                return self._take_fused(message) + self._go_on()
            case m.Progress():
                if message.epoch == self._epoch:
                    self._acknowledged = max(self._acknowledged, message.submaps)
            case m.Liveliness():
                if message.node == "central":
                    self._centre_alive = message.alive
            case m.End():
                self._take_end(message)
            case _:
                self.warnings.append(f"no use for a {type(message).__name__}")
        return self._go_on()

    def status(self) -> m.Status:
        """What the robot is doing, for people."""
        figures = {
            "steps": float(self.steps),
            "readings": float(self._inbox.next_reading),
            "submaps": float(self.submaps),
            "particles": float(self.config.front_end.particles),
            "landmarks": float(len(self._own_landmarks()[0])),
            "pose_sigma_m": self._pose_sigma,
        }
        nis = self._hybrid.innovation
        if nis.per_dof is not None:
            figures |= {"nis_per_dof": nis.per_dof, "nis_dof": float(nis.dof)}
        state = "done" if self._done else "mapping" if self._inbox.next_reading else "waiting"
        node = ch.robot_node(self.robot)
        waiting = ("no readings of this team yet",) if state == "waiting" else ()
        warnings = (*waiting, *self.warnings[-3:])
        return m.Status(self._now_ns, node, state, figures, warnings)

    # The stream.

    _pose_sigma = 0.0

    def _go_on(self) -> list[Outgoing]:
        out: list[Outgoing] = []
        readings = self._inbox.taken()
        while not self._blocked:
            reading = next(readings, None)
            if reading is None:
                break
            out += self._take(reading)
        if not self._done and not self._blocked and self._complete:
            out += self._finish()
        return out + self._credit()

    @property
    def _blocked(self) -> bool:
        """Waits for the centre: for its answer under a rule with feedback, else for its credit.

        A centre that was never heard of gives no credit, but may still answer: lockstep does not
        depend on whose token arrives first.
        """
        if self._feedback:
            return self._awaited > self._exchange and self._centre_alive is not False
        return bool(self._centre_alive) and self.submaps - self._acknowledged > CREDIT_SUBMAPS

    def _credit(self) -> list[Outgoing]:
        """A robot that waits for an exchange reports what it has received, not what it has used.

        Else the world would wait for it, and with the world whoever it waits for: a teammate that
        needs more readings for its map, or the end.
        """
        if not (self._feedback and self._blocked):
            return []
        if self._inbox.received - max(self._credited, self._consumed) < PROGRESS_READINGS:
            return []
        self._credited = self._inbox.received
        return [self._progress()]

    @property
    def _complete(self) -> bool:
        end = self._end
        return end is not None and (
            end.readings == 0
            or (self._inbox.epoch == end.epoch and self._inbox.next_reading >= end.readings)
        )

    def _take(self, reading: m.Reading) -> list[Outgoing]:
        out: list[Outgoing] = []
        if isinstance(reading, m.Start):
            out += self._leave_epoch()
            self._begin_epoch(reading)
        self._consumed = reading.reading + 1
        self._now_ns = max(self._now_ns, reading.stamp_ns)
        # What was seen at a stamp comes before the odometry that ends there, and may end a window.
        ahead = 0 if isinstance(reading, m.Odometry) else 1
        self._passed_ns = max(self._passed_ns, reading.stamp_ns - ahead)
        match reading:
            case m.Start():
                self._ledger["start pose"] += 1
            case m.Odometry():
                out += self._drive(reading)
            case m.Observations():
                self._observe(reading)
            case m.Sightings():
                self._sight(reading)
        self._reported += 1
        if self._reported >= PROGRESS_READINGS:
            out.append(self._progress())
        return out

    def _begin_epoch(self, start: m.Start) -> None:
        pose, covariance = translate.pose_of(start)
        self._hybrid = HybridMember(self.config, start.epoch)
        self._hybrid.start(pose, covariance)
        self._hybrid.consumed(start.reading)
        self._thesis = ThesisMember(self.config, start.epoch)
        self._thesis.start(pose)
        self._locals = []
        self._ledger = Counter()
        self._epoch, self._consumed, self._steps = start.epoch, 0, 0
        self._acknowledged = self._credited = 0
        self._prior = None
        self._now_ns = max(self._now_ns, start.stamp_ns)
        self._passed_ns = start.stamp_ns - 1

    def _observe(self, reading: m.Observations) -> None:
        member = self._thesis if self._thesis_rule else self._hybrid
        self._hybrid.consumed(reading.reading)
        reason = member.observe(reading.stamp_ns, translate.scan_of(reading))
        self._ledger[self._used if reason is None else f"rejected: {reason}"] += 1

    def _sight(self, reading: m.Sightings) -> None:
        self._hybrid.consumed(reading.reading)
        looks = translate.looks_of(reading)
        reason = self._hybrid.sight(reading.stamp_ns, reading.reading, looks)
        if reason is None:
            self._sighted.add(reading.reading)
        self._ledger[IN_SIGHTING if reason is None else f"rejected: {reason}"] += 1

    def _drive(self, reading: m.Odometry) -> list[Outgoing]:
        self._steps += 1
        self.steps += 1
        if reading.duration_ns == 0:
            self._hybrid.consumed(reading.reading)
            self._ledger["rejected: odometry over no time"] += 1
            return []
        self._ledger[self._used] += 1
        motion = (reading.stamp_ns, reading.duration_ns, reading.forward, reading.yaw_rate)
        if self._thesis_rule:
            before = self._thesis.epochs
            self._thesis.drive(*motion)
            return self._after_thesis_epoch() if self._thesis.epochs > before else []
        self._hybrid.consumed(reading.reading)
        before_ns = self._hybrid.last_epoch_ns
        closed = self._hybrid.drive(*motion)
        if closed is not None:
            return self._send(closed)
        moved = self._hybrid.last_epoch_ns != before_ns
        return self._poses(self._hybrid.last_epoch_ns) if moved else []

    @property
    def _thesis_rule(self) -> bool:
        return self.config.estimator == "hybrid-thesis"

    @property
    def _feedback(self) -> bool:
        return self.config.fusion != "join"

    @property
    def _used(self) -> str:
        return "in the running map" if self._thesis_rule else "in a submap"

    # What goes out.

    def _send(self, closed: ClosedWindow) -> list[Outgoing]:
        self._locals.append(closed.local)
        out = self._sightings(closed)
        submap = translate.submap_message(
            self.robot,
            self._epoch,
            closed.sequence,
            (closed.first_reading, closed.last_reading),
            (closed.start_ns, closed.end_ns),
            self._announcement.digest,
            closed.local,
            len(closed.sightings),
        )
        out.append(Outgoing(ch.SUBMAP, self.robot, submap))
        if closed.cloud is not None:
            poses, weights = (from_floats(x) for x in closed.cloud)
            cloud = m.ParticleCloud(closed.end_ns, self.robot, poses, weights)
            out.append(Outgoing(ch.PARTICLES, self.robot, cloud))
        innovation = m.Innovation(
            closed.end_ns, self.robot, self._epoch, closed.sequence, *closed.innovation
        )
        out.append(Outgoing(ch.INNOVATION, self.robot, innovation))
        out += self._poses(closed.end_ns)
        out += self._exchanged(closed.end_ns)
        return [*out, self._progress()]

    def _sightings(self, closed: ClosedWindow | None) -> list[Outgoing]:
        """The sightings of a window that ends, and what becomes of those that reached no node."""
        found = () if closed is None else closed.sightings
        out = []
        for each in found:
            assert closed is not None
            sighting = Sighting(
                self.robot,
                self._epoch,
                closed.sequence,
                each.stamp_ns,
                each.teammate,
                each.reading,
                each.covariance,
            )
            message = translate.sighting_message(sighting, self._announcement.digest, each.readings)
            out.append(Outgoing(ch.SIGHTING_FACTOR, self.robot, message))
        lost = len(self._sighted.difference(*(each.readings for each in found)))
        if lost:
            self._ledger[IN_SIGHTING] -= lost
            self._ledger[f"rejected: {NO_NODE}"] += lost
        self._sighted.clear()
        return out

    def _exchanged(self, stamp_ns: int) -> list[Outgoing]:
        """The own map: for viewers under `join`, and the exchange itself under the other rules."""
        self._map_ns = stamp_ns
        if not self._feedback:
            return self._own_map(stamp_ns)
        since = None if self._exchange_ns is None else stamp_ns - self._exchange_ns
        if since is not None and since < self.config.exchange_s * 1e9:
            return []
        return self._exchange_map(stamp_ns)

    def _exchange_map(self, stamp_ns: int) -> list[Outgoing]:
        self._exchange_ns = stamp_ns
        self._awaited = self._exchange + 1
        return self._own_map(stamp_ns)

    def _own_map(self, stamp_ns: int) -> list[Outgoing]:
        ids, means, covariance = self._own_landmarks()
        joint = self._feedback and not self._thesis_rule
        estimate = m.MapEstimate(
            stamp_ns,
            self.robot,
            self._epoch,
            self._thesis.epochs if self._thesis_rule else self._hybrid.sequence,
            self._awaited,
            joint,
            from_ids(ids),
            from_floats(means),
            translate.joint_bytes(covariance)
            if joint
            else translate.block_bytes(translate.blocks_of(covariance)),
        )
        return [Outgoing(ch.OWN_MAP, self.robot, estimate)]

    def _own_landmarks(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        if self._thesis_rule:
            state = self._thesis.state
            joint = np.zeros((2 * len(state.ids), 2 * len(state.ids)))
            for i, block in enumerate(state.covariances):
                joint[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = block
            return state.ids, state.landmarks, joint
        whole = self._hybrid.whole
        return whole.ids, whole.mean[3:].reshape(-1, 2), whole.covariance[3:, 3:]

    def _after_thesis_epoch(self) -> list[Outgoing]:
        stamp_ns = self._thesis.last_epoch_ns
        assert stamp_ns is not None
        return self._poses(stamp_ns) + self._exchanged(stamp_ns)

    def _poses(self, stamp_ns: int | None) -> list[Outgoing]:
        """The running poses: from own readings, and given the fused map."""
        if stamp_ns is None or (
            self._pose_ns is not None and stamp_ns - self._pose_ns < self.config.pose_s * 1e9
        ):
            return []
        self._pose_ns = stamp_ns
        if self._thesis_rule:
            state = self._thesis.state
            covariance = state.pose_covariance + np.diag([1e-6, 1e-6, 1e-8])
            return self._pose(ch.OWN_POSE, stamp_ns, translate.NO_MAP, (state.pose, covariance))
        whole = self._hybrid.whole
        own = RobotPrior(whole.mean[:3], whole.ids, whole.mean[3:].reshape(-1, 2), whole.covariance)
        window = self._hybrid.open_gaussian() if self._hybrid.last_epoch_ns is not None else None
        out = self._pose(ch.OWN_POSE, stamp_ns, translate.NO_MAP, team_pose(own, (), window))
        prior = self._prior
        if prior is None or prior.epoch != self._epoch:
            return out
        pending = self._locals[max(prior.sequence + 1, 0) :]
        try:
            posed = team_pose(translate.prior_of(prior), pending, window)
        except (NotACovarianceError, np.linalg.LinAlgError) as error:
            self.warnings.append(f"no team pose from the fused map: {error}")
            return out
        self._pose_sigma = float(np.sqrt(posed[1][0, 0] + posed[1][1, 1]))
        return out + self._pose(ch.TEAM_POSE, stamp_ns, prior.digest, posed)

    def _pose(
        self,
        channel: ch.Channel,
        stamp_ns: int,
        digest: bytes,
        pose: tuple[np.ndarray, np.ndarray],
    ) -> list[Outgoing]:
        message = translate.pose_message(
            stamp_ns, self.robot, self._epoch, self._hybrid.sequence, digest, *pose
        )
        return [Outgoing(channel, self.robot, message)]

    def _progress(self) -> Outgoing:
        self._reported = 0
        return Outgoing(
            ch.ROBOT_PROGRESS,
            self.robot,
            m.Progress(
                self._passed_ns,
                ch.robot_node(self.robot),
                self.robot,
                self._epoch,
                max(self._consumed, self._credited),
                self.submaps,
            ),
        )

    # What comes back.

    def _take_fused(self, fused: m.FusedMap) -> list[Outgoing]:
        if fused.final:
            self.finished = True
            return []
        if not self._feedback or fused.exchange <= self._exchange:
            return []
        self._exchange = fused.exchange
        ids, means = translate.landmarks_of(fused)
        covariance = translate.landmark_covariance_of(fused)
        if self._thesis_rule:
            self._thesis.absorb(ids, means, translate.blocks_of(covariance))
        else:
            self._hybrid.whole = absorbed(self._hybrid.whole, ids, means, covariance)
        return []

    # The end.

    def _take_end(self, end: m.End) -> None:
        mine = [s for s in end.streams if s.robot == self.robot]
        self._end = mine[0] if mine else m.StreamEnd(self.robot, self.epoch, 0)

    def _close_epoch(self) -> list[Outgoing]:
        if self._thesis_rule:
            uncovered = self._thesis.uncovered
            out = []
        else:
            closed, uncovered = self._hybrid.finish()
            out = self._sightings(None) if closed is None else self._send(closed)
        if uncovered:
            self._ledger[self._used] -= uncovered
            self._ledger["rejected: no odometry covers it"] += uncovered
        return out

    def _leave_epoch(self) -> list[Outgoing]:
        """A later epoch begins: close what is open of this one, if there is one."""
        if not self._consumed:
            return []
        self._passed_ns = self._now_ns
        out = self._close_epoch()
        self._ended.append(self._epoch_done())
        return [*out, self._progress()]

    def _finish(self) -> list[Outgoing]:
        """The last epoch's `Done` goes first: with it the centre may conclude."""
        self._done = True
        self._passed_ns = self._now_ns
        out = self._close_epoch()
        if self._feedback and self._map_ns is not None and self._map_ns != self._exchange_ns:
            out += self._exchange_map(self._map_ns)
        dones = [self._epoch_done(), *self._ended]
        return [*out, self._progress(), *(Outgoing(ch.ROBOT_DONE, self.robot, d) for d in dones)]

    def _epoch_done(self) -> m.Done:
        return m.Done(
            self._now_ns,
            self.robot,
            self._epoch,
            self._consumed,
            self._steps,
            self.submaps,
            tuple(m.Disposed(k, n) for k, n in sorted(self._ledger.items()) if n),
        )
