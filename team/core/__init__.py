"""The native core: the numerical state of a window, and functions with defined bits.

Two builds, for x86-64 of the last decade and with AVX2, give the same bits. The better one that the
processor has is imported; the environment variable TEAMSLAM_CORE (base or avx2) overrides the
choice (docs/core.md).
"""

import os
import sys
from importlib import import_module
from pathlib import Path


def _levels() -> tuple[str, ...]:
    """List the levels that this processor can run, the best first."""
    if chosen := os.environ.get("TEAMSLAM_CORE"):
        return (chosen,)
    try:
        with Path("/proc/cpuinfo").open(encoding="utf-8") as file:
            flags = file.read(4096).partition("flags")[2].partition("\n")[0].split()
    except OSError:
        flags = []
    return ("avx2", "base") if "avx2" in flags else ("base",)


def _import_library() -> None:
    """Import the library of the best level as `teamslam.team.core._core`."""
    for each in _levels():
        try:
            sys.modules[f"{__name__}._core"] = import_module(f"{__name__}._core_{each}")
        except ModuleNotFoundError:
            continue
        return
    raise ImportError(
        "the native core of team is not built: run `make setup`, or"
        " `python team/core/building/backend.py` in a source tree"
    )


_import_library()

from teamslam.team.core._core import (  # noqa: E402 - the level is chosen before
    LARGEST_RATIO,
    NEAREST_M,
    POSE_JITTER,
    Calibration,
    Chain,
    ChainSolution,
    Cholesky,
    Consensus,
    Estimate,
    MotionError,
    MotionModel,
    NotFiniteError,
    NotPositiveDefiniteError,
    Odometry,
    OpenWindow,
    Pattern,
    Quadratic,
    Random,
    Step,
    SubmapFactor,
    SubmapGraph,
    WholeMap,
    Window,
    add_product,
    adjoint,
    atan2,
    between,
    check_angles,
    check_ascending,
    check_blocks,
    check_derivatives,
    check_finite,
    check_named,
    check_packed_covariance,
    check_pose_covariance,
    check_ranges,
    chi2_quantiles,
    cholesky,
    compose,
    compose_motions,
    corrected,
    cos,
    curved_covariance,
    digest,
    effective_sample_size,
    exp,
    expm1,
    exponential,
    factor_or_fault,
    forward,
    hypot,
    inverse,
    inverse_matrix,
    inverse_of_factored,
    landmarks_along_paths,
    largest,
    level,
    linearise_sighting,
    located,
    log,
    log1p,
    logarithm,
    mean_direction,
    minimum_degree,
    moments,
    motion_of_sensor,
    normal_below,
    normalise,
    normalised_square,
    on_group,
    own_blocks,
    packed,
    place,
    pose_bytes,
    predict,
    predicted,
    product,
    reduce_scans,
    sample_factor,
    semidefinite_factor,
    shift_after,
    sin,
    sin_and_cos,
    solve,
    solve_factored,
    spread_of,
    squared,
    systematic_parents,
    tan,
    tangent,
    transformed,
    unpacked,
    width,
    wrapped,
)

__all__ = [
    "LARGEST_RATIO",
    "NEAREST_M",
    "POSE_JITTER",
    "Calibration",
    "Chain",
    "ChainSolution",
    "Cholesky",
    "Consensus",
    "Estimate",
    "MotionError",
    "MotionModel",
    "NotFiniteError",
    "NotPositiveDefiniteError",
    "Odometry",
    "OpenWindow",
    "Pattern",
    "Quadratic",
    "Random",
    "Step",
    "SubmapFactor",
    "SubmapGraph",
    "WholeMap",
    "Window",
    "add_product",
    "adjoint",
    "atan2",
    "between",
    "check_angles",
    "check_ascending",
    "check_blocks",
    "check_derivatives",
    "check_finite",
    "check_named",
    "check_packed_covariance",
    "check_pose_covariance",
    "check_ranges",
    "chi2_quantiles",
    "cholesky",
    "compose",
    "compose_motions",
    "corrected",
    "cos",
    "curved_covariance",
    "digest",
    "effective_sample_size",
    "exp",
    "expm1",
    "exponential",
    "factor_or_fault",
    "forward",
    "hypot",
    "inverse",
    "inverse_matrix",
    "inverse_of_factored",
    "landmarks_along_paths",
    "largest",
    "level",
    "linearise_sighting",
    "located",
    "log",
    "log1p",
    "logarithm",
    "mean_direction",
    "minimum_degree",
    "moments",
    "motion_of_sensor",
    "normal_below",
    "normalise",
    "normalised_square",
    "on_group",
    "own_blocks",
    "packed",
    "place",
    "pose_bytes",
    "predict",
    "predicted",
    "product",
    "reduce_scans",
    "sample_factor",
    "semidefinite_factor",
    "shift_after",
    "sin",
    "sin_and_cos",
    "solve",
    "solve_factored",
    "spread_of",
    "squared",
    "systematic_parents",
    "tan",
    "tangent",
    "transformed",
    "unpacked",
    "width",
    "wrapped",
]
