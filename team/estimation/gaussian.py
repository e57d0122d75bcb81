"""Gaussians as (mean, covariance), with checks and packings of covariance matrices."""

import math
from typing import NamedTuple

import numpy as np

from teamslam.team import core
from teamslam.team.estimation import dense
from teamslam.team.estimation.se2 import Pose, compose
from teamslam.team.shapes import Float, UInt32

Vector = Float[np.ndarray, " n"]
Matrix = Float[np.ndarray, "n n"]


class PoseGaussian(NamedTuple):
    """N(mean, covariance) of a pose (x [m], y [m], theta [rad]) in the map frame."""

    mean: Float[np.ndarray, "3"]
    covariance: Float[np.ndarray, "3 3"]

    def moved_by(self, step: Pose) -> "PoseGaussian":
        """Compose the pose and an exact motion."""
        end = compose(self.mean, step)
        dx, dy = end[:2] - self.mean[:2]
        F = np.array([[1.0, 0.0, -dy], [0.0, 1.0, dx], [0.0, 0.0, 1.0]])
        return PoseGaussian(end, dense.congruent(F, self.covariance))


def start_of_sensor(
    pose: Pose, covariance: Matrix | None, mount: Pose
) -> tuple[Pose, Matrix | None]:
    """Convert an initial pose of the base to the sensor's; covariance None: exact."""
    if not mount.any():
        return pose, covariance
    found = PoseGaussian(pose, np.zeros((3, 3)) if covariance is None else covariance)
    found = found.moved_by(mount)
    return found.mean, None if covariance is None else found.covariance


class LandmarkGaussian(NamedTuple):
    """Joint Gaussian of landmarks by ascending id: (x₁, y₁, x₂, …) in the map frame [m]."""

    ids: UInt32[np.ndarray, " L"]
    means: Float[np.ndarray, "L 2"]
    covariance: Float[np.ndarray, "n n"]


NO_LANDMARKS = LandmarkGaussian(np.empty(0, np.uint32), np.empty((0, 2)), np.empty((0, 0)))


class NotACovarianceError(ValueError):
    """A covariance is not finite, not symmetric or not positive definite."""

    def __init__(self, what: str, why: str) -> None:
        super().__init__(f"the covariance of {what} is {why}")
        self.what = what
        self.why = why


class NotDeterminedError(ValueError):
    """The submaps leave a node of the graph undetermined."""

    def __init__(self, node: str) -> None:
        super().__init__(f"{node} is not determined by the submaps")
        self.node = node


UNSOLVABLE = (NotDeterminedError, NotACovarianceError, np.linalg.LinAlgError)
"""Exceptions of a solve without a solution: a case to decide on, not a defect."""


class CoreErrors:
    """Context that raises the core's errors as NotACovarianceError."""

    def __enter__(self) -> None:
        """Do nothing."""

    def __exit__(self, _kind: object, error: BaseException | None, _trace: object) -> None:
        """Convert MotionError and NotFiniteError."""
        if isinstance(error, core.MotionError):
            raise NotACovarianceError("the motion", str(error)) from error
        if isinstance(error, core.NotFiniteError):
            raise NotACovarianceError("the window", f"not finite: {error}") from error


def cholesky_factor(covariance: Matrix, what: str) -> Matrix:
    """Compute the lower L with L Lᵀ = covariance; `what` names it in the error.

    Symmetry and rank are relative: a pivot exceeds n ε of its diagonal entry.
    """
    factor, fault = core.factor_or_fault(covariance)
    if fault:
        raise NotACovarianceError(what, FAULTS[fault])
    return factor


FAULTS = ("", "not finite", "not positive definite", "not symmetric")


def deviation(variance: float) -> float:
    """Return the standard deviation; 0 if rounding made the variance negative."""
    return math.sqrt(variance) if variance > 0.0 else 0.0


def information(covariance: Matrix, what: str) -> Matrix:
    """Compute P⁻¹ = L⁻ᵀL⁻¹, exactly symmetric, from the Cholesky factor of P."""
    if not len(covariance):
        return np.zeros((0, 0))
    return dense.inverse_of_factored(cholesky_factor(covariance, what))


def curved(pose: PoseGaussian) -> PoseGaussian:
    """Compute the covariance of (x, y, θ) about pose ∘ Exp(ξ), ξ ~ N(0, S), to second order.

    The position (f, l) + φ/2 (−l, f) adds E[φ²l²]/4 = (S_φφ S_ll + 2 S_lφ²)/4 to the variance of f,
    and so on (Isserlis 1918). The mean stays the most likely pose.
    """
    return PoseGaussian(
        pose.mean, core.curved_covariance(float(pose.mean[2]), np.asarray(pose.covariance))
    )
