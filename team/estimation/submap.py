"""What a robot sends: one Gaussian over (end pose, landmarks) in the submap's own frame."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt32


@dataclass(frozen=True)
class LocalMap:
    """N(mean, covariance) of (end pose, landmark 1, …, landmark L) in the frame of its start pose.

    ids:        landmark identities, strictly ascending.
    mean:       (x [m], y [m], theta [rad], x₁, y₁, …), theta in (−π, π].
    covariance: symmetric positive definite, [m², m·rad, rad²].
    The start pose is exactly zero with zero uncertainty: nothing from outside the window is in it.
    """

    ids: UInt32[np.ndarray, " L"]
    mean: Float[np.ndarray, " n"]
    covariance: Float[np.ndarray, "n n"]

    @property
    def end_pose(self) -> Float[np.ndarray, "3"]:
        """start_from_end (x, y, theta)."""
        return self.mean[:3]

    @property
    def landmarks(self) -> Float[np.ndarray, "L 2"]:
        """Landmark positions in the start frame [m]."""
        return self.mean[3:].reshape(-1, 2)
