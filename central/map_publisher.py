"""Decide when the centre publishes a map, and announce withdrawn robots.

A running map is *closed* where every submap up to its time has arrived, else *provisional*; the
*final* one comes at the end.
"""

import math
from bisect import bisect_right
from collections.abc import Collection, Mapping

from teamslam.central.join_messages import Tail
from teamslam.central.submap_fold import SubmapFold
from teamslam.team.store import Stream
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.bus import Outgoing

PATIENCE = 3.0
"""Broadcasts, or ticks if longer, after which a provisional map is published despite a stalled
robot.
"""


class MapPublisher:
    """Fold the closed ticks and publish the maps that are due; warnings: the newest last."""

    def __init__(self, fold: SubmapFold) -> None:
        self.fold = fold
        self.store = fold.store
        self.warnings = fold.warnings
        config = fold.config
        self._tick_ns = round(config.tick_s * 1e9)
        self._period_ns = config.broadcast_s * 1e9
        self._patience_ns = PATIENCE * 1e9 * max(config.broadcast_s, config.tick_s)
        self._published_ns: int | None = None
        self._quiet_ns: int | None = None
        self._published: Mapping[Stream, int] = {}
        self._welcomed: Collection[Stream] = ()
        self._announced: dict[str, str] = {}

    @property
    def withdrawn(self) -> tuple[str, ...]:
        """The robots withdrawn by an order or by the fold."""
        return tuple(sorted(self.store.withdrawals.keys() | self._announced.keys()))

    # Maps.

    def publish_due(self, closed_ns: float, now_ns: int) -> list[Outgoing]:
        """Fold the ticks until closed_ns; publish a map if due, or for a robot from an unknown
        pose.
        """
        self.fold.fold_until(closed_ns)
        withdrawals = self._announce_withdrawals(now_ns)
        has_landmarks = self.store.maps or self.fold.landmarks
        if has_landmarks and not self.store.newcomers <= {*self._welcomed}:
            return [*withdrawals, *self._publish_whole(closed_ns, now_ns)]
        if withdrawals or self._is_due(closed_ns, now_ns):
            return [*withdrawals, *self._publish_closed(closed_ns, now_ns)]
        if self.store.chains:
            if self._quiet_ns is None:
                self._quiet_ns = now_ns
            if now_ns - self._quiet_ns >= self._patience_ns and self._has_news(math.inf):
                return self._publish("provisional", closed_ns, now_ns)
        return []

    def publish_newest(self, closed_ns: float, now_ns: int) -> list[Outgoing]:
        """Publish a map of the whole set, if the last one lacks a submap."""
        if not self._has_news(math.inf):
            return []
        self.fold.fold_until(closed_ns)
        return self._publish_whole(closed_ns, now_ns)

    def publish_final(self, now_ns: int) -> list[Outgoing]:
        """Make the last messages, the final map last."""
        return self._publish("final", math.inf, now_ns)

    def _is_due(self, closed_ns: float, now_ns: int) -> bool:
        last_ns = self._published_ns
        if last_ns is not None and now_ns - last_ns < self._period_ns:
            return False
        return self._has_news(closed_ns)

    def _publish_closed(self, closed_ns: float, now_ns: int) -> list[Outgoing]:
        """Publish the map of the closed ticks; of the whole set if that has more submaps: a
        teammate's new submap helps at once, and no map has less than the one before it.
        """
        ticks_end_ns = closed_ns
        if math.isfinite(closed_ns):  # a tick has the submaps that end in (a, b]
            ticks_end_ns = closed_ns // self._tick_ns * self._tick_ns
        whole, left_out = self._members(ticks_end_ns), self._left_out
        published = {s: last for s, last in self._published.items() if s[0] not in left_out}
        if _lacks(whole, published) or _lacks(whole, self._members(closed_ns)):
            return self._publish_whole(closed_ns, now_ns)
        return self._publish("closed", closed_ns, now_ns, ahead=False)

    def _publish_whole(self, closed_ns: float, now_ns: int) -> list[Outgoing]:
        is_ahead = _lacks(self._members(closed_ns), self._members(math.inf))
        return self._publish("provisional" if is_ahead else "closed", closed_ns, now_ns)

    def _publish(
        self, tail: Tail, closed_ns: float, now_ns: int, *, ahead: bool = True
    ) -> list[Outgoing]:
        out = self.fold.make_map(tail, closed_ns, ahead=ahead)
        self._published_ns = self._quiet_ns = now_ns
        self._welcomed = self.store.newcomers
        for each in out:
            if isinstance(each.message, m.FusedMap):
                members = each.message.members
                self._published = {(x.robot, x.incarnation): x.sequence for x in members}
        return [*self._announce_withdrawals(now_ns), *out]

    # Version vectors.

    def _members(self, until_ns: float) -> Mapping[Stream, int]:
        left_out = self._left_out
        lasts = (
            (stream, bisect_right(chain, until_ns, key=_end_ns) - 1)
            for stream, chain in self.store.chains.items()
            if stream[0] not in left_out
        )
        return {stream: last for stream, last in lasts if last >= 0}

    def _has_news(self, until_ns: float) -> bool:
        left_out = self._left_out
        for stream, chain in self.store.chains.items():
            following = self._published.get(stream, -1) + 1
            if len(chain) <= following or stream[0] in left_out:
                continue
            if chain[following].stamp_ns <= until_ns:
                return True
        return False

    @property
    def _left_out(self) -> Collection[str]:
        return {*self.store.withdrawals, *self._announced, *self.fold.suspended}

    # Withdrawals.

    def withdraw(self, order: m.Withdrawal) -> bool:
        """Withdraw a robot by an order; return whether this is new."""
        is_new = order.robot not in self.withdrawn
        self.store.add(order)
        if is_new:
            self.warnings.append(f"{order.robot} withdrawn by {order.by}: {order.reason}")
        return is_new

    def _announce_withdrawals(self, now_ns: int) -> list[Outgoing]:
        """Publish the fold's new withdrawals; late submaps may revoke one."""
        found = self.fold.convicted
        self.warnings += [
            f"{robot} is withdrawn no more: what came late speaks for it"
            for robot in sorted(self._announced.keys() - found.keys())
        ]
        new = [robot for robot in found if robot not in self._announced]
        self._announced = dict(found)
        self.warnings += [f"{robot} withdrawn by central: {found[robot]}" for robot in new]
        return [
            Outgoing(
                ch.WITHDRAWAL,
                robot,
                m.Withdrawal(stamp_ns=now_ns, robot=robot, by="central", reason=found[robot]),
            )
            for robot in new
        ]


def _lacks(members: Mapping[Stream, int], of: Mapping[Stream, int]) -> bool:
    return any(members.get(stream, -1) < last for stream, last in of.items())


def _end_ns(submap: m.Submap) -> int:
    return submap.stamp_ns
