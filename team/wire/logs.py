"""The log of a process, whose lines others can neither flood nor forge.

Each place in the program may log AT_ONCE lines, and regains PER_S lines a second; the next line
counts the omitted ones.
"""

import logging

from teamslam.team.wire.text import cut, one_line

AT_ONCE = 50
PER_S = 0.5
LONGEST = 4_000


class Limits(logging.Filter):
    """Limit the rate of records by their place, and escape their texts."""

    def __init__(self) -> None:
        super().__init__()
        self._sites: dict[tuple[str, int], tuple[float, float, int]] = {}

    def filter(self, record: logging.LogRecord) -> bool:
        """Decide whether to log the record, and make its message one printable line."""
        now = record.created
        site = (record.pathname, record.lineno)
        allowance, since, left_out = self._sites.get(site, (float(AT_ONCE), now, 0))
        allowance = min(float(AT_ONCE), allowance + PER_S * max(0.0, now - since))
        if allowance < 1.0:
            self._sites[site] = (allowance, now, left_out + 1)
            return False
        self._sites[site] = (allowance - 1.0, now, 0)
        text = cut(one_line(record.getMessage()), LONGEST)
        if left_out:
            text += f" ({left_out} more like this were left out)"
        elif allowance < 2.0:
            text += " (of more like this some are left out)"
        record.msg, record.args = text, ()
        return True

    def forget(self) -> None:
        """Reset the limits of all places."""
        self._sites.clear()


LIMITS = Limits()
LOG = logging.getLogger("teamslam")
LOG.addFilter(LIMITS)
