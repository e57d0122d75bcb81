"""Changes of a recomputed run."""

from dataclasses import dataclass

Span = tuple[float, float]
"""Begin and end in seconds since the log's first measurement."""


@dataclass(frozen=True, kw_only=True)
class Changes:
    """Changes of a run on the log's measurements.

    without: robots left out. seed: of estimators and losses. loss, delay_s: of submaps to the
    centre. partitions: robots that the centre cannot reach, and when. noise: factors on assumed
    standard deviations, by kind. maps: saved maps, by path. localise: robots are localised in the
    map, which stays as it is.
    """

    without: tuple[str, ...] = ()
    fusion: str | None = None
    estimator: str | None = None
    particles: int | None = None
    window_s: float | None = None
    seed: int | None = None
    loss: float = 0.0
    delay_s: float = 0.0
    no_centre: Span | None = None
    partitions: tuple[tuple[tuple[str, ...], Span], ...] = ()
    noise: tuple[tuple[str, float], ...] = ()
    maps: tuple[str, ...] = ()
    localise: bool = False
