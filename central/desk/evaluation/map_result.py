"""Final map of a run, and each robot's own map, against the truth."""

import hashlib
from collections.abc import Mapping

import numpy as np

from teamslam.central.desk.evaluation.errors import MapErrors, map_errors, transform_points
from teamslam.central.desk.evaluation.log import Collected
from teamslam.central.desk.evaluation.matching import Gospa, Matching, gospa, half_spacing, nearest
from teamslam.central.desk.evaluation.results import MapResult
from teamslam.central.desk.evaluation.running import TrueLandmarks
from teamslam.team import translate
from teamslam.team.config import UNNAMED
from teamslam.team.estimation.gaussian import Matrix
from teamslam.team.shapes import Bool, Float, UInt32
from teamslam.team.wire import channels as ch
from teamslam.team.wire import messages as m


def map_result(
    log: Collected,
    message: m.FusedMap,
    true: TrueLandmarks,
    label_of: Mapping[int, int],
    truth_from_map: Float[np.ndarray, "3"] | None,
) -> MapResult:
    """Evaluate the final map.

    truth_from_map: motion by which unnamed landmarks are matched to true ones; None: unknown.
    """
    ids, means = translate.landmarks_of(message)
    covariance = translate.landmark_covariance_of(message)
    labels = np.array([label_of.get(i, i) for i in ids.tolist()], np.uint32)
    truth, known = true.match(labels)
    matching = None
    if not label_of and truth_from_map is not None:
        at = transform_points(truth_from_map, means)
        matching = _match_unnamed(ids, at, true, truth, known)
    errors = _errors(means, covariance, truth, known)
    return MapResult(
        rule=message.rule,
        digest=message.digest.hex(),
        payload_sha256=hashlib.sha256(log.latest[ch.FINAL_MAP.key()].payload).hexdigest(),
        frame=message.frame,
        ids=ids,
        means=means,
        covariance=covariance,
        joint=message.joint,
        truth=truth,
        known=known,
        errors=errors,
        cost_per_dof=message.chi2 / message.dof if message.dof > 0 else None,
        reasons=message.reasons,
        diagnosis=tuple(each for each in message.diagnosis if not _is_refuted(each, errors)),
        joined=message.joined,
        withdrawn=message.withdrawn,
        covariance_scale=message.covariance_scale or None,
        lost=message.lost,
        gospa=_gospa(means, errors, true.positions),
        matching=matching,
        changes=message.changes,
    )


def _is_refuted(found: m.Diagnosis, errors: MapErrors | None) -> bool:
    is_small = found.cause == "noise_overestimated"
    return is_small and errors is not None and errors.nees_per_dof > 1.0


def _match_unnamed(
    ids: UInt32[np.ndarray, " L"],
    means: Float[np.ndarray, "L 2"],
    true: TrueLandmarks,
    truth: Float[np.ndarray, "L 2"],
    known: Bool[np.ndarray, " L"],
) -> Matching | None:
    unnamed = np.flatnonzero((ids >= UNNAMED) & ~known)
    free = true.positions[~np.isin(true.ids, ids)]
    found = nearest(means[unnamed], free) if len(unnamed) else None
    if found is None:
        return None
    rows, matching = found
    near = rows >= 0
    truth[unnamed[near]] = free[rows[near]]
    known[unnamed[near]] = True
    return matching


def _gospa(
    means: Float[np.ndarray, "L 2"], errors: MapErrors | None, positions: Float[np.ndarray, "T 2"]
) -> Gospa | None:
    cut_off_m = half_spacing(positions)
    if errors is None or errors.truth_from_map is None or not cut_off_m:
        return None
    return gospa(transform_points(errors.truth_from_map, means), positions, cut_off_m)


def own_map(log: Collected, robot: str, true: TrueLandmarks) -> MapErrors | None:
    """Evaluate a robot's last own map; None without one or without truth."""
    message = log.newest(ch.OWN_MAP, m.MapEstimate, robot)
    if message is None:
        return None
    ids, means = translate.landmarks_of(message)
    truth, known = true.match(ids)
    return _errors(means, translate.landmark_covariance_of(message), truth, known)


def _errors(
    means: Float[np.ndarray, "L 2"],
    covariance: Matrix,
    truth: Float[np.ndarray, "L 2"],
    known: Bool[np.ndarray, " L"],
) -> MapErrors | None:
    rows = np.flatnonzero(np.repeat(known, 2))
    if not known.any():
        return None
    return map_errors(means[known], covariance[np.ix_(rows, rows)], truth[known])
