import gc
from functools import cache
from itertools import pairwise

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from teamslam.team.config import FrontEnd
from teamslam.team.estimation.hybrid_slam.window import ClosedWindow
from teamslam.team.estimation.submap import LocalMap
from teamslam.team.pairs import PAIRS
from teamslam.team.rejection import Rejection
from teamslam.team.robot import node as robot_node
from teamslam.team.robot.maps import CONDENSED
from teamslam.team.robot.node import RobotNode, robot_node as node_for
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.arrays import floats, from_floats, from_ids
from teamslam.team.wire.codec import decoded, encoded
from tests import build
from tests.support import fused_map, packed, spd
from tests.teams import config, driven, of, published, stream

STREAM = stream("r1", 12, off_ns=300_000_000)
MEASUREMENTS = published(STREAM)
END = build.end(12_000_000_000, r1=len(MEASUREMENTS))
CENTRE = build.liveliness(node="central")


def payloads(out, channel=ch.SUBMAP):
    return [encoded(message) for message in of(out, channel)]


@cache
def lonely():
    return payloads(driven(RobotNode(config()), MEASUREMENTS))


def prior(sequence=0, incarnation=1, scale=1.0, at=0.0, ids=(1, 2)):
    n = 3 + 2 * len(ids)
    return build.prior(
        incarnation=incarnation,
        sequence=sequence,
        digest=b"whatever",
        ids=ids,
        mean=np.full(n, at),
        covariance=packed(scale * spd(n)),
    )


def fused(ids=(1, 2), at=0.0, *, final=False, exchange=0):
    return fused_map(
        digest=b"whatever",
        final=final,
        exchange=exchange,
        joint=True,
        ids=ids,
        means=np.full(2 * len(ids), at),
        covariance=packed(spd(2 * len(ids))),
    )


noise = st.one_of(
    st.builds(
        prior,
        st.integers(-2, 20),
        st.integers(0, 2),
        st.sampled_from([1e-12, 1e-3, 1.0, 1e6]),
        st.floats(-1e6, 1e6),
        st.sampled_from([(), (1,), (1, 2, 3), (900, 901)]),
    ),
    st.builds(fused, st.sampled_from([(), (1, 2), (77,)]), st.floats(-1e9, 1e9)),
    st.just(CENTRE),
    st.just(build.liveliness(node="central", alive=False)),
    st.builds(lambda n: build.progress(node="central", submaps=n), st.integers(0, 100)),
)


@settings(deadline=None, max_examples=25)
@given(st.lists(st.tuples(st.integers(0, len(MEASUREMENTS) - 1), noise), max_size=8))
def test_whatever_comes_back_under_join_no_submap_changes_by_a_bit(interjections):
    node, out = RobotNode(config()), []
    for i, measurement in enumerate(MEASUREMENTS):
        out += node.handle(measurement)
        for at, message in interjections:
            out += node.handle(message) if at == i else []
    out += node.handle(END)
    out += node.handle(build.liveliness(node="central", alive=False))
    assert payloads(out) == lonely()
    assert len(of(out, ch.ROBOT_DONE)) == 1


def test_the_prior_does_change_the_team_pose():
    """Counterpart of the mutant: the noise above is used where it may be."""
    poses = []
    for at in (0.0, 3.0):
        node = RobotNode(config())
        out = [o for r in MEASUREMENTS[:10] for o in node.handle(r)]
        out += node.handle(prior(at=at))
        out += [o for r in MEASUREMENTS[10:] for o in node.handle(r)]
        poses.append(payloads(out, ch.TEAM_POSE))
    assert len(poses[0]) == len(poses[1]) > 0
    assert poses[0] != poses[1]


def test_a_prior_that_can_not_be_solved_is_a_warning_and_the_robot_goes_on():
    node = RobotNode(config())
    flat = msgspec.structs.replace(prior(), covariance=packed(-100.0 * np.eye(7)))
    out = [o for r in MEASUREMENTS[:10] for o in node.handle(r)]
    out += node.handle(flat)
    out += driven(node, MEASUREMENTS[10:])
    assert payloads(out) == lonely()
    assert not of(out, ch.TEAM_POSE)
    assert "no team pose" in node.warnings[0]


@settings(deadline=None, max_examples=15)
@given(st.permutations(range(len(MEASUREMENTS))), st.lists(st.integers(0, len(MEASUREMENTS) - 1)))
def test_any_order_of_arrival_and_duplicates_give_the_same_submaps(order, again):
    node = RobotNode(config())
    out = [o for i in [*order, *again] for o in node.handle(MEASUREMENTS[i])]
    assert payloads(out + node.handle(END)) == lonely()


STREAMS = {
    "observations at the ends of intervals": stream("r1", 11),
    "observations between odometry stamps": stream("r1", 11, off_ns=400_000_000),
    "observations beyond the odometry": stream("r1", 10, beyond=4),
    "nothing but observations": stream("r1", 5, drives=False),
    "little seen": stream("r1", 13, seen_every=5),
    "a free start": stream("r1", 8, known=False),
    "quick odometry": stream("r1", 40, step_ns=50_000_000),
}


@pytest.mark.parametrize("name", STREAMS)
@pytest.mark.parametrize("keyframe_s", [0.0, 0.7])
@pytest.mark.parametrize("estimator", sorted({estimator for estimator, _ in PAIRS}))
def test_every_measurement_has_one_disposition(name, keyframe_s, estimator):
    measurements = published(STREAMS[name])
    front_end = msgspec.structs.replace(config().front_end, keyframe_s=keyframe_s)
    fusion = {"hybrid": "join", "hybrid-thesis": "kalman-per-axis"}.get(estimator, "alone")
    node = node_for(config(front_end=front_end, estimator=estimator, fusion=fusion))
    node.handle(build.liveliness(node="central", alive=False))
    node.handle(
        m.KnownMap(stamp_ns=0, ids=from_ids([1, 2]), positions=from_floats([5.0, 3.0, 9.0, -2.0]))
    )
    out = driven(node, measurements)
    (done,) = of(out, ch.ROBOT_DONE)
    assert done.measurements == len(measurements)
    assert sum(entry.measurements for entry in done.ledger) == len(measurements)
    assert all(entry.measurements > 0 for entry in done.ledger)
    assert done.steps == sum(isinstance(r, m.Odometry) for r in measurements)
    used = [e.measurements for e in done.ledger if e.disposition.startswith("in ")]
    uncovered = [e.measurements for e in done.ledger if "no odometry" in e.disposition]
    beyond = name in ("observations beyond the odometry", "nothing but observations")
    assert bool(uncovered) == (beyond and estimator != "dead-reckoning")
    submaps = of(out, ch.SUBMAP)
    assert done.submaps == len(submaps)
    if estimator == "hybrid" and submaps:
        assert submaps[0].first_measurement == 0
        for before, after in pairwise(submaps):
            assert after.first_measurement == before.last_measurement + 1
            assert after.start_ns == before.stamp_ns
        inside = sum(s.last_measurement - s.first_measurement + 1 for s in submaps)
        rejected = sum(e.measurements for e in done.ledger if e.disposition.startswith("rejected"))
        assert sum(used) + 1 <= inside <= sum(used) + 1 + rejected


def out_of_order(measurements):
    late = []
    for measurement, following in pairwise([*measurements, None]):
        ends = following is not None and isinstance(following, m.Odometry)
        if ends and isinstance(measurement, m.Observations | m.Sightings):
            measurement = msgspec.structs.replace(
                measurement, stamp_ns=following.stamp_ns + 500_000_000
            )
        late.append(measurement)
    return late


@pytest.mark.parametrize("options", [{}, {"keyframe_s": 0.3}, {"node_s": 1.0}])
def test_what_is_stamped_behind_its_window_is_in_no_submap_also_after_a_restart(options):
    """Otherwise the next window would use it too, and after a restart another submap came."""
    measurements = out_of_order(published(stream("r1", 12)))
    front_end = msgspec.structs.replace(config().front_end, **options)
    out = driven(RobotNode(config(front_end=front_end)), measurements)
    whole = of(out, ch.SUBMAP)
    (done,) = of(out, ch.ROBOT_DONE)
    assert sum(entry.measurements for entry in done.ledger) == len(measurements)
    ledger = {entry.disposition: entry.measurements for entry in done.ledger}
    assert ledger[Rejection.LATE.disposition] == len(whole) - 1
    for taken in range(1, len(whole)):
        node = RobotNode(config(front_end=front_end))
        node.resume(measurements[0], whole[:taken])
        assert payloads(driven(node, measurements)) == [encoded(each) for each in whole[taken:]]


def test_everything_it_sends_passes_the_door():
    node = RobotNode(config())
    out = [*node.begin(), *node.handle(CENTRE)]
    for measurement in MEASUREMENTS:
        out += node.handle(measurement)
        out += node.handle(prior())
    out += node.handle(END)
    for o in out:
        assert decoded(encoded(o.message), *o.channel.kinds) == o.message
    assert {o.channel for o in out} >= {ch.SUBMAP, ch.OWN_MAP, ch.OWN_POSE, ch.TEAM_POSE}


def test_a_robot_is_so_many_submaps_ahead_of_a_living_centre_and_no_more(monkeypatch):
    monkeypatch.setattr(robot_node, "CREDIT_SUBMAPS", 1)
    node = RobotNode(config())
    node.handle(CENTRE)
    out = [o for r in MEASUREMENTS for o in node.handle(r)] + node.handle(END)
    assert len(of(out, ch.SUBMAP)) == 2
    out += node.handle(build.progress(node="central", incarnation=7, submaps=9))
    assert len(of(out, ch.SUBMAP)) == 2, "credit of another incarnation is none"
    out += node.handle(build.progress(node="central", submaps=1))
    assert len(of(out, ch.SUBMAP)) == 3
    out += node.handle(build.liveliness(node="robot/r2", alive=False))
    assert len(of(out, ch.SUBMAP)) == 3, "another node's token is not the centre's"
    out += node.handle(build.liveliness(node="central", alive=False))
    assert payloads(out) == lonely()
    assert len(of(out, ch.ROBOT_DONE)) == 1


def test_a_new_incarnation_closes_the_old_one_under_its_own_name():
    node = RobotNode(config())
    out = [o for r in MEASUREMENTS[:10] for o in node.handle(r)]
    second = [
        msgspec.structs.replace(r, incarnation=2, number=r.number - 15) for r in MEASUREMENTS[15:]
    ]
    second[0] = build.initial_pose(stamp_ns=second[0].stamp_ns, incarnation=2)
    out += [o for r in second for o in node.handle(r)]
    out += node.handle(build.end(incarnation=2, r1=len(second)))
    submaps = of(out, ch.SUBMAP)
    names = [(s.incarnation, s.sequence) for s in submaps]
    assert names == [(1, 0), (1, 1), *((2, k) for k in range(len(names) - 2))]
    assert len(names) > 2
    assert submaps[1].last_measurement == 9
    assert next(s for s in submaps if s.incarnation == 2).first_measurement == 0
    last, first = of(out, ch.ROBOT_DONE)
    assert (last.incarnation, first.incarnation) == (2, 1)
    assert (first.measurements, last.measurements) == (10, len(second))
    for done in (first, last):
        assert sum(e.measurements for e in done.ledger) == done.measurements
    for progress in of(out, ch.ROBOT_PROGRESS):
        assert progress.submaps <= sum(s.incarnation == progress.incarnation for s in submaps)


def feedback(**options):
    return node_for(config(fusion="kalman", **options))


def test_under_feedback_a_robot_waits_for_the_answer_of_each_exchange():
    node = feedback()
    out = [o for r in MEASUREMENTS for o in node.handle(r)] + node.handle(END)
    assert [x.exchange for x in of(out, ch.OWN_MAP)] == [1]
    before = node.next_measurement
    assert node.handle(fused(exchange=0)) == []
    assert node.next_measurement == before, "an old answer is none"
    for number in range(1, 5):
        out += node.handle(fused(ids=(1, 2), at=2.0, exchange=number))
    assert [x.exchange for x in of(out, ch.OWN_MAP)] == [1, 2, 3, 4]
    assert len(of(out, ch.ROBOT_DONE)) == 1


def test_its_nis_is_that_of_its_windows_and_of_the_open_one():
    node = RobotNode(config())
    assert "nis_per_dof" not in node.status().figures
    windows = of(driven(node, MEASUREMENTS[:-8], end=False), ch.INNOVATION)
    submaps = of(driven(RobotNode(config()), MEASUREMENTS[:-8], end=False), ch.SUBMAP)
    assert [(w.sequence, w.stamp_ns) for w in windows] == [
        (s.sequence, s.stamp_ns) for s in submaps
    ]
    figures = node.status().figures
    closed = sum(window.dof for window in windows)
    assert figures["nis_dof"] > closed > 0
    total = figures["nis_per_dof"] * figures["nis_dof"]
    assert total > sum(window.squared for window in windows) > 0.0
    rest = of(driven(node, MEASUREMENTS[-8:]), ch.INNOVATION)
    figures = node.status().figures
    assert figures["nis_dof"] == closed + sum(window.dof for window in rest)


def outliers(measurements, share):
    rng, spoilt = np.random.default_rng(7), []
    for measurement in measurements:
        if isinstance(measurement, m.Observations):
            ranges, bearings = (
                floats(x, "z").copy() for x in (measurement.ranges, measurement.bearings)
            )
            bad = rng.random(len(ranges)) < share
            ranges[bad] = rng.uniform(1.0, 10.0, bad.sum())
            bearings[bad] = rng.uniform(-np.pi, np.pi, bad.sum())
            measurement = msgspec.structs.replace(
                measurement, ranges=from_floats(ranges), bearings=from_floats(bearings)
            )
        spoilt.append(measurement)
    return spoilt


@pytest.mark.parametrize(
    ("estimator", "fusion", "share", "warned"),
    [
        ("hybrid", "join", 0.0, False),
        ("hybrid", "join", 0.3, False),
        ("ekf-slam", "alone", 0.0, False),
        ("ekf-slam", "alone", 0.3, True),
    ],
)
def test_measurements_far_from_their_predictions_are_reported_unless_they_are_gated(
    estimator, fusion, share, warned
):
    node = node_for(config(estimator=estimator, fusion=fusion))
    driven(node, outliers(published(stream("r1", 30)), share), end=False)
    status = node.status()
    assert status.figures["nis_dof"] > 40
    found = [each for each in status.warnings if "far from their predictions" in each]
    assert len(found) == warned, status
    assert ("gated" in status.figures) == (share > 0.0 and estimator == "hybrid")


def test_a_resumed_robot_has_what_its_earlier_life_sent_for_whoever_asks():
    first, sent = RobotNode(config()), []
    for measurement in MEASUREMENTS[: len(MEASUREMENTS) // 2]:
        sent += first.handle(measurement)
    kept = [MEASUREMENTS[0], *of(sent, ch.SUBMAP)]
    node = RobotNode(config())
    node.take_over(kept)
    for measurement in MEASUREMENTS[node.next_measurement :]:
        sent += node.handle(measurement)

    def answer(**wanted):
        request = encoded(build.submaps_request(**wanted))
        return [decoded(reply) for reply in node.answer_submaps(request)]

    assert answer() == [MEASUREMENTS[0], *of(sent, ch.SUBMAP)]
    assert answer(incarnation=1, first=2) == [MEASUREMENTS[0], *of(sent, ch.SUBMAP)[2:]]
    assert answer(incarnation=2) == []
    assert node.answer_submaps(encoded(build.submaps_request(robot="r2"))) == []


def test_what_a_robot_holds_until_a_rendezvous_is_given_to_nobody():
    node = RobotNode(config(), "rendezvous")
    for measurement in MEASUREMENTS:
        node.handle(measurement)
    assert node.answer_submaps(encoded(build.submaps_request())) == [encoded(MEASUREMENTS[0])]


def rolling(seed: int) -> list[m.Measurement]:
    rng = np.random.default_rng(seed)
    found: list[m.Measurement] = [build.initial_pose(incarnation=0)]
    tick_ns, now_ns = 20_000_000, 0

    def add(kind, stamp_ns, **fields):
        named = {"robot": "r1", "incarnation": 0, "number": len(found)}
        found.append(kind(stamp_ns=int(stamp_ns), **named, **fields))

    for k in range(700):
        at_ns = now_ns + int(rng.integers(-tick_ns, 3 * tick_ns))
        if rng.random() < 0.05:
            r, b = rng.uniform(1.0, 9.0, 2), rng.uniform(-1.0, 1.0, 2)
            seen = {"ids": from_ids((1, 2)), "ranges": from_floats(r), "bearings": from_floats(b)}
            add(m.Observations, at_ns, **seen)
        if rng.random() < 0.02:
            seen = {"ranges": from_floats([4.0]), "bearings": from_floats([0.1])}
            add(m.Sightings, at_ns, teammates=("r2",), **seen)
        if rng.random() < 0.01:
            now_ns += int(rng.choice([-3 * tick_ns, 2 * 10**9, 10**12]))
        now_ns += tick_ns
        draw = rng.random()
        duration_ns = 0 if draw < 0.02 else 10**12 if draw > 0.999 else tick_ns
        speed = 0.0 if 200 < k < 400 else 999.0 if 0.4 < draw < 0.45 else float(draw)
        if rng.random() < 0.05:
            step = from_floats([0.01, 0.0, 0.02])
            add(m.Increment, now_ns, duration_ns=tick_ns, increment=step)
        else:
            add(m.Odometry, now_ns, duration_ns=duration_ns, forward=speed, yaw_rate=speed - 0.4)
    return found


@pytest.mark.parametrize("seed", range(4))
def test_a_window_that_is_computed_again_goes_on_to_the_same_messages(seed):
    front = FrontEnd(particles=8, window_s=3.0, keyframe_s=0.4, node_s=0.7, standing_s=5.0)
    options = {"front_end": front, "clock_offset_s": 0.013 * (seed % 2), "pose_s": 0.0}
    measurements = rolling(seed)
    out = driven(RobotNode(config(**options)), measurements)
    node, again = RobotNode(config(**options)), []
    for begin in range(0, len(measurements), 100):
        node.mapper.repeat_window()
        last = begin + 100 >= len(measurements)
        again += driven(node, measurements[begin : begin + 100], end=last)
    assert [encoded(each.message) for each in out] == [encoded(each.message) for each in again]


def test_a_stored_submap_has_the_bits_of_the_window_that_closed():
    windows: list[ClosedWindow] = []
    node = RobotNode(config(), on_window=windows.append)
    driven(node, published(stream("r1", 30)))
    stored = node.mapper.submaps
    assert len(stored) == len(windows) > 5
    for local, window in zip(stored, windows, strict=True):
        assert local.ids.tobytes() == window.local.ids.tobytes()
        assert local.mean.tobytes() == window.local.mean.tobytes()
        assert local.covariance.tobytes() == window.local.covariance.tobytes()
    assert [x.mean.tobytes() for x in stored[2:]] == [w.local.mean.tobytes() for w in windows[2:]]


def local_maps() -> int:
    gc.collect()
    return sum(isinstance(each, LocalMap) for each in gc.get_objects())


def test_of_closed_windows_a_robot_keeps_nothing_but_the_messages():
    """The number of local maps is that of the submaps that a prior lacks, at most 2 · CONDENSED."""
    before = local_maps()
    node = RobotNode(config())
    out = driven(node, published(stream("r1", 60)), end=False)
    assert len(of(out, ch.SUBMAP)) == 20
    del out
    assert local_maps() - before <= 1
    prior = build.prior(
        sequence=16,
        digest=bytes(8),
        mean=np.zeros(3).tobytes(),
        covariance=np.eye(3)[np.triu_indices(3)].tobytes(),
    )
    node.handle(prior)
    driven(node, published(stream("r1", 70))[len(published(stream("r1", 60))) :], end=False)
    assert 0 < local_maps() - before <= 2 * CONDENSED
