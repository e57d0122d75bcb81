"""Figures of a run under their JSON names."""

from collections.abc import Iterable, Mapping
from dataclasses import asdict
from typing import Any

import msgspec

from teamslam.central.desk.evaluation.association import AssociationResult
from teamslam.central.desk.evaluation.results import Evaluation, figure
from teamslam.central.desk.evaluation.states import NO_MEMBER, RobotState
from teamslam.central.diagnosis import to_object
from teamslam.team.wire import messages as m

# A program compares causes; texts are for people.
_NOT_JOINED = (
    (NO_MEMBER, "no_submaps"),
    ("disagree", "maps_disagree"),
    ("leave two places", "ambiguous"),
    ("margin", "ambiguous"),
    ("needed", "too_little_shared"),
    ("shared", "too_little_shared"),
)
_ABSENT = {
    "not joined": (_NOT_JOINED, "no_place_found"),
    "withdrawn": ((("by central:", "contradicts_the_rest"),), "ordered"),
}
_WARNINGS = (
    ("is not in the team's map:", "saved_map_not_joined"),
    ("left out", "landmarks_left_out"),
    ("refused", "refused"),
    ("placed weakly", "weak_heading"),
    ("farther off than its covariance", "nonlinear"),
    ("was lost", "weak_heading"),
    ("two places look alike", "places_alike"),
    ("odometry alone", "odometry_alone"),
    ("not settled", "not_settled"),
    ("no full solution", "no_solution"),
    ("another map fits", "wrong_minimum"),
    ("does not fit its submaps", "misfit"),
    ("contradict each other", "robots_contradict"),
    ("not calibrated", "not_calibrated"),
    ("claim to be surer", "covariance_raised"),
    ("measurement times", "clocks"),
)
_TEAM = {
    "scenario": "scenario.name",
    "seed": "scenario.seed",
    "estimator": "scenario.estimator",
    "fusion": "scenario.fusion",
    "landmarks_with_truth": "map.errors.count",
    "landmark_rmse_m": "map.errors.rmse_m",
    "landmark_rmse_aligned_m": "map.errors.aligned_rmse_m",
    "map_nees_per_dof": "map.errors.nees_per_dof",
    "map_nees_band": "map.errors.band",
    "map_nees_in_band": "map.errors.in_band",
    "shape_nees_per_landmark": "map.errors.shape.nees_per_landmark",
    "shape_coverage_95": "map.errors.shape.coverage",
    "landmark_coverage_95": "map.errors.coverage",
    "joint_cost_per_dof": "map.cost_per_dof",
    "joint_cost_per_dof_by_robot": "cost_by_robot",
    "covariance_scale": "map.covariance_scale",
    "covariance_scale_by_robot": "scale_by_robot",
    "final_map_digest": "map.digest",
    "final_map_frame": "map.frame",
    "peers_that_differ": "disagreement",
    "frame_is_arbitrary": "arbitrary_frame",
    "verdicts": "verdicts",
    "gps_median_m": "gps_median_m",
    "unsound_messages": "unsound",
    "notes": "notes",
    "faults": "faults",
}
_ROBOT = {
    "steps": "consumption.steps",
    "measurements_published": "consumption.published",
    "measurements_consumed": "consumption.consumed",
    "measurements_used": "consumption.used",
    "measurements_rejected": "consumption.rejected",
    "measurements_open": "consumption.open",
    "detections_rejected": "consumption.gated",
    "measurements_used_once": "consumption.each_once",
    "ledger": "consumption.ledger",
    "submaps": "consumption.submaps",
    "position_rmse_m": "smoothed.position_rmse_m",
    "heading_rmse_rad": "smoothed.heading_rmse_rad",
    "pose_nees_per_dof": "smoothed.nees_per_dof",
    "pose_coverage_95": "smoothed.coverage",
    "final_pose_nees_per_dof": "final_pose_nees_per_dof",
    "position_rmse_aligned_m": "aligned_rmse_m",
    "aligned_by": "alignment",
    "online_position_rmse_m": "online.position_rmse_m",
    "online_heading_rmse_rad": "online.heading_rmse_rad",
    "online_pose_nees_per_dof": "online.nees_per_dof",
    "online_pose_coverage_95": "online.coverage",
    "online_position_rmse_aligned_m": "online_aligned_rmse_m",
    "online_channel": "online_channel",
    "own_map_landmarks": "own_map.count",
    "own_map_rmse_m": "own_map.rmse_m",
    "own_map_rmse_aligned_m": "own_map.aligned_rmse_m",
    "own_map_nees_per_dof": "own_map.nees_per_dof",
    "own_map_nees_in_band": "own_map.in_band",
    "uplink_bytes": "uplink_bytes",
    "uplink_bytes_per_step": "uplink_bytes_per_step",
}
IN_THE_FRAME = frozenset({
    "landmark_rmse_m", "map_nees_per_dof", "map_nees_band", "map_nees_in_band",
    "landmark_coverage_95", "position_rmse_m", "heading_rmse_rad", "pose_nees_per_dof",
    "pose_coverage_95", "final_pose_nees_per_dof", "online_position_rmse_m",
    "online_heading_rmse_rad", "online_pose_nees_per_dof", "online_pose_coverage_95",
    "own_map_rmse_m", "own_map_nees_per_dof", "own_map_nees_in_band",
})  # fmt: skip
"""Unaligned figures, meaningless in an arbitrary frame."""
_SCORES = {each: each for each in ("precision", "recall", "f1", "wrong_percent")}
_SAME_NAMES = (
    "landmarks", "duplicates", "duplicates_confirmed", "duplicates_shown", "merges_right",
    "merges_wrong", "merges_refused",
)  # fmt: skip
_ASSOCIATION = {each: each for each in _SAME_NAMES} | {
    "labelled_detections": "pairs.detections",
    "labelled_detections_left_out": "left_out",
    "unlabelled_detections_in_the_map": "clutter_in_map",
}


def _named(of: object, paths: Mapping[str, str], *, arbitrary: bool = False) -> dict[str, Any]:
    absent = IN_THE_FRAME if arbitrary else frozenset()
    found = {name: None if name in absent else figure(of, path) for name, path in paths.items()}
    return {name: list(of) if isinstance(of, tuple) else of for name, of in found.items()}


def to_json(evaluation: Evaluation, extra: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Figures under their JSON names; `extra` adds some."""
    fused, association = evaluation.map, evaluation.association
    states, arbitrary = evaluation.states, evaluation.arbitrary_frame
    gospa, matching = figure(fused, "gospa"), figure(fused, "matching")
    return {
        **_named(evaluation, _TEAM, arbitrary=arbitrary),
        "landmarks": fused and len(fused.ids),
        "landmark_matching": matching and asdict(matching),
        "map_covariance": fused and ("joint" if fused.joint else "blocks"),
        "final_map_sha256": None if evaluation.disagreement else figure(fused, "payload_sha256"),
        "gospa": gospa and asdict(gospa),
        "joined": [] if fused is None else list(fused.joined),
        "changes": [] if fused is None else [_change(each) for each in fused.changes],
        "data_set": evaluation.data_set or None,
        "diagnosis": [to_object(each) for each in evaluation.diagnosis],
        "not_joined": _absent_robots(states, "not joined"),
        "withdrawn": _absent_robots(states, "withdrawn"),
        "warnings": [
            {"cause": _cause(each, _WARNINGS, "other"), "text": each}
            for each in evaluation.other_warnings
        ],
        "robot_states": {name: of._asdict() for name, of in states.items()},
        "robots": {
            name: _named(robot, _ROBOT, arbitrary=arbitrary)
            | {"online_in_team_frame": not robot.outside}
            for name, robot in evaluation.robots.items()
        },
        "peers": {name: asdict(peer) for name, peer in evaluation.peers.items()},
        "channels": {key: asdict(traffic) for key, traffic in evaluation.channels.items()},
        "association": association and association_json(association),
        "association_decisions": [msgspec.structs.asdict(each) for each in evaluation.decisions],
        "reference_rmse_m": association and figure(fused, "errors.aligned_rmse_m"),
        **(extra or {}),
    }


def association_json(result: AssociationResult) -> dict[str, Any]:
    """Scores under their JSON names."""
    windows = {"windows": _named(result.inside, _SCORES)}
    return _named(result.pairs, _SCORES) | windows | _named(result, _ASSOCIATION)


def _change(change: m.LandmarkChange) -> dict[str, Any]:
    found = msgspec.structs.asdict(change)
    return {f"{k}_m" if k in ("dx", "dy", "sigma") else k: v for k, v in found.items()}


def _cause(text: str, table: Iterable[tuple[str, str]], otherwise: str) -> str:
    return next((cause for words, cause in table if words in text), otherwise)


def _absent_robots(states: Mapping[str, RobotState], state: str) -> list[dict[str, str]]:
    table, otherwise = _ABSENT[state]
    return [
        {"robot": robot, "cause": _cause(of.why, table, otherwise), "text": of.why}
        for robot, of in states.items()
        if of.state == state
    ]
