"""Curves over many seeds on common times, and picture style."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from teamslam.central.desk.drawing import MAP_COLOUR, draw_ellipses
from teamslam.team.shapes import Float

if TYPE_CHECKING:  # Matplotlib is slow to import
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BAND = (0.1, 0.9)


@dataclass(frozen=True)
class Curves:
    """Errors and sigmas of S runs at K times; NaN before a first value.

    nees: mean per degree of freedom.
    """

    times_s: Float[np.ndarray, " K"]
    errors: Float[np.ndarray, "S K"]
    sigmas: Float[np.ndarray, "S K"]
    nees: Float[np.ndarray, " S"] | None

    @classmethod
    def on(
        cls,
        times_s: Float[np.ndarray, " K"],
        runs: Sequence[Mapping[str, Any]],
        *,
        stepwise: bool,
    ) -> Self:
        """Sample the runs at these times. stepwise: hold values."""
        nees = [float(np.mean(run["nees"])) for run in runs if "nees" in run]
        return cls(
            times_s,
            np.array([sample_curve(times_s, run, "error_m", stepwise=stepwise) for run in runs]),
            np.array([sample_curve(times_s, run, "sigma_m", stepwise=stepwise) for run in runs]),
            np.array(nees) if nees else None,
        )

    def quantile(self, share: float) -> Float[np.ndarray, " K"]:
        """Quantile over the runs at each time; NaN without a value."""
        values = np.full(len(self.times_s), np.nan)
        there = ~np.isnan(self.errors).all(axis=0)
        values[there] = np.nanquantile(self.errors[:, there], share, axis=0)
        return values

    def rms(self) -> Float[np.ndarray, " S"]:
        """Root mean square over time of each run."""
        means: Float[np.ndarray, " S"] = np.sqrt(np.nanmean(self.errors**2, axis=1))
        return means


def sample_curve(
    times_s: Float[np.ndarray, " K"], run: Mapping[str, Any], name: str, *, stepwise: bool
) -> Float[np.ndarray, " K"]:
    """Sample a curve; stepwise: hold values."""
    stamps, values = np.array(run["time_s"]), np.array(run[name])
    if not len(stamps):
        return np.full(len(times_s), np.nan)
    if not stepwise:
        between: Float[np.ndarray, " K"] = np.interp(times_s, stamps, values)
        return between
    place = np.searchsorted(stamps, times_s + 1e-6, side="right") - 1
    found: Float[np.ndarray, " K"] = np.where(place < 0, np.nan, values[np.maximum(place, 0)])
    return found


def spread(values: Float[np.ndarray, " S"]) -> dict[str, float]:
    """Median and band over runs, for machines."""
    low, middle, high = np.nanquantile(values, (BAND[0], 0.5, BAND[1]))
    return {"median": float(middle), "p10": float(low), "p90": float(high)}


def figure(width: float, height: float) -> "Figure":
    """Create a figure on Agg without pyplot's global state."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    made = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(made)
    return made


def draw_map(
    axis: "Axes",
    means: Sequence[Sequence[float]],
    blocks: Sequence[Any],
    colour: str = MAP_COLOUR,
    label: str | None = None,
) -> None:
    """Draw landmarks with 95 % ellipses. blocks: 2 × 2 covariances [m²]."""
    dots = np.array(means, dtype=np.float64).reshape(-1, 2)
    axis.plot(*dots.T, linestyle="", marker=".", color=colour, zorder=5, label=label)
    draw_ellipses(axis, dots, np.array(blocks).reshape(-1, 2, 2), colour, zorder=5)


def as_map(axis: "Axes", **equal: Any) -> None:
    """Set axes in metres with equal scales."""
    axis.set_aspect("equal", **equal)
    axis.set_xlabel("x [m]")
    axis.set_ylabel("y [m]")
    add_grid(axis)


def add_grid(axis: "Axes") -> None:
    """Draw a grid behind the curves."""
    axis.grid(color="#e4e4e4", linewidth=0.6)
    axis.set_axisbelow(True)
