"""Batch reference: the MAP over all raw measurements of a log, by GTSAM.

A pose of each robot's sensor per keyframe. Factors: initial poses; odometry, truth = mean ∘ Exp(ξ);
accepted ranges and bearings, under a Cauchy loss with `batch_robust_c`. Noise `white`: independent
errors, without inter-robot measurements; `profile`: see `errors`.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from teamslam.central.desk.evaluation.errors import (
    MapErrors,
    Path,
    distance_rmse,
    interpolate_truth,
    map_errors,
    pose_errors,
)
from teamslam.central.desk.evaluation.evaluation import evaluate
from teamslam.central.desk.evaluation.results import Evaluation, figure
from teamslam.sim.recorded.chains import (
    BatchReferenceError,
    Chain,
    anchor_chain,
    chains_of,
    place_chains,
)
from teamslam.sim.studies.batch_reference.errors import (
    add_errors,
    bias_key,
    has_biases,
    profile_graph,
)
from teamslam.sim.studies.batch_reference.graph import (
    factor_graph,
    joint_covariance,
    landmark_starts,
    load_gtsam,
    newton_step,
    optimizer_of,
    pose_key,
    values_of,
)
from teamslam.team.estimation.gaussian import Matrix, PoseGaussian
from teamslam.team.estimation.se2 import inverse, tangent
from teamslam.team.registry import NotInstalledError
from teamslam.team.shapes import Float, UInt32
from teamslam.team.wire.bus import Sample

LARGEST_DECREMENT = 1e-3  # allowed √(gᵀH⁻¹g) at the optimum; reweighting converges linearly
ITERATIONS = 1000
NoiseKind = Literal["white", "profile"]
NO_BIASES = (None, None, None)


@dataclass(frozen=True)
class BatchReference:
    """Optimum of the batch.

    cost = Σ‖r‖²; initial_cost: at the best start. newton_decrement: √(gᵀH⁻¹g). left_out: robots
    without a known place. biases: (bearing [rad], range offset [m], range scale) by robot. team:
    the run's own map. arbitrary: the frame is.
    """

    ids: UInt32[np.ndarray, " L"]
    means: Float[np.ndarray, "L 2"]
    covariance: Matrix
    errors: MapErrors | None
    cost: float
    initial_cost: float
    gradient_norm: float
    newton_decrement: float
    paths: Mapping[str, Path]
    position_rmse_m: Mapping[str, float]
    final_pose_nees_per_dof: Mapping[str, float]
    robust: bool
    left_out: tuple[str, ...]
    noise: NoiseKind
    biases: Mapping[str, tuple[float, float, float]]
    team: MapErrors | None
    arbitrary: bool = False

    def to_json(self) -> dict[str, Any]:
        """Figures under the names of the JSON output."""
        position_m = {} if self.arbitrary else self.position_rmse_m
        pose_nees = {} if self.arbitrary else self.final_pose_nees_per_dof
        return {
            "noise": self.noise,
            "landmarks": len(self.ids),
            "frame_is_arbitrary": self.arbitrary,
            **_map_figures(self.errors, arbitrary=self.arbitrary),
            "team": _map_figures(self.team, arbitrary=self.arbitrary),
            "cost": self.cost,
            "initial_cost": self.initial_cost,
            "gradient_norm": self.gradient_norm,
            "newton_decrement": self.newton_decrement,
            "robots": {
                robot: {
                    "poses": len(path.stamps_ns),
                    "position_rmse_m": position_m.get(robot),
                    "final_pose_nees_per_dof": pose_nees.get(robot),
                    "bearing_bias_rad": self.biases.get(robot, NO_BIASES)[0],
                    "range_offset_bias_m": self.biases.get(robot, NO_BIASES)[1],
                    "range_scale_bias": self.biases.get(robot, NO_BIASES)[2],
                }
                for robot, path in self.paths.items()
            },
            "robust": self.robust,
            "left_out": list(self.left_out),
        }


def _map_figures(errors: MapErrors | None, *, arbitrary: bool) -> dict[str, Any]:
    placed = None if arbitrary else errors
    return {
        "landmark_rmse_m": figure(placed, "rmse_m"),
        "landmark_rmse_aligned_m": figure(errors, "aligned_rmse_m"),
        "map_nees_per_dof": figure(placed, "nees_per_dof"),
        "map_nees_in_band": figure(placed, "in_band"),
        "shape_nees_per_landmark": figure(errors, "shape.nees_per_landmark"),
        "coverage": figure(placed, "coverage"),
    }


def batch_map(samples: Iterable[Sample], noise: NoiseKind = "white") -> BatchReference:
    """Batch MAP of a log under the rule `join` or `batch`; raises BatchReferenceError."""
    gtsam = _gtsam()
    recorded = list(samples)
    run = evaluate(recorded)
    if run.scenario is None or run.map is None:
        raise BatchReferenceError(
            "the log has no scenario or no final map: record a run to its end"
        )
    chains, anchors, left_out = place_chains(
        chains_of(recorded, run.scenario, sightings=noise == "profile"), run
    )
    if not chains:
        raise BatchReferenceError(
            "no robot's trajectory is in the log: the batch starts from the joined solution, "
            "so run the same scenario and seed with `--fusion join`"
        )
    robust_c = run.scenario.central.batch_robust_c
    fillings = list(
        zip(*(anchor_chain(c, a) for c, a in zip(chains, anchors, strict=True)), strict=True)
    )
    starts = [landmark_starts(chains, poses, run.map) for poses in fillings]
    if noise == "profile":
        descend = _after_step
        sigmas = run.scenario.central.bias_sigma
        graph = profile_graph(gtsam, chains, fillings[0], starts[0], robust_c, sigmas)
    else:
        descend = _optimise
        graph = factor_graph(gtsam, chains, fillings[0], starts[0], robust_c)
    initials = [
        values_of(gtsam, poses, landmarks)
        for poses, landmarks in zip(fillings, starts, strict=True)
    ]
    if noise == "profile":
        initials = [add_errors(gtsam, values, chains) for values in initials]
        initials = [min(initials, key=graph.error)]
    try:
        optimum, figures = _solve(gtsam, graph, initials, descend)
    except RuntimeError as error:
        if isinstance(error, BatchReferenceError):
            raise
        raise BatchReferenceError(f"GTSAM can not solve the batch: {str(error).strip()}") from error
    return _reference_figures(
        gtsam,
        graph,
        optimum,
        chains,
        sorted(starts[0]),
        run,
        robust=robust_c is not None,
        left_out=left_out,
        noise=noise,
        **figures,
    )


def _solve(
    gtsam: Any, graph: Any, initials: Sequence[Any], descend: Callable[[Any, Any, Any], Any]
) -> tuple[Any, dict[str, float]]:
    optima = [descend(gtsam, graph, initial) for initial in initials]
    costs = [2.0 * graph.error(optimum) for optimum in optima]
    initial_cost = min(2.0 * graph.error(initial) for initial in initials)
    best = int(np.argmin(costs))
    if costs[best] > initial_cost:
        raise BatchReferenceError(
            f"the batch cost {costs[best]} lies above its start's, {initial_cost}"
        )
    linear = graph.linearize(optima[best])
    _, decrement = newton_step(gtsam, linear)
    if decrement > LARGEST_DECREMENT:
        raise BatchReferenceError(
            f"the batch has not converged: the next Newton step goes {decrement:.2g} sigma, "
            f"{LARGEST_DECREMENT:g} allowed"
        )
    return optima[best], {
        "cost": costs[best],
        "initial_cost": initial_cost,
        "gradient_norm": float(linear.gradientAtZero().norm()),
        "newton_decrement": decrement,
    }


def _gtsam() -> Any:
    try:
        return load_gtsam()
    except NotInstalledError as error:
        raise BatchReferenceError(str(error)) from None


def _optimise(gtsam: Any, graph: Any, initial: Any) -> Any:
    return optimizer_of(gtsam, graph, initial, ITERATIONS).optimize()


def _after_step(gtsam: Any, graph: Any, initial: Any) -> Any:
    """Gauss-Newton with step halving, five times faster than GTSAM's solver here."""
    values, cost = initial, graph.error(initial)
    for _ in range(ITERATIONS):
        step, decrement = newton_step(gtsam, graph.linearize(values))
        if decrement < LARGEST_DECREMENT:
            break
        for halvings in range(30):
            trial = values.retract(step.scale(0.5**halvings))
            lower = graph.error(trial)
            if lower < cost:
                break
        else:
            break
        values, cost = trial, lower
    return values


def _reference_figures(
    gtsam: Any,
    graph: Any,
    optimum: Any,
    chains: Sequence[Chain],
    landmarks: Sequence[int],
    run: Evaluation,
    **figures: Any,
) -> BatchReference:
    assert run.map is not None
    marginals = gtsam.Marginals(graph, optimum)
    ids = np.array(landmarks, dtype=np.uint32)
    means = np.array([optimum.atPoint2(i) for i in landmarks])
    covariance = joint_covariance(marginals, landmarks)
    truth = dict(
        zip(run.map.ids[run.map.known].tolist(), run.map.truth[run.map.known], strict=True)
    )
    known = [k for k, i in enumerate(landmarks) if i in truth]
    rows = np.array([2 * k + axis for k in known for axis in range(2)], dtype=np.int64)
    paths, errors, nees, biases = {}, {}, {}, {}
    for c, chain in enumerate(chains):
        robot, last = chain.config.id, pose_key(c, len(chain.increments))
        keys = range(pose_key(c, 0), last + 1)
        poses = [optimum.atPose2(key) for key in keys]
        sensor = np.array([[p.x(), p.y(), p.theta()] for p in poses])
        path = Path(chain.stamps_ns, chain.of_base(sensor))
        true_path = run.robots[robot].truth
        true_poses, seen = interpolate_truth(true_path, path.stamps_ns)
        paths[robot] = path
        if figures["noise"] == "profile" and has_biases(chain):
            turned, offset, scaled = optimum.atPoint3(bias_key(c)).tolist()
            biases[robot] = (turned, offset, scaled)
        if seen.any():
            errors[robot] = distance_rmse(path.poses[seen, :2], true_poses[seen, :2])
        turn = tangent(sensor[-1, 2])
        P = turn @ marginals.marginalCovariance(last) @ turn.T
        P = PoseGaussian(sensor[-1], P).moved_by(inverse(chain.mount)).covariance
        end = pose_errors(Path(path.stamps_ns[-1:], path.poses[-1:]), P[np.newaxis], true_path)
        if end is not None:
            nees[robot] = end.nees_per_dof
    return BatchReference(
        ids=ids,
        means=means,
        covariance=covariance,
        errors=map_errors(
            means[known],
            covariance[np.ix_(rows, rows)],
            np.array([truth[landmarks[k]] for k in known]),
        )
        if known
        else None,
        paths=paths,
        position_rmse_m=errors,
        final_pose_nees_per_dof=nees,
        biases=biases,
        team=run.map.errors,
        arbitrary=run.arbitrary_frame,
        **figures,
    )
