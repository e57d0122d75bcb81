"""Which estimator may feed which fusion rule, and the channel that the rule consumes."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Literal

from team.config import Estimator, FusionRule

Channel = Literal["submap", "own/map", "measurements"]

MAPPERS: tuple[Estimator, ...] = ("hybrid", "hybrid-thesis", "ekf-slam", "fastslam1", "fastslam2")
AS_CODED: Estimator = "hybrid-thesis-coded"
LOCALISERS: tuple[Estimator, ...] = ("localisation", "dead-reckoning")
_CONSUMES: Mapping[FusionRule, tuple[Channel, tuple[Estimator, ...]]] = {
    "join": ("submap", ("hybrid",)),
    "kalman": ("own/map", ("hybrid",)),
    "covariance-intersection": ("own/map", ("hybrid",)),
    "kalman-per-axis": ("own/map", ("hybrid", "hybrid-thesis", AS_CODED)),
    "latest": ("own/map", MAPPERS),
    "alone": ("own/map", (*MAPPERS, AS_CODED, *LOCALISERS)),
    "svd-join": ("submap", ("hybrid",)),
    "svd-join-spherical": ("submap", ("hybrid",)),
    "joint-fastslam": ("measurements", ("hybrid", "dead-reckoning")),
    "batch": ("measurements", ("hybrid", "dead-reckoning")),
}

PAIRS: Mapping[tuple[Estimator, FusionRule], Channel] = MappingProxyType(
    {
        (estimator, fusion): channel
        for fusion, (channel, estimators) in _CONSUMES.items()
        for estimator in estimators
    }
)
"""(estimator, rule) → what the centre subscribes to. `submap`: independent, each measurement once.
`own/map`: whole maps. `measurements`: the sensor channels; what the robots run is then for their
own poses, so only the default and the cheapest are there. Any other pair has no meaning: only
`hybrid` makes submaps and can absorb a joint map, the thesis' estimator can absorb one per axis,
and who only localises himself has no map to fuse.
"""
CONSUMES: Mapping[FusionRule, Channel] = MappingProxyType(
    {fusion: channel for fusion, (channel, _) in _CONSUMES.items()}
)
"""What each rule's map rests on."""
FEEDBACK: frozenset[FusionRule] = frozenset(
    {"kalman", "kalman-per-axis", "covariance-intersection"}
)
"""The rules whose map the robots absorb again, in lockstep."""
NEEDS_MAP: frozenset[Estimator] = frozenset({"localisation"})
"""The estimators that are told the landmarks."""


def rules_for(estimator: Estimator) -> list[FusionRule]:
    """The rules that an estimator can feed."""
    return [fusion for each, fusion in PAIRS if each == estimator]


def named_pairs() -> str:
    """The valid pairs as a user writes them: `hybrid + join, …`."""
    return ", ".join(f"{estimator} + {fusion}" for estimator, fusion in PAIRS)


_RUNNING = "team.robot.baselines.running:running_estimator"
ESTIMATORS: Mapping[Estimator, str] = MappingProxyType(
    {
        "hybrid": "team.robot.hybrid:HybridEstimator",
        "hybrid-thesis": _RUNNING,
        "hybrid-thesis-coded": _RUNNING,
        "ekf-slam": _RUNNING,
        "fastslam1": _RUNNING,
        "fastslam2": _RUNNING,
        "localisation": _RUNNING,
        "dead-reckoning": _RUNNING,
    }
)
"""Estimator → what makes one (`team.robot.estimator.Factory`), found by `team.registry`."""

RULES: Mapping[FusionRule, str] = MappingProxyType(
    {
        "join": "central.join_rule:JoinRule",
        "kalman": "central.baselines.map_rules:ExchangeRule",
        "kalman-per-axis": "central.baselines.map_rules:ExchangeRule",
        "covariance-intersection": "central.baselines.map_rules:ExchangeRule",
        "latest": "central.baselines.map_rules:LatestRule",
        "alone": "central.baselines.map_rules:AloneRule",
        "svd-join": "central.baselines.svd_rule:SvdJoinRule",
        "svd-join-spherical": "central.baselines.svd_rule:SvdJoinRule",
        "joint-fastslam": "central.baselines.joint_fastslam_rule:JointFastSlamRule",
        "batch": "central.baselines.batch_rule:BatchRule",
    }
)
"""Rule → its `central.rule.FusionRule`, found by `team.registry`."""
