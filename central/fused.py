"""The message of a fused map, as the rules that do not join submaps say it."""

from central.config import CentralConfig
from central.rules import MapEstimate
from team import translate
from team.wire import messages as m
from team.wire.arrays import from_floats, from_ids

START_POSES = "start poses"
"""The frame of a map that lies in the frame in which the robots were told their start poses."""


def fused_message(
    config: CentralConfig,
    digest: bytes,
    value: MapEstimate,
    members: tuple[m.Member, ...],
    *,
    stamp_ns: int,
    final: bool = False,
    joint: bool = True,
    exchange: int = 0,
    frame: str = START_POSES,
    cost: tuple[float, int] = (0.0, 0),
    reasons: tuple[str, ...] = (),
) -> m.FusedMap:
    """A map with its members and the name of its inputs; with landmarks' own covariances only
    unless `joint`. exchange: of the lockstep round, if there are rounds. cost: (χ², dof).
    """
    return m.FusedMap(
        stamp_ns,
        config.fusion,
        digest,
        frame,
        final,
        False,
        exchange,
        members,
        (),
        joint,
        from_ids(value.ids),
        from_floats(value.means),
        translate.covariance_bytes(value.covariance, joint=joint),
        *cost,
        reasons,
    )
