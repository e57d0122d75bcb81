"""Draw the committed baselines for the documentation.

    python -m benchmarks.chart FOLDER

benchmarks.png: each figure and its worst allowed value, in units of the committed value.
growth.png: a tick of the centre over its number of submaps; growth_large.png: of ten robots among a
thousand landmarks.
"""

import argparse
from pathlib import Path

from matplotlib.figure import Figure

from benchmarks.baseline import baselines


def draw_baselines(picture: Path) -> None:
    """Draw a row per figure: a point at 1, a line to the worst allowed."""
    rows = [
        (f"{name}: {figure} ({of['value']:g})", of)
        for name, told in baselines().items()
        for figure, of in told["figures"].items()
    ]
    figure = Figure(figsize=(7.5, 0.26 * len(rows) + 1.0), layout="constrained")
    axes = figure.add_subplot()
    for k, (_, of) in enumerate(rows):
        worst = 1.0 + of["tolerance"] * (1.0 if of["better"] == "less" else -1.0)
        axes.plot([1.0, worst], [k, k], color="tab:orange", linewidth=3.0)
        axes.plot([1.0], [k], "o", color="tab:blue")
    axes.set_yticks(range(len(rows)), [label for label, _ in rows], fontsize=8)
    axes.invert_yaxis()
    axes.set_xlabel("share of the committed value; the line ends at the worst that passes")
    axes.grid(axis="x", alpha=0.4)
    figure.savefig(picture, dpi=110)


def draw_growth(name: str, goal_ms: float, picture: Path) -> None:
    curves = baselines()[name]["curves"]
    figure = Figure(figsize=(6.5, 3.4), layout="constrained")
    axes = figure.add_subplot()
    for label, points in curves.items():
        submaps, took = zip(*points, strict=True)
        axes.plot(submaps, took, "o-", label=label)
    axes.axhline(goal_ms, color="grey", linestyle=":", label="the goal")
    axes.set_xlabel("submaps at the centre")
    axes.set_ylabel("CPU of a tick [ms]")
    axes.set_ylim(bottom=0.0)
    axes.legend(frameon=False)
    figure.savefig(picture, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    folder.mkdir(parents=True, exist_ok=True)
    draw_baselines(folder / "benchmarks.png")
    draw_growth("growth", 10.0, folder / "growth.png")
    draw_growth("growth-large", 60.0, folder / "growth_large.png")


if __name__ == "__main__":
    main()
