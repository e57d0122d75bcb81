"""Test by a global optimiser Downs' claim that two robots' maps have one joint minimum.

The shared-map problem is argmin Σ ‖aᵢ − xᵢ‖² + Σ ‖R bᵢ + t − xᵢ‖² over the points x and (t, θ). It
is linear in the points and t, which are eliminated exactly: the minima are those of the profile
C(θ). With the identity C(θ) = c − α cos θ − β sin θ, which has one minimum. With the maps' own
covariances it may have more: the profile is searched on a grid. SciPy's differential evolution, the
successor of his genetic algorithm, searches (t, θ) without a start.
"""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.optimize import Bounds, differential_evolution

from teamslam.central.desk.drawing import BLUE, VERMILION
from teamslam.sim.scenarios.scenario import load, with_options
from teamslam.sim.studies.experiments.downs_joined import spherical_task
from teamslam.sim.studies.experiments.drawing import figure, ruled
from teamslam.sim.studies.experiments.experiment import (
    Options,
    Outcome,
    Picture,
    Results,
    Table,
    without_datasets,
)
from teamslam.sim.studies.experiments.task import Task
from teamslam.sim.studies.experiments.team_runs import Figures, with_world
from teamslam.team.estimation.map_joining.alignment import procrustes
from teamslam.team.estimation.se2 import wrapped
from teamslam.team.shapes import Float

STEPS = 600
"""Steps of his simulator, after which most landmarks were detected."""
DURATION_S = 300.0
GRID = 720
SAME = 1e-3
"""Largest difference [m, rad] of the optimiser's motion from the closed form's."""


class Pair(NamedTuple):
    """Common landmarks of two maps, with each map's covariance."""

    in_a: Float[np.ndarray, "n 2"]
    in_b: Float[np.ndarray, "n 2"]
    of_a: Float[np.ndarray, "m m"]
    of_b: Float[np.ndarray, "m m"]


def tasks(options: Options) -> list[Task]:
    """Two robots in his simulator, and all robots of the sets."""
    return [task for _, task in _runs(options)]


def outcome(options: Options, results: Results) -> Outcome:
    """Minima of each pair of maps, and the optimiser's agreement with the closed form."""
    found: dict[str, Figures] = {}
    for name, task in _runs(options):
        robots = (results.of(task) or {}).get("robots", {})
        names = sorted(robots)
        for k, a in enumerate(names):
            for b in names[k + 1 :]:
                pair = common(robots[a]["map"], robots[b]["map"])
                if len(pair.in_a) > 1:
                    found[f"{name}, {a} and {b}"] = _figures(pair, task.name)
    rows = tuple(
        (
            name, str(f["landmarks"]), str(f["minima"]), str(f["minima_with_covariances"]),
            f"{f['apart']:.1e}", f"{f['cost']:.3g}",
        )
        for name, f in found.items()
    )  # fmt: skip
    several = sum(f["minima_with_covariances"] > 1 for f in found.values())
    remarks = (
        "With the identity the cost over the turn is one cosine, so there is one minimum whatever "
        "the maps are: the search confirms it and could not have found otherwise. With the maps' "
        f"own covariances {several} of {len(found)} pairs have more than one minimum.",
        "His genetic algorithm and its settings are not printed; here differential evolution "
        "searches all turns, and shifts as far as the maps are wide.",
    )
    table = Table(
        "the shared map of two robots",
        ("maps", "landmarks", "minima", "with covariances", "DE − SVD [m, rad]", "cost [m²]"),
        rows,
        "minima over the turn from −180° to 180°; DE − SVD: the largest difference of the motion",
    )
    pictures = (
        Picture(
            "profile",
            "Cost of the shared map over the turn of the second map, the rest at its best: with "
            "the identity and with the maps' covariances, each from its least to its greatest.",
            partial(_draw, found),
        ),
    )
    figures = {
        name: {key: value for key, value in f.items() if not key.startswith("profile")}
        for name, f in found.items()
    }
    missing = () if options.datasets else (without_datasets("the shared maps of real robots"),)
    return Outcome(
        "Downs: one minimum of the shared map",
        {"pairs": figures},
        (table,),
        pictures if found else (),
        remarks=remarks if found else (),
        missing=missing,
    )


def common(a: Figures, b: Figures) -> Pair:
    """Landmarks of both maps."""
    _, in_a, in_b = np.intersect1d(a["ids"], b["ids"], return_indices=True)
    parts = []
    for each, rows in ((a, in_a), (b, in_b)):
        places = (2 * rows[:, None] + np.arange(2)).ravel()
        parts.append(
            (
                np.array(each["means"])[rows],
                np.array(each["covariance"])[np.ix_(places, places)],
            )
        )
    return Pair(parts[0][0], parts[1][0], parts[0][1], parts[1][1])


def profile(pair: Pair, turns: Float[np.ndarray, " K"]) -> Float[np.ndarray, " K"]:
    """C(θ) with the identity: ½ Σ ‖aᵢ − R bᵢ − t‖² at its best t."""
    a, b = pair.in_a - pair.in_a.mean(axis=0), pair.in_b - pair.in_b.mean(axis=0)
    along = float((a * b).sum())
    across = float((a[:, 1] * b[:, 0] - a[:, 0] * b[:, 1]).sum())
    costs: Float[np.ndarray, " K"] = (
        0.5 * float((a * a).sum() + (b * b).sum()) - along * np.cos(turns) - across * np.sin(turns)
    )
    return costs


def profile_with_covariances(pair: Pair, turns: Float[np.ndarray, " K"]) -> Float[np.ndarray, " K"]:
    """C(θ) = min over t of eᵀ (A + R B Rᵀ)⁻¹ e with e = a − R b − t."""
    n = len(pair.in_a)
    shift = np.tile(np.eye(2), (n, 1))
    costs = np.empty(len(turns))
    for k, turn in enumerate(turns.tolist()):
        c, s = np.cos(turn), np.sin(turn)
        R = np.array([[c, -s], [s, c]])
        whole = np.kron(np.eye(n), R)
        L = np.linalg.cholesky(pair.of_a + whole @ pair.of_b @ whole.T)
        e = np.linalg.solve(L, (pair.in_a - pair.in_b @ R.T).ravel())
        G = np.linalg.solve(L, shift)
        t = np.linalg.solve(G.T @ G, G.T @ e)
        costs[k] = float(((e - G @ t) ** 2).sum())
    return costs


def minima(costs: Float[np.ndarray, " K"]) -> int:
    """Number of local minima of a closed curve; plateaus count once."""
    moves = np.sign(np.diff(np.append(costs, costs[0])))
    moves = moves[moves != 0]
    return int(((moves < 0) & (np.roll(moves, -1) > 0)).sum())


def evolved(pair: Pair, seed: int) -> Float[np.ndarray, "3"]:
    """(t [m], θ [rad]) of the least cost found by differential evolution, without a start."""
    wide = 2.0 * float(np.abs(np.concatenate((pair.in_a, pair.in_b))).max()) + 1.0

    def cost(motion: Float[np.ndarray, "3"], /) -> float:
        c, s = np.cos(motion[2]), np.sin(motion[2])
        e = pair.in_a - pair.in_b @ np.array([[c, s], [-s, c]]) - motion[:2]
        return 0.5 * float((e * e).sum())

    result = differential_evolution(
        cost,
        Bounds(np.array([-wide, -wide, -np.pi]), np.array([wide, wide, np.pi])),
        tol=1e-10,
        atol=1e-10,
        rng=np.random.default_rng(seed),
        polish=False,
    )
    return np.asarray(result.x, dtype=np.float64)


def _runs(options: Options) -> list[tuple[str, Task]]:
    found = []
    for name in ("downs-10", "downs-100"):
        for seed in options.seeds:
            scenario = with_options(load(name), robots=2, seed=seed)
            task = spherical_task(with_world(scenario, steps=STEPS))
            found.append((f"{name}, seed {seed}", task))
    for dataset in options.datasets:
        scenario = load("utias")
        if options.quick:
            scenario = with_world(scenario, duration_s=DURATION_S)
        found.append((dataset.name, spherical_task(scenario, dataset)))
    return found


def _figures(pair: Pair, seed: str) -> Figures:
    turns = np.linspace(-np.pi, np.pi, GRID, endpoint=False)
    alike, weighted = profile(pair, turns), profile_with_covariances(pair, turns)
    closed = procrustes(pair.in_a, pair.in_b, np.ones(len(pair.in_a)))
    apart = evolved(pair, int(seed[:8], 16)) - closed
    apart[2] = wrapped(apart[2])
    return {
        "landmarks": len(pair.in_a),
        "minima": minima(alike),
        "minima_with_covariances": minima(weighted),
        "apart": float(np.abs(apart).max()),
        "same": bool(np.abs(apart).max() < SAME),
        "cost": float(profile(pair, np.array([closed[2]]))[0]),
        "profile": alike,
        "profile_with_covariances": weighted,
    }


def _draw(found: dict[str, Figures], path: Path) -> None:
    picture = figure(9.0, 4.0)
    degrees = np.linspace(-180.0, 180.0, GRID, endpoint=False)
    kinds: Sequence[tuple[str, str, str]] = (
        ("profile", "identity, as Downs has it", BLUE),
        ("profile_with_covariances", "the maps' covariances", VERMILION),
    )
    axes = picture.subplots(1, 2, sharey=True)
    for axis, (key, title, colour) in zip(axes, kinds, strict=True):
        for figures in found.values():
            costs = figures[key]
            span = float(np.ptp(costs))
            axis.plot(degrees, (costs - costs.min()) / span, color=colour, alpha=0.4, linewidth=1.0)
        axis.set_title(title, fontsize=11)
        axis.set_xlabel("turn of the second map [°]")
        axis.set_xlim(-180, 180)
        axis.set_xticks([-180, -90, 0, 90, 180])
        ruled(axis)
    axes[0].set_ylabel("cost, least to greatest [1]")
    picture.savefig(path, dpi=120)
