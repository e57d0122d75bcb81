from collections.abc import Iterator

import numpy as np

from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.arrays import from_floats, from_ids
from teamslam.team.wire.bus import Outgoing, Sample
from teamslam.team.wire.codec import encoded
from tests import build
from tests.support import fused_map

S = 1_000_000_000


def crowd(robots: int, landmarks: int, seconds: int, seed: int = 0) -> Iterator[Sample]:
    rng = np.random.default_rng(seed)
    size_m = 6.0 * np.sqrt(landmarks)
    places = rng.uniform(0.0, size_m, (landmarks, 2))
    counters: dict[str, int] = {}

    def sample(out: Outgoing) -> Sample:
        counter = counters[out.key] = counters.get(out.key, -1) + 1
        stamp_ns = out.message.stamp_ns
        return Sample(out.key, encoded(out.message), stamp_ns, stamp_ns, counter)

    names = [f"r{i}" for i in range(1, robots + 1)]
    true = {"ids": from_ids(range(landmarks)), "positions": from_floats(places)}
    yield sample(Outgoing(ch.TRUTH_LANDMARKS, "", m.TruthLandmarks(stamp_ns=0, **true)))
    for name in names:
        yield sample(Outgoing(ch.ALIVE, f"robot/{name}", build.liveliness(node=f"robot/{name}")))
        yield sample(Outgoing(ch.START, name, build.initial_pose(robot=name, pose=[0, 0, 0])))
    phase = rng.uniform(0.0, 2.0 * np.pi, robots)
    reach = rng.uniform(0.1, 0.45, robots) * size_m
    P = from_floats(np.diag([0.04, 0.09, 1e-3]))
    for k in range(5 * seconds):
        at = k * S // 5
        for i, name in enumerate(names):
            angle = phase[i] + k / (5.0 * reach[i])
            true = [
                size_m / 2 + reach[i] * np.cos(angle),
                size_m / 2 + reach[i] * np.sin(1.3 * angle),
                np.arctan2(1.3 * np.cos(1.3 * angle), -np.sin(angle)),
            ]
            said = np.array(true) + rng.normal(size=3) * [0.2, 0.3, 0.03]
            truth = build.truth(stamp_ns=at, robot=name, stamps=[at], poses=true)
            pose = build.pose_estimate(
                stamp_ns=at, robot=name, map_digest=b"12345678", pose=said, covariance=P
            )
            yield sample(Outgoing(ch.TRUTH, name, truth))
            yield sample(Outgoing(ch.TEAM_POSE, name, pose))
        if k % 25 == 24:
            yield sample(Outgoing(ch.FUSED_MAP, "", _map(rng, places, at, k / (3.0 * seconds))))
    last = 5 * seconds * S // 5
    yield sample(Outgoing(ch.FINAL_MAP, "", _map(rng, places, last, 1.0, final=True)))


def _map(
    rng: np.random.Generator, places: np.ndarray, at: int, share: float, *, final: bool = False
) -> m.FusedMap:
    count = max(1, int(min(share, 1.0) * len(places)))
    sigma = 0.1 + 0.4 * (1.0 - min(share, 1.0))
    blocks = np.tile([sigma**2, 0.3 * sigma**2, 0.6 * sigma**2], (count, 1))
    means = places[:count] + sigma * rng.normal(size=(count, 2))
    members = (m.VersionEntry(robot="r1", incarnation=1, sequence=0),)
    return fused_map(
        stamp_ns=at,
        final=final,
        provisional=not final,
        members=members,
        ids=range(count),
        means=means,
        covariance=blocks,
    )
