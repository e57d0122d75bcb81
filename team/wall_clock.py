"""Detect a step of the wall clock, as on a computer whose clock has no battery."""

import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

BOOT, OFFSET = "clock.boot", "clock.offset_s"
STEP_S = 60.0
"""Least change [s] of the wall clock against the time since boot that counts as a step."""


def wall_clock() -> dict[str, str]:
    """Return the boot's id, and wall clock minus time since boot [s]; empty: unavailable."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
        offset_s = time.time() - time.clock_gettime(time.CLOCK_BOOTTIME)
    except (OSError, AttributeError):
        return {}
    return {BOOT: boot, OFFSET: f"{offset_s:.1f}"}


def was_set_since(then: Mapping[str, str]) -> bool:
    """Return whether the wall clock was set since `then`, in the same boot."""
    now = wall_clock()
    if not now or then.get(BOOT) != now[BOOT]:
        return False
    with suppress(KeyError, ValueError):
        return abs(float(now[OFFSET]) - float(then[OFFSET])) > STEP_S
    return False
