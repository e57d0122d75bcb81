"""SE(2): poses are (x [m], y [m], theta [rad]); `a_from_b` maps coordinates in b into a.

Perturbations are on the right, in the tangent space of the pose they perturb:
`pose ∘ Exp(xi)` with xi = (forward [m], left [m], turn [rad]). Every function is compiled, works on
single poses and returns a new array.
"""

import math

import numpy as np
from jaxtyping import Float

from team.estimation import elementary
from team.estimation.compiled import compiled, inlined

Pose = Float[np.ndarray, "3"]
Point = Float[np.ndarray, "2"]


@inlined
def wrapped(angle: float) -> float:
    """Wrap an angle to (−π, π]."""
    turns = math.floor((math.pi - angle) / (2.0 * math.pi))
    return angle + 2.0 * math.pi * turns


@compiled
def compose(a_from_b: Pose, b_from_c: Pose) -> Pose:
    """a_from_c = a_from_b ∘ b_from_c."""
    s, c = elementary.sin_and_cos(a_from_b[2])
    return np.array(
        [
            a_from_b[0] + c * b_from_c[0] - s * b_from_c[1],
            a_from_b[1] + s * b_from_c[0] + c * b_from_c[1],
            wrapped(a_from_b[2] + b_from_c[2]),
        ]
    )


@compiled
def composed_with(a_from_b: Pose, poses: Float[np.ndarray, "m 3"]) -> Float[np.ndarray, "m 3"]:
    """Compose a pose with each of several poses."""
    found = np.empty_like(poses)
    for k in range(len(poses)):
        pose = compose(a_from_b, poses[k])
        found[k, 0], found[k, 1], found[k, 2] = pose[0], pose[1], pose[2]
    return found


@compiled
def inverse(a_from_b: Pose) -> Pose:
    """b_from_a."""
    s, c = elementary.sin_and_cos(a_from_b[2])
    return np.array(
        [
            -c * a_from_b[0] - s * a_from_b[1],
            s * a_from_b[0] - c * a_from_b[1],
            wrapped(-a_from_b[2]),
        ]
    )


@compiled
def between(a_from_b: Pose, a_from_c: Pose) -> Pose:
    """b_from_c = a_from_b⁻¹ ∘ a_from_c: the motion from b to c, seen in b."""
    s, c = elementary.sin_and_cos(a_from_b[2])
    dx, dy = a_from_c[0] - a_from_b[0], a_from_c[1] - a_from_b[1]
    return np.array([c * dx + s * dy, -s * dx + c * dy, wrapped(a_from_c[2] - a_from_b[2])])


@compiled
def transformed(a_from_b: Pose, point_in_b: Point) -> Point:
    """The point's coordinates in frame a."""
    s, c = elementary.sin_and_cos(a_from_b[2])
    return np.array(
        [
            a_from_b[0] + c * point_in_b[0] - s * point_in_b[1],
            a_from_b[1] + s * point_in_b[0] + c * point_in_b[1],
        ]
    )


@inlined
def swept(forward: float, left: float, turn: float) -> tuple[float, float]:
    """Compute V(turn)·(forward, left): the end of a constant twist in unit time, without an
    allocation.

    V(θ) = [[sin θ/θ, −(1−cos θ)/θ], [(1−cos θ)/θ, sin θ/θ]]; near θ = 0 the two quotients are taken
    from their series, so the limit is exact and smooth.
    """
    if abs(turn) < 1e-4:
        square = turn * turn
        a = 1.0 - square / 6.0
        b = turn * (0.5 - square / 24.0)
    else:
        s, c = elementary.sin_and_cos(turn)
        a, b = s / turn, (1.0 - c) / turn
    return a * forward - b * left, b * forward + a * left


@compiled
def exponential(xi: Pose) -> Pose:
    """Exp: R³ → SE(2), the motion at constant twist xi = (forward, left, turn) for unit time.

    Exp(xi) = (V(θ)·(xi₀, xi₁), θ) with V of `swept`.
    """
    x, y = swept(xi[0], xi[1], xi[2])
    return np.array([x, y, wrapped(xi[2])])


@inlined
def half_cotangent(turn: float) -> float:
    """(θ/2) cot(θ/2) of a `wrapped` θ, the diagonal of V(θ)⁻¹ (V of `swept`); 1 at θ = 0."""
    half = 0.5 * turn
    s, c = elementary.sin_and_cos_near(half)
    quotient = half / (s / c)
    return 1.0 - half * half / 3.0 if abs(turn) < 1e-4 else quotient


@compiled
def logarithm(pose: Pose) -> Pose:
    """Log: SE(2) → R³, the inverse of `exponential` for |theta| < π."""
    turn = wrapped(pose[2])
    half, a = 0.5 * turn, half_cotangent(turn)
    return np.array([a * pose[0] + half * pose[1], -half * pose[0] + a * pose[1], turn])


@compiled
def adjoint(a_from_b: Pose) -> Float[np.ndarray, "3 3"]:
    """Ad with T ∘ Exp(xi) = Exp(Ad_T xi) ∘ T: carries a perturbation from the right to the left."""
    s, c = elementary.sin_and_cos(a_from_b[2])
    return np.array([[c, -s, a_from_b[1]], [s, c, -a_from_b[0]], [0.0, 0.0, 1.0]])


@compiled
def tangent(heading: float) -> Float[np.ndarray, "3 3"]:
    """∂(x, y, theta)/∂xi of pose ∘ Exp(xi) for a pose of this heading."""
    s, c = elementary.sin_and_cos(heading)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
