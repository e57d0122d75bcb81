"""Compiled kernels of inter-robot measurements: range-bearing factors between two poses.

An observer at pose a measures a teammate at pose b: with v = p_b − p_a and ρ = ‖v‖

    r = z − (ρ, wrap(atan2(v_y, v_x) − θ_a)) ~ N(0, R),

∂r/∂p_b = −[v/ρ; (−v_y, v_x)/ρ²], ∂r/∂p_a = −∂r/∂p_b, ∂r/∂θ_a = (0, 1); θ_b does not matter. Each
factor has its own robust weight on √(χ²/2), as a submap has.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int64

from team.estimation import elementary
from team.estimation.compiled import compiled
from team.estimation.geometry import wrapped
from team.estimation.map_joining.joining_kernel import robust_weight
from team.estimation.models import NEAREST_M

Indices = Int64[np.ndarray, " _"]
Values = Float[np.ndarray, " _"]


class InterRobotFactors(NamedTuple):
    """All inter-robot measurements of a graph in flat arrays, in the order of their addition.

    nodes: pose nodes of the observer and of the teammate. first_pair: first of the 2 × 2 member
    pairs of each factor in the pattern's entries.
    """

    nodes: Int64[np.ndarray, "S 2"]
    measurements: Float[np.ndarray, "S 2"]
    information: Float[np.ndarray, "S 2 2"]
    first_pair: int


@compiled
def sighting_residual(
    observer: Values, teammate: Values, measurement: Values
) -> tuple[Values, Float[np.ndarray, "2 6"]]:
    """Compute the residual r and its Jacobian over (observer's pose, teammate's pose)."""
    vx, vy = teammate[0] - observer[0], teammate[1] - observer[1]
    distance = max(math.sqrt(vx * vx + vy * vy), NEAREST_M)
    residual = np.empty(2)
    residual[0] = measurement[0] - distance
    residual[1] = wrapped(measurement[1] - (elementary.atan2(vy, vx) - observer[2]))
    jacobian = np.zeros((2, 6))
    jacobian[0, 0], jacobian[0, 1] = vx / distance, vy / distance
    square = distance * distance
    jacobian[1, 0], jacobian[1, 1], jacobian[1, 2] = -vy / square, vx / square, 1.0
    for i in range(2):
        for j in range(2):
            jacobian[i, 3 + j] = -jacobian[i, j]
    return residual, jacobian


@compiled
def sighting_costs(state: Values, offset: Indices, sightings: InterRobotFactors) -> Values:
    """Compute χ² = rᵀR⁻¹r of each inter-robot measurement."""
    result = np.empty(len(sightings.nodes))
    for f in range(len(result)):
        a, b = offset[sightings.nodes[f, 0]], offset[sightings.nodes[f, 1]]
        r, _ = sighting_residual(state[a : a + 3], state[b : b + 3], sightings.measurements[f])
        metric = sightings.information[f]
        result[f] = (
            metric[0, 0] * r[0] * r[0] + 2.0 * metric[0, 1] * r[0] * r[1] + metric[1, 1] * r[1] ** 2
        )
    return result


@compiled
def _hessian(
    jacobian: Float[np.ndarray, "2 6"], metric: Float[np.ndarray, "2 2"]
) -> Float[np.ndarray, "6 6"]:
    """JᵀR⁻¹J."""
    hessian = np.zeros((6, 6))
    for p in range(6):
        for q in range(6):
            for i in range(2):
                for j in range(2):
                    hessian[p, q] += jacobian[i, p] * metric[i, j] * jacobian[j, q]
    return hessian


@compiled
def add_sightings(
    values: Values,
    gradient: Values,
    state: Values,
    offset: Indices,
    fixed: Bool[np.ndarray, " _"],
    sightings: InterRobotFactors,
    scale: Values,
    entry: Indices,
    value_start: Indices,
) -> None:
    """Add Σ w JᵀR⁻¹J to the pattern's values and Σ w JᵀR⁻¹r to the gradient; scale: robust c of
    each.
    """
    pair = sightings.first_pair
    for f in range(len(sightings.nodes)):
        nodes = sightings.nodes[f]
        a, b = offset[nodes[0]], offset[nodes[1]]
        r, jacobian = sighting_residual(
            state[a : a + 3], state[b : b + 3], sightings.measurements[f]
        )
        metric = sightings.information[f]
        slope = np.empty(2)
        for i in range(2):
            slope[i] = metric[i, 0] * r[0] + metric[i, 1] * r[1]
        weight = robust_weight(r[0] * slope[0] + r[1] * slope[1], 2, scale[f])
        hessian = _hessian(jacobian, metric)
        for i in range(2):
            at = offset[nodes[i]]
            for p in range(3):
                if not fixed[nodes[i]]:
                    for k in range(2):
                        gradient[at + p] += weight * jacobian[k, 3 * i + p] * slope[k]
            for j in range(2):
                if entry[pair] >= 0:
                    base = value_start[entry[pair]]
                    for p in range(3):
                        for q in range(3):
                            values[base + 3 * p + q] += weight * hessian[3 * i + p, 3 * j + q]
                pair += 1


@compiled
def explained_by_sightings(
    state: Values,
    offset: Indices,
    sightings: InterRobotFactors,
    entry: Indices,
    value_start: Indices,
    inverse: Values,
) -> Values:
    """Compute tr(JᵀR⁻¹J Σ) of each factor: the part of its 2 numbers that the solution absorbs."""
    result = np.zeros(len(sightings.nodes))
    pair = sightings.first_pair
    for f in range(len(result)):
        a, b = offset[sightings.nodes[f, 0]], offset[sightings.nodes[f, 1]]
        _, jacobian = sighting_residual(
            state[a : a + 3], state[b : b + 3], sightings.measurements[f]
        )
        hessian = _hessian(jacobian, sightings.information[f])
        for i in range(2):
            for j in range(2):
                if entry[pair] >= 0:
                    base = value_start[entry[pair]]
                    times = 1.0 if i == j else 2.0
                    for p in range(3):
                        for q in range(3):
                            result[f] += (
                                times * hessian[3 * i + p, 3 * j + q] * inverse[base + 3 * p + q]
                            )
                pair += 1
    return result
