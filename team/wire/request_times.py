"""Times at which missing data are requested: after a delay, then at growing intervals."""

from collections.abc import Hashable, Mapping
from dataclasses import dataclass, field
from typing import Generic, TypeVar

PATIENCE_S = 0.5  # delay [s] before the first request
LONGEST_S = 8.0  # longest interval [s] between two equal requests, which double
K = TypeVar("K", bound=Hashable)


@dataclass
class RequestTimes(Generic[K]):
    """Gaps by name, each with the time of its next request."""

    _gaps: dict[K, tuple[Hashable, float, float]] = field(default_factory=dict)

    def due(self, gaps: Mapping[K, Hashable], now_s: float) -> list[K]:
        """Return the names of the gaps to request now; a changed gap begins anew."""
        self._gaps = {name: known for name, known in self._gaps.items() if name in gaps}
        found = []
        for name, gap in gaps.items():
            known = self._gaps.get(name)
            if known is None or known[0] != gap:
                self._gaps[name] = (gap, now_s + PATIENCE_S, PATIENCE_S)
            elif now_s >= known[1]:
                pause_s = min(2.0 * known[2], LONGEST_S)
                self._gaps[name] = (gap, now_s + pause_s, pause_s)
                found.append(name)
        return found
