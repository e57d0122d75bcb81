from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from teamslam.central.config import CentralConfig
from teamslam.central.node import make_centre
from teamslam.sim.studies.estimators import svd_joining
from teamslam.sim.studies.estimators.svd_joining import PointPairs
from teamslam.sim.studies.rules.svd_rule import align_maps
from teamslam.team import translate
from teamslam.team.estimation.contribution import Stream
from teamslam.team.estimation.gaussian import LandmarkGaussian
from teamslam.team.estimation.se2 import inverse, transformed
from teamslam.team.wire import channels as ch
from teamslam.team.wire.bus import Outgoing
from teamslam.team.wire.codec import encoded
from tests import build
from tests.teams import Submaps, of, published, stream, submaps_of

STREAMS = {"r1": stream("r1", 12), "r2": stream("r2", 10, y=1.0)}
SUBMAPS = Submaps(list(STREAMS.values()))
STARTS = {name: published(each)[0] for name, each in STREAMS.items()}
END = build.end(**{name: len(each) for name, each in STREAMS.items()})
RULES = ["svd-join", "svd-join-spherical"]


def messages(submaps=SUBMAPS, starts=STARTS):
    return [
        *(x for name in submaps for x in (starts[name], *submaps[name])),
        *(
            build.done(robot=name, measurements=1, steps=1, submaps=len(each))
            for name, each in submaps.items()
        ),
        END,
    ]


def final(heard, rule):
    node, out = make_centre(CentralConfig(fusion=rule, broadcast_s=4.0), ["r1", "r2"]), []
    for message in heard:
        out += node.handle(message)
    (found,) = of(out, ch.FINAL_MAP)
    return found, out


@pytest.mark.parametrize("rule", RULES)
def test_the_final_map_is_downs_exchange_of_the_robots_own_joined_maps(rule):
    full = rule == "svd-join"
    maps = []
    for name, y in (("r1", 0.0), ("r2", 1.0)):
        state = svd_joining.initial_state(
            {name: np.array([0.0, y, 0.0])}, "full" if full else "identity"
        )
        for submap in SUBMAPS[name]:
            state = svd_joining.filter_step(state, name, translate.local_map_of(submap))
        maps.append(svd_joining.landmark_gaussian(svd_joining.solve(state)))
    exchanged = svd_joining.exchange_maps_fully if full else svd_joining.exchange_maps
    expected = exchanged(*maps).landmarks
    found, out = final(messages(), rule)
    ids, means = translate.landmarks_of(found)
    np.testing.assert_array_equal(ids, expected.ids)
    np.testing.assert_array_equal(means, expected.means)
    covariance = translate.landmark_covariance_of(found)
    np.testing.assert_allclose(covariance, expected.covariance, rtol=1e-12, atol=1e-15)
    assert found.frame == "r1/1"
    assert found.members == build.version(r1=3, r2=3)
    assert of(out, ch.FUSED_MAP)
    credit: list[Outgoing] = [o for o in out if o.channel is ch.CENTRAL_PROGRESS]
    assert len(credit) == 8, "every submap is acknowledged"


@pytest.mark.parametrize("rule", RULES)
@settings(deadline=None, max_examples=10)
@given(order=st.deferred(lambda: st.permutations(range(len(messages())))))
def test_any_order_of_arrival_gives_the_same_bytes(rule, order):
    heard = [messages()[i] for i in order]
    assert encoded(final(heard, rule)[0]) == expected(rule)


@cache
def expected(rule):
    return encoded(final(messages(), rule)[0])


@pytest.mark.parametrize("rule", RULES)
def test_a_robot_that_shares_too_little_stays_out_with_the_reason(rule):
    short = {"r1": SUBMAPS["r1"], "r2": submaps_of(stream("r2", 3, y=-40.0))}
    starts = STARTS | {"r2": published(stream("r2", 3, y=-40.0))[0]}
    found, _ = final(messages(short, starts), rule)
    assert found.reasons == ("r2 (incarnation 1) not joined: 0 shared landmarks, 2 needed",)
    alone, _ = final(messages({"r1": SUBMAPS["r1"], "r2": []}), rule)
    assert found.means == alone.means
    assert alone.reasons == ()


def _map_of(points: np.ndarray, ids: list[int], frame: np.ndarray) -> LandmarkGaussian:
    back = inverse(frame)
    own = np.array([transformed(back, point) for point in points])
    return LandmarkGaussian(np.array(ids, np.uint32), own, 0.01 * np.eye(2 * len(ids)))


def test_maps_without_a_common_landmark_are_tied_where_their_robots_saw_each_other():
    generator = np.random.default_rng(1)
    points = generator.uniform(-5.0, 5.0, (9, 2))
    frames = {("r1", 0): np.zeros(3), ("r2", 0): np.array([2.0, -1.0, 0.7]),
              ("r3", 0): np.array([-3.0, 1.0, -2.0])}  # fmt: skip
    maps = {
        stream: _map_of(points[3 * k : 3 * k + 3], [3 * k, 3 * k + 1, 3 * k + 2], frame)
        for k, (stream, frame) in enumerate(frames.items())
    }
    robots = generator.uniform(-5.0, 5.0, (4, 2))

    def seen(a: Stream, b: Stream, at: slice) -> PointPairs:
        return PointPairs(*(
            np.array([transformed(inverse(frames[s]), point) for point in robots[at]])
            for s in (a, b)
        ))  # fmt: skip

    r1, r2, r3 = frames
    sightings = {(r1, r2): seen(r1, r2, slice(0, 2)), (r2, r3): seen(r2, r3, slice(2, 4))}
    fused, reasons = align_maps(r1, maps, full=False, sightings=sightings)
    assert reasons == ()
    np.testing.assert_allclose(fused.means, points, atol=1e-9)
    alone, reasons = align_maps(r1, maps, full=False)
    assert len(alone.ids) == 3
    assert len(reasons) == 2
