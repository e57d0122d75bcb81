"""Native core: the numerical state of a window, and functions with defined bits.

Two builds, for x86-64 of the last decade and with AVX2, give the same bits. The best one for the
processor is imported; the environment variable TEAMSLAM_CORE (base or avx2) overrides the choice
(docs/core.md).
"""

import os
import sys
from importlib import import_module
from pathlib import Path


def _levels() -> tuple[str, ...]:
    """List the levels of this processor, the best first."""
    if chosen := os.environ.get("TEAMSLAM_CORE"):
        return (chosen,)
    try:
        with Path("/proc/cpuinfo").open(encoding="utf-8") as file:
            flags = file.read(4096).partition("flags")[2].partition("\n")[0].split()
    except OSError:
        flags = []
    return ("avx2", "base") if "avx2" in flags else ("base",)


def _import_library() -> None:
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

from teamslam.team.core._core import *  # noqa: E402, F403 - the level is chosen before; all is public
