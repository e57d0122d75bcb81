"""Builders of messages, with an ordinary value for each field not given.

The numbers of an array are encoded as its field's are.
"""

from collections.abc import Callable, Mapping
from functools import cache, partial
from typing import Any, TypeVar

import msgspec

from teamslam.team.wire import messages as m
from teamslam.team.wire.arrays import from_floats, from_ids, from_stamps

S = 1_000_000_000  # one second [ns]
M = TypeVar("M")
ORDINARY: dict[str, Any] = {
    "stamp_ns": 0, "robot": "r1", "incarnation": 1, "sequence": 0, "exchange": 0, "steps": 0,
    "measurements": 0, "submaps": 0, "ledger": (), "number": 0, "pose": b"", "covariance": b"",
    "duration_ns": S, "forward": 1.0, "yaw_rate": 0.1, "alive": True, "joint": True,
    "digest": bytes(8), "config": bytes(8), "map_digest": bytes(8), "configuration": "{}",
    "by": "operator", "reason": "a test", "figures": {}, "warnings": (), "first": 0, "last": -1,
    "final": False, "provisional": False, "rule": "join", "frame": "r1/1", "members": (),
    "missing": (), "chi2": 0.0, "dof": 0, "reasons": (), "state": "mapping", "start": True,
    "serial": 0, "sha256": bytes(32), "holdings": (), "statements": (), "requested": (),
    "payload": b"", "wall_ns": 0, "counter": 0, "keys": (), "counts": (), "since_ns": 0,
    "teammates": (), "ids": b"", "ranges": b"", "bearings": b"", "stamps": b"", "poses": b"",
    "covariances": b"", "signature": b"", "sequences": (), "streams": (),
}  # fmt: skip
ENCODED: dict[str, Callable[[Any], bytes]] = {
    **dict.fromkeys(("ids", "counts", "rows", "landmarks", "labels"), from_ids),
    **dict.fromkeys(("sequences", "locals", "identities"), from_ids),
    **dict.fromkeys(("stamps", "nodes"), from_stamps),
}
"""All other arrays are of floats."""


@cache
def _arrays_of(kind: type[msgspec.Struct]) -> frozenset[str]:
    return frozenset(field.name for field in msgspec.structs.fields(kind) if field.type is bytes)


def built(kind: Callable[..., M], ordinary: Mapping[str, Any] = ORDINARY, **fields: object) -> M:
    names: tuple[str, ...] = getattr(kind, "__struct_fields__")  # noqa: B009 - msgspec's
    required = names[: len(names) - len(getattr(kind, "__struct_defaults__"))]  # noqa: B009
    values = {name: ordinary[name] for name in required if name in ordinary} | fields
    if "node" in required and "node" not in values:
        values["node"] = f"robot/{values.get('robot', ordinary['robot'])}"
    for name in _arrays_of(kind) & values.keys():
        if not isinstance(values[name], bytes):
            values[name] = ENCODED.get(name, from_floats)(values[name])
    return kind(**values)


initial_pose = partial(built, m.InitialPose)
odometry = partial(built, m.Odometry)
observations = partial(built, m.Observations)
liveliness = partial(built, m.Liveliness)
progress = partial(built, m.Progress)
done = partial(built, m.Done)
submap = partial(built, m.Submap)
sighting_factor = partial(built, m.SightingFactor)
map_estimate = partial(built, m.MapEstimate)
pose_estimate = partial(built, m.PoseEstimate)
prior = partial(built, m.Prior)
fused_map = partial(built, m.FusedMap)
configuration = partial(built, m.Configuration)
status = partial(built, m.Status)
withdrawal = partial(built, m.Withdrawal)
measurements_request = partial(built, m.MeasurementsRequest)
submaps_request = partial(built, m.SubmapsRequest)
increment = partial(built, m.Increment)
points = partial(built, m.Points)
detections = partial(built, m.Detections)
sightings = partial(built, m.Sightings)
truth = partial(built, m.Truth)
trajectory = partial(built, m.Trajectory)
given_up = partial(built, m.GivenUp)
team_end = partial(built, m.TeamEnd)
withdrawal_heard = partial(built, m.WithdrawalHeard)
concluded = partial(built, m.Concluded)
set_summary = partial(built, m.SetSummary)
members_request = partial(built, m.MembersRequest)
members = partial(built, m.Members)
kept = partial(built, m.Kept)
kept_request = partial(built, m.KeptRequest)
tally = partial(built, m.Tally)
fault = partial(built, m.Fault)
holding = partial(built, m.Holding)
requested = partial(built, m.Requested)


def end(stamp_ns: int = 0, incarnation: int = 1, **measurements: int) -> m.End:
    streams = (
        m.StreamEnd(robot=robot, incarnation=incarnation, measurements=count)
        for robot, count in measurements.items()
    )
    return m.End(stamp_ns=stamp_ns, streams=tuple(streams))


def verdict(
    first: m.LocalLandmark, second: m.LocalLandmark, *, same: bool, withdrawn: bool = False
) -> m.Verdict:
    judgement = m.Judgement(first=first, second=second, same=same)
    return m.Verdict(
        stamp_ns=0, robot=first.robot, judgement=judgement, by="operator", reason="",
        withdrawn=withdrawn,
    )  # fmt: skip


def version(**last: int) -> tuple[m.VersionEntry, ...]:
    return tuple(
        m.VersionEntry(robot=robot, incarnation=1, sequence=sequence)
        for robot, sequence in last.items()
    )
