"""The message of a fused map, for rules other than joining."""

import msgspec

from teamslam.central.config import CentralConfig
from teamslam.team import translate
from teamslam.team.estimation.gaussian import LandmarkGaussian
from teamslam.team.wire import messages as m
from teamslam.team.wire.arrays import from_floats, from_ids
from teamslam.team.wire.codec import find_error

START_POSES = "start poses"  # the frame of a map that lies in the frame of the given initial poses
JOINT_LANDMARKS = 2000  # a map with more landmarks carries their 2 × 2 covariances only


def fused_message(
    config: CentralConfig,
    digest: bytes,
    value: LandmarkGaussian,
    members: tuple[m.VersionEntry, ...],
    *,
    stamp_ns: int,
    final: bool = False,
    joint: bool = True,
    exchange: int = 0,
    frame: str = START_POSES,
    cost: tuple[float, int] = (0.0, 0),
    reasons: tuple[str, ...] = (),
) -> m.FusedMap:
    """Make the message of a map; exchange: the lockstep round. cost: (χ², dof)."""
    joint = joint and len(value.ids) <= JOINT_LANDMARKS
    fused = m.FusedMap(
        stamp_ns=stamp_ns,
        rule=config.fusion,
        digest=digest,
        frame=frame,
        final=final,
        provisional=False,
        exchange=exchange,
        members=members,
        missing=(),
        joint=joint,
        ids=from_ids(value.ids),
        means=from_floats(value.means),
        covariance=translate.covariance_bytes(value.covariance, joint=joint),
        chi2=cost[0],
        dof=cost[1],
        reasons=reasons,
    )
    return receivable(fused)


def version_entry(stream: tuple[str, int], sequence: int) -> m.VersionEntry:
    """Make the entry for all submaps of a stream up to `sequence`."""
    robot, incarnation = stream
    return m.VersionEntry(robot=robot, incarnation=incarnation, sequence=sequence)


def receivable(fused: m.FusedMap) -> m.FusedMap:
    """Reduce a map to what every receiver accepts, with `reasons` for omissions."""
    if find_error(fused) is None:
        return fused
    refusals = []
    if not 0.0 <= fused.chi2 <= 1e300:
        refusals.append(f"the cost of the map is left out: it is {fused.chi2:g}")
        fused = msgspec.structs.replace(fused, chi2=0.0, dof=0)
    fused, left_out = translate.make_receivable(fused)
    return msgspec.structs.replace(fused, reasons=(*fused.reasons, *refusals, *left_out))
