import os
from collections import Counter
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings, strategies as st

from teamslam.team.config import (
    Bounds,
    Estimator,
    FrontEnd,
    FusionRule,
    MotionModel,
    MotionNoise,
    RobotConfig,
)
from teamslam.team.rejection import Rejection
from teamslam.team.robot.node import RobotNode
from teamslam.team.wire import messages as m
from teamslam.team.wire.arrays import floats, ids
from tests import build
from tests.hostile.drawing import S, hostile_stream, robot_session

SESSIONS = int(os.environ.get("TEAMSLAM_STORM", "3"))
LANDMARKS = {1: (5.0, 0.0), 2: (0.0, 6.0), 3: (-4.0, 3.0)}
PAIRS: tuple[tuple[Estimator, FusionRule], ...] = (
    ("hybrid", "join"),
    ("hybrid", "alone"),
    ("ekf-slam", "alone"),
    ("dead-reckoning", "alone"),
)


def config(estimator: Estimator = "hybrid", fusion: FusionRule = "join", **fields) -> RobotConfig:
    front = {"particles": 10, "window_s": 10.0} | fields.pop("front_end", {})
    noise = {"forward": MotionNoise(per_s=0.03, per_m=0.04), "turn": MotionNoise(per_s=0.02)}
    method = {"estimator": estimator, "fusion": fusion, "front_end": FrontEnd(**front)}
    return RobotConfig("r1", motion=MotionModel(**noise), **method, **fields)


def drive(
    steps: int, odd: dict[int, m.Message] | None = None, *, sees: bool = True
) -> list[m.Message]:
    """A circle at 1 m/s, three landmarks each second; `odd`: in place of one second's messages."""
    out: list[m.Message] = [build.initial_pose(pose=[0.0, 0.0, 0.0])]
    for k in range(1, steps + 1):
        own = build.odometry(stamp_ns=k * S, number=2 * k)
        scan = [(i, float(np.hypot(*p)), 0.3 * i - 1.0) for i, p in LANDMARKS.items()]
        seen, ranges, bearings = zip(*scan, strict=True) if sees else ((), (), ())
        look = build.observations(
            stamp_ns=k * S, number=2 * k - 1, ids=seen, ranges=ranges, bearings=bearings
        )
        out += [look, (odd or {}).get(k) or own]
    return [*out, build.end(steps * S, r1=2 * steps + 1)]


def lived(messages, **fields) -> tuple[RobotNode, list[m.Submap], Counter[str]]:
    node, out = robot_session(iter(messages), config(**fields))
    (done,) = [each.message for each in out if isinstance(each.message, m.Done)]
    submaps = [each.message for each in out if isinstance(each.message, m.Submap)]
    ledger = Counter({each.disposition: each.measurements for each in done.ledger})
    assert sum(ledger.values()) == done.measurements, "each measurement has one disposition"
    return node, submaps, ledger


@pytest.mark.parametrize("speed", [1e3, 1e7, 1e300])
def test_an_interval_that_is_too_fast_is_rejected_and_the_robot_drives_on(speed):
    glitch = build.odometry(stamp_ns=15 * S, number=30, forward=speed, yaw_rate=0.0)
    _, submaps, ledger = lived(drive(40, {15: glitch}, sees=False))
    assert ledger[Rejection.SPEED.disposition] == 1
    _, good, _ = lived(drive(40, sees=False))
    sigmas = [[floats(each.covariance, "")[0] ** 0.5 for each in some] for some in (submaps, good)]
    more = np.array(sigmas[0]) / np.array(sigmas[1])
    assert more[1] > 3.0, "nobody measured that second: its submap knows less of where it ended"
    np.testing.assert_allclose(np.delete(more, 1), 1.0, atol=1e-9)


def test_time_that_stands_goes_back_or_leaps_is_rejected():
    odd = {
        12: build.odometry(stamp_ns=11 * S, number=24),
        14: build.odometry(stamp_ns=3 * S, number=28),
        16: build.odometry(stamp_ns=16 * S + 10**18, number=32),
    }
    node, submaps, ledger = lived(drive(40, odd))
    assert node.status().stamp_ns == 40 * S, "a last word 30 years away is refused by the centre"
    assert ledger[Rejection.OLDER.disposition] == 2
    assert ledger[Rejection.TIME.disposition] == 1
    assert submaps[-1].stamp_ns == 40 * S


def test_a_clock_that_has_truly_leapt_is_followed_from_the_second_interval_on():
    away = 10**16
    odd = {k: build.odometry(stamp_ns=k * S + away, number=2 * k) for k in range(21, 41)}
    _, submaps, ledger = lived(drive(40, odd))
    assert ledger[Rejection.TIME.disposition] == 1
    assert submaps[-1].stamp_ns == 40 * S + away


def test_a_range_beyond_the_bounds_is_not_taken():
    far = build.observations(stamp_ns=5 * S, number=9, ids=[1], ranges=[9e5], bearings=[0.0])
    messages = [far if getattr(x, "number", None) == 9 else x for x in drive(20)]
    _, _, ledger = lived(messages, bounds=Bounds(extent_m=1e4))
    assert ledger[Rejection.RANGE.disposition] == 1


def test_thousands_of_landmarks_in_one_window_make_several_submaps_within_the_bounds():
    messages = []
    for each in drive(20):
        if isinstance(each, m.Observations):
            k = each.number
            n = 2000 if k == 21 else 60
            polar = {"ranges": np.linspace(1.0, 50.0, n), "bearings": np.linspace(-3.0, 3.0, n)}
            seen = np.arange(1, n + 1) + 60 * k
            each = build.observations(stamp_ns=each.stamp_ns, number=k, ids=seen, **polar)
        messages.append(each)
    bounds = Bounds(submap_landmarks=200)
    _, submaps, _ = lived(messages, bounds=bounds)
    counts = [len(ids(each.ids, "ids")) for each in submaps]
    assert max(counts) == 200
    assert len(submaps) > 5, "windows close early: 10 s would be two"
    assert all(a.stamp_ns == b.start_ns for a, b in pairwise(submaps))


@pytest.mark.parametrize(("estimator", "fusion"), PAIRS)
@settings(max_examples=SESSIONS, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(seed=st.integers(0, 2**32))
def test_any_estimator_goes_on_through_a_hostile_stream(estimator, fusion, seed):
    own = config(estimator, fusion, front_end={"node_s": 2.0 * (fusion == "join")})
    node, out = robot_session(hostile_stream(np.random.default_rng(seed), "r1", 60), own)
    assert any(isinstance(each.message, m.Done) for each in out), node.warnings
    assert not any("submap" in text for text in node.warnings if "withheld" in text)
