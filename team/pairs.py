"""Which estimator may feed which fusion rule, and the channel that the rule consumes."""

from types import MappingProxyType
from typing import Literal

from team.config import Estimator, FusionRule

Channel = Literal["submap", "own/map"]

PAIRS: MappingProxyType[tuple[Estimator, FusionRule], Channel] = MappingProxyType(
    {
        ("hybrid", "join"): "submap",
        ("hybrid", "kalman"): "own/map",
        ("hybrid", "covariance-intersection"): "own/map",
        ("hybrid", "kalman-per-axis"): "own/map",
        ("hybrid-thesis", "kalman-per-axis"): "own/map",
    }
)
"""(estimator, rule) → what the centre subscribes to. `submap`: independent, each reading once.
`own/map`: whole maps. A pair that is not here has no meaning: the thesis' estimator makes no
submaps and no joint covariance, so only the rule per axis can take it.
"""
FEEDBACK: frozenset[FusionRule] = frozenset(
    {"kalman", "kalman-per-axis", "covariance-intersection"}
)
"""The rules whose map the robots absorb again, in lockstep."""


def named_pairs() -> str:
    """The valid pairs as a user writes them: `hybrid + join, …`."""
    return ", ".join(f"{estimator} + {fusion}" for estimator, fusion in PAIRS)
