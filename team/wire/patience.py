"""When to ask for what is missing: not at once, not again and again, anew when the gap changes."""

from collections.abc import Hashable, Mapping
from dataclasses import dataclass, field
from typing import Generic, TypeVar

PATIENCE_S = 0.5
"""What is on its way needs no question: it has this long to come."""
LONGEST_S = 8.0
"""The time between two equal questions doubles up to this."""
K = TypeVar("K", bound=Hashable)


@dataclass
class Patience(Generic[K]):
    """Gaps by name, since when each stands, and when it is to be asked for next."""

    _gaps: dict[K, tuple[Hashable, float, float]] = field(default_factory=dict)

    def due(self, gaps: Mapping[K, Hashable], now_s: float) -> list[K]:
        """The names of the gaps to ask for now; one that has changed has new patience."""
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
