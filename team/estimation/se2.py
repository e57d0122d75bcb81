"""SE(2): poses are (x [m], y [m], theta [rad]); `a_from_b` maps coordinates in b into a.

Perturbations are on the right: `pose ∘ Exp(xi)`, xi = (forward [m], left [m], turn [rad]).
"""

import numpy as np

from teamslam.team.core import (
    adjoint,
    between,
    compose,
    exponential,
    inverse,
    logarithm,
    sin_and_cos,
    tangent,
    transformed,
    wrapped,
)
from teamslam.team.shapes import Float

__all__ = [
    "Point",
    "Pose",
    "adjoint",
    "between",
    "compose",
    "exponential",
    "inverse",
    "logarithm",
    "rotation",
    "tangent",
    "transformed",
    "wrapped",
]

Pose = Float[np.ndarray, "3"]
Point = Float[np.ndarray, "2"]


def rotation(angle: float) -> Float[np.ndarray, "2 2"]:
    """Return the rotation matrix of an angle."""
    s, c = sin_and_cos(angle)
    return np.array([[c, -s], [s, c]])
