"""The native core: the numerical state of a window, and functions with defined bits.

The library is built at two levels, for any x86-64 processor of the last decade and for those with
AVX2; the results have the same bits. The better one that the processor has is imported; the
environment variable TEAMSLAM_CORE (base or avx2) overrides the choice. docs/core.md describes it.
"""

import os
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from team.core import _core_base as _core


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


if not TYPE_CHECKING:
    for _level in _levels():
        try:
            _core = import_module(f"team.core._core_{_level}")
        except ModuleNotFoundError:
            continue
        break
    else:
        raise ImportError(
            "the native core of team is not built: run `make setup`, or"
            " `python team/core/building/backend.py` in a source tree"
        )

digest, level, width = _core.digest, _core.level, _core.width
POSE_JITTER = _core.POSE_JITTER
MotionError, NotFiniteError = _core.MotionError, _core.NotFiniteError
Step, Window = _core.Step, _core.Window
atan2, exp, expm1, hypot = _core.atan2, _core.exp, _core.expm1, _core.hypot
log, log1p, sin_and_cos = _core.log, _core.log1p, _core.sin_and_cos
effective_sample_size, normalise = _core.effective_sample_size, _core.normalise
systematic_parents, mean_direction = _core.systematic_parents, _core.mean_direction
sample_factor, on_group, moments = _core.sample_factor, _core.on_group, _core.moments
landmarks_along_paths = _core.landmarks_along_paths
normalised_square, semidefinite_factor = _core.normalised_square, _core.semidefinite_factor
