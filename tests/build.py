"""Builders of messages, with an ordinary value for each field not given.

The numbers of an array are encoded as its field's are.
"""

from collections.abc import Callable
from functools import cache, partial
from typing import Any, TypeVar

import msgspec

from teamslam.team.wire import messages as m
from teamslam.team.wire.arrays import from_floats, from_ids, from_stamps

S = 1_000_000_000
"""One second [ns]."""
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
    **dict.fromkeys(("stamps", "nodes"), from_stamps),
}
"""All other arrays are of floats."""


@cache
def _arrays_of(kind: type[msgspec.Struct]) -> frozenset[str]:
    return frozenset(field.name for field in msgspec.structs.fields(kind) if field.type is bytes)


def _built(kind: Callable[..., M], **fields: object) -> M:
    names: tuple[str, ...] = getattr(kind, "__struct_fields__")  # noqa: B009 - msgspec's
    required = names[: len(names) - len(getattr(kind, "__struct_defaults__"))]  # noqa: B009
    values = {name: ORDINARY[name] for name in required if name in ORDINARY} | fields
    if "node" in required and "node" not in values:
        values["node"] = f"robot/{values.get('robot', 'r1')}"
    for name in _arrays_of(kind) & fields.keys():
        if not isinstance(fields[name], bytes):
            values[name] = ENCODED.get(name, from_floats)(fields[name])
    return kind(**values)


initial_pose = partial(_built, m.InitialPose)
odometry = partial(_built, m.Odometry)
observations = partial(_built, m.Observations)
liveliness = partial(_built, m.Liveliness)
progress = partial(_built, m.Progress)
done = partial(_built, m.Done)
submap = partial(_built, m.Submap)
sighting_factor = partial(_built, m.SightingFactor)
map_estimate = partial(_built, m.MapEstimate)
pose_estimate = partial(_built, m.PoseEstimate)
prior = partial(_built, m.Prior)
fused_map = partial(_built, m.FusedMap)
configuration = partial(_built, m.Configuration)
status = partial(_built, m.Status)
withdrawal = partial(_built, m.Withdrawal)
measurements_request = partial(_built, m.MeasurementsRequest)
submaps_request = partial(_built, m.SubmapsRequest)
increment = partial(_built, m.Increment)
points = partial(_built, m.Points)
detections = partial(_built, m.Detections)
sightings = partial(_built, m.Sightings)
truth = partial(_built, m.Truth)
trajectory = partial(_built, m.Trajectory)
given_up = partial(_built, m.GivenUp)
team_end = partial(_built, m.TeamEnd)
withdrawal_heard = partial(_built, m.WithdrawalHeard)
concluded = partial(_built, m.Concluded)
set_summary = partial(_built, m.SetSummary)
members_request = partial(_built, m.MembersRequest)
members = partial(_built, m.Members)
kept = partial(_built, m.Kept)
kept_request = partial(_built, m.KeptRequest)
tally = partial(_built, m.Tally)
fault = partial(_built, m.Fault)
holding = partial(_built, m.Holding)
requested = partial(_built, m.Requested)


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
