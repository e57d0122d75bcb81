"""Text on a running team's state: progress, warnings, unjoined robots."""

import math
import time

from teamslam.central.desk.names import in_order, not_joined
from teamslam.sim.launch.watch import DRIVERS, Watch, team_time
from teamslam.team.wire import messages as m

AHEAD_S = 10.0
"""Smallest reported lead of the world over the map [s]."""
NAMED = 5
"""Most missing robots that are named."""
PATIENCE_S = 8.0
"""Time [s] before absent nodes are reported."""


def _count_consumed(watch: Watch) -> tuple[float, float]:
    total = 0.0 if watch.world is None else watch.world.figures.get("of", 0.0)
    robots = (s for node, s in watch.statuses.items() if node.startswith("robot/"))
    taken = sum(robot.figures.get("measurements", 0.0) for robot in robots)
    return min(taken, total), total


def done(watch: Watch) -> float:
    """Share of the measurements that the robots consumed."""
    taken, total = _count_consumed(watch)
    return taken / total if total else 0.0


def is_live(watch: Watch) -> bool:
    """Whether drivers measure instead of a world."""
    return watch.world is not None and watch.world.node == DRIVERS


def warnings(watch: Watch, silent_s: float = 0.0) -> list[str]:
    """Failures and node warnings; absent nodes after PATIENCE_S only.

    During the start only the world's warning is given. silent_s: age [s] beyond which a node's
    warning is dropped, as it may no longer hold; 0: never.
    """
    if time.monotonic() - watch.began <= PATIENCE_S:
        return list(watch.failures)
    world = watch.world
    statuses = [(node, watch.statuses[node]) for node in in_order(watch.statuses)]
    if world is None:
        statuses = (
            [("recorder", watch.statuses["recorder"])] if "recorder" in watch.statuses else []
        )
        texts = [f"{node}: {'; '.join(s.warnings)}" for node, s in statuses if s.warnings]
    elif world.state == "waiting":
        texts = [f"{world.node}: {w}" for w in world.warnings]
    else:
        statuses += [(world.node, world)] if watch.drivers else []
        oldest = time.monotonic() - silent_s if silent_s else -math.inf
        fresh = [s for s in statuses if watch.last_message.get(s[0], math.inf) >= oldest]
        texts = [f"{node}: {w}" for node, status in fresh for w in status.warnings]
    return [*watch.failures, *(each for each in texts if not any(not_joined([each])))]


def starting(watch: Watch) -> str:
    """Number of started robots and names of the others."""
    missing = watch.missing_robots
    started = f"{len(watch.robots) - len(missing)} of {len(watch.robots)} robots have started"
    if not missing:
        return f"{started}; waiting for the first measurements"
    more = f" and {len(missing) - NAMED} more" if len(missing) > NAMED else ""
    return f"{started}; waiting for {', '.join(missing[:NAMED])}{more}"


def share(watch: Watch) -> str:
    """Progress as text; the total is unknown for drivers."""
    if not is_live(watch):
        return f"{done(watch):.0%}"
    taken, total = _count_consumed(watch)
    return f"{taken:,.0f} of {total:,.0f} measurements mapped"


def times(watch: Watch, world: m.Status) -> str:
    """Describe the team time of the map, and of a world far ahead."""
    ahead_s = _behind_s(watch, world)
    if is_live(watch) or ahead_s < AHEAD_S:
        return team_time(world)
    at_s = max(0.0, world.figures.get("team_time_s", 0.0) - ahead_s)
    return f"team time {at_s:,.0f} s (the world is {ahead_s:,.0f} s ahead of the map)"


def _behind_s(watch: Watch, world: m.Status) -> float:
    if watch.fused is None or not watch.fused.stamp_ns:
        return world.figures.get("team_time_s", 0.0)
    return max(0.0, 1e-9 * (world.stamp_ns - watch.fused.stamp_ns))


def unjoined_robots(watch: Watch) -> list[tuple[str, str]]:
    """Unjoined robots, each with its failed test."""
    return [] if watch.fused is None else list(not_joined(watch.fused.reasons))


def consistency(watch: Watch) -> str:
    """Describe the consistency monitor's figures; with truth, NEES and coverage."""
    central, landmarks = watch.statuses.get("central"), watch.errors.landmarks
    figures = {} if central is None else central.figures
    parts = [
        f"{words} {figures[name]:.2f}"
        for name, words in (
            ("joint_cost_per_dof", "joint cost per dof"),
            ("covariance_scale", "covariance scale"),
        )
        if name in figures
    ]
    if landmarks.count:
        parts.append(f"landmark NEES per dof {landmarks.mean:.2f}")
        parts.append(f"{landmarks.coverage:.0%} within 95 %")
    return ", ".join(parts)
