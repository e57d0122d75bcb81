"""The table of estimators and fusion rules, and which estimator may feed which rule.

A row names its class as `package.module:name`, loaded when it is chosen (`team.registry`).
"""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Literal, NamedTuple

Channel = Literal["submap", "own/map", "measurements"]
"""The inputs of a rule. submap: independent submaps, each measurement used once. own/map: whole
maps. measurements: the sensor channels; the robots' estimators are then for their own poses."""


class EstimatorRow(NamedTuple):
    """made_by: a `teamslam.sim.studies.robots.filters.Factory`; of `hybrid` its mapper. feeds:
    rules, beside those that name it. needs_map: it is given a prior map.
    """

    made_by: str
    feeds: tuple[str, ...] = ()
    needs_map: bool = False


class RuleRow(NamedTuple):
    """made_by: a `teamslam.central.node.CentralNode`. takes: its estimators, beside those that name
    it. feedback: the robots absorb its map again, in lockstep.
    """

    made_by: str
    consumes: Channel
    takes: tuple[str, ...] = ("hybrid",)
    feedback: bool = False


COMPARISON_ROBOT = "teamslam.sim.studies.robots.node:comparison_robot"
"""Makes the robot's node of a pair whose rule does not fuse submaps."""
_RUNNING = "teamslam.sim.studies.robots.running:RunningEstimator"
_WHOLE = ("latest", "alone")
_ROUNDS = "teamslam.sim.studies.rules.map_rules:RoundsCentre"
_SVD = "teamslam.sim.studies.rules.svd_rule:SvdCentre"
_CHEAP = ("hybrid", "dead-reckoning")
_PER_AXIS = ("hybrid", "hybrid-thesis", "hybrid-thesis-coded")

ESTIMATORS: Mapping[str, EstimatorRow] = MappingProxyType(
    {
        "hybrid": EstimatorRow("teamslam.team.robot.mapper:Mapper"),
        "hybrid-thesis": EstimatorRow(_RUNNING, _WHOLE),
        "hybrid-thesis-coded": EstimatorRow(_RUNNING, ("alone",)),
        "ekf-slam": EstimatorRow(_RUNNING, _WHOLE),
        "fastslam1": EstimatorRow(_RUNNING, _WHOLE),
        "fastslam2": EstimatorRow(_RUNNING, _WHOLE),
        "localisation": EstimatorRow(_RUNNING, ("alone",), needs_map=True),
        "dead-reckoning": EstimatorRow(_RUNNING, ("alone",)),
    }
)
RULES: Mapping[str, RuleRow] = MappingProxyType(
    {
        "join": RuleRow("teamslam.central.node:CentralNode", "submap"),
        "kalman": RuleRow(_ROUNDS, "own/map", feedback=True),
        "kalman-per-axis": RuleRow(_ROUNDS, "own/map", _PER_AXIS, feedback=True),
        "covariance-intersection": RuleRow(_ROUNDS, "own/map", feedback=True),
        "latest": RuleRow("teamslam.sim.studies.rules.map_rules:LatestCentre", "own/map"),
        "alone": RuleRow("teamslam.sim.studies.rules.map_rules:AloneCentre", "own/map"),
        "svd-join": RuleRow(_SVD, "submap"),
        "svd-join-spherical": RuleRow(_SVD, "submap"),
        "joint-fastslam": RuleRow(
            "teamslam.sim.studies.rules.measurement_rules:JointFastSlamCentre",
            "measurements",
            _CHEAP,
        ),
        "batch": RuleRow(
            "teamslam.sim.studies.rules.batch_rule:BatchCentre", "measurements", _CHEAP
        ),
    }
)

PAIRS: Mapping[tuple[str, str], Channel] = MappingProxyType(
    {
        (estimator, rule): RULES[rule].consumes
        for rule in RULES
        for estimator, row in ESTIMATORS.items()
        if estimator in RULES[rule].takes or rule in row.feeds
    }
)
"""(estimator, rule) → the inputs of the centre. Only `hybrid` makes submaps and can absorb a joint
map, the thesis' estimator can absorb one per axis, and a robot that only localises has no map.
"""
FEEDBACK = frozenset(rule for rule, row in RULES.items() if row.feedback)
NEEDS_MAP = frozenset(name for name, row in ESTIMATORS.items() if row.needs_map)


def rules_for(estimator: str) -> list[str]:
    """Return the rules that an estimator can feed."""
    return [rule for each, rule in PAIRS if each == estimator]


def named_pairs() -> str:
    """Format the valid pairs as `hybrid + join, …`."""
    return ", ".join(f"{estimator} + {rule}" for estimator, rule in PAIRS)
