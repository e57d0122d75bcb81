"""Draw the first two tables of a command's output: `terminal.py TEXT PICTURE`."""

import re
import sys
from pathlib import Path

from matplotlib.figure import Figure


def draw_tables(text: str, picture: str) -> None:
    """Draw the tables, which empty lines separate, as a terminal shows them."""
    lines = "\n\n".join(re.split(r"\n\s*\n", text)[:2]).splitlines()
    figure = Figure((6.4, 0.3 + 0.17 * len(lines)), dpi=150, facecolor="#10151c")
    figure.text(
        0.03, 0.97, "\n".join(lines), va="top", size=9, color="#e8eef6", family="DejaVu Sans Mono"
    )
    figure.savefig(picture)


if __name__ == "__main__":
    draw_tables(Path(sys.argv[1]).read_text("utf-8"), sys.argv[2])
