"""Detects that the wall clock was set, as on a computer without a battery for its clock.

Such a computer starts with a time of long ago, until the network has told it the true one. The age
of a file that was written before is then wrong by the step.
"""

import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

BOOT, OFFSET = "clock.boot", "clock.offset_s"
STEP_S = 60.0
"""A wall clock that has moved by more than this [s] against the time since boot was set."""


def wall_clock() -> dict[str, str]:
    """Name this boot, and the wall clock minus the time since it [s]; empty where neither is
    reported.
    """
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
        offset_s = time.time() - time.clock_gettime(time.CLOCK_BOOTTIME)
    except (OSError, AttributeError):
        return {}
    return {BOOT: boot, OFFSET: f"{offset_s:.1f}"}


def was_set_since(then: Mapping[str, str]) -> bool:
    """Whether the wall clock was set since `wall_clock` returned `then`, in the same boot."""
    now = wall_clock()
    if not now or then.get(BOOT) != now[BOOT]:
        return False
    with suppress(KeyError, ValueError):
        return abs(float(now[OFFSET]) - float(then[OFFSET])) > STEP_S
    return False
