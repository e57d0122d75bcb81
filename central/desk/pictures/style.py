"""Style and file format of pictures, for screen or paper."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DPI = 120
PAPER_DPI = 300
COLUMN_IN, TEXT_IN = 3.5, 7.16  # column and text width of a two-column page [inches]
PAPER_PT, POINT_PT = 8.0, 6.0  # text size on paper, and size of point labels [points]
LEAST_IN, MOST_IN = 1.0, 40.0
INCHES = {"in": 1.0, "mm": 1.0 / 25.4, "cm": 1.0 / 2.54, "pt": 1.0 / 72.27}


def parsed_width(text: str) -> float:
    """Parse a width such as 3.5in or 89mm [inches]; raises ValueError."""
    found = re.fullmatch(r"([0-9]+(?:\.[0-9]+)?) ?(in|mm|cm|pt)", text.strip())
    width = float(found[1]) * INCHES[found[2]] if found else 0.0
    if not LEAST_IN <= width <= MOST_IN:
        raise ValueError(
            f"{text}: give a width from {LEAST_IN:g}in to {MOST_IN:g}in, as 3.5in or 89mm"
        )
    return width


class Form(StrEnum):
    """File format of a picture."""

    PNG = "png"
    SVG = "svg"
    PDF = "pdf"


class Picture(StrEnum):
    """Pictures of a report."""

    MAP = "map"
    ERRORS = "errors"
    CONSISTENCY = "consistency"


class Look(StrEnum):
    """Screen pictures have titles; paper pictures have captions instead."""

    SCREEN = "screen"
    PAPER = "paper"


@dataclass(frozen=True)
class Style:
    """Style and format of a report's pictures.

    only: the one picture drawn. width_in: paper width [inches]. vectors: SVG, too.
    """

    look: Look = Look.SCREEN
    form: Form = Form.PNG
    only: Picture | None = None
    width_in: float | None = None
    vectors: bool = False

    def file_name(self, picture: Picture) -> str:
        """File name of a picture."""
        paper = "-paper" if self.look is Look.PAPER and self.form is Form.PNG else ""
        return f"{picture}{paper}.{self.form}"

    @property
    def drawn(self) -> tuple[Picture, ...]:
        """Pictures that are drawn."""
        return tuple(Picture) if self.only is None else (self.only,)


SCREEN = Style()
PAGE = Style(vectors=True)  # screen pictures, with SVG for the page
_current: ContextVar[Style] = ContextVar("style", default=SCREEN)


@contextmanager
def drawn_in(style: Style) -> Iterator[None]:
    """Apply the style within this context."""
    from matplotlib import rc_context, rcParams

    token = _current.set(style)
    try:
        with rc_context({"svg.hashsalt": "teamslam"}):
            if style.look is Look.PAPER:
                rcParams["font.family"] = "serif"
                rcParams["pdf.fonttype"] = 42
                rcParams["svg.fonttype"] = "none"
                rcParams["axes.linewidth"] = 0.6
            yield
    finally:
        _current.reset(token)


def save(figure: "Figure", path: Path) -> None:
    """Write a picture in its suffix's format."""
    style = _current.get()
    if style.look is not Look.PAPER:
        figure.savefig(path, dpi=DPI)
        if style.vectors:
            figure.set_layout_engine("none")  # laid out by the first format
            figure.savefig(path.with_suffix(".svg"), metadata={"Date": None})
        return
    figure.suptitle("")
    if len(figure.axes) == 1:
        figure.axes[0].set_title("")
    _resize(figure, style.width_in)
    figure.savefig(path, dpi=PAPER_DPI)


def _resize(figure: "Figure", width_in: float | None) -> None:
    """Scale to a width: lines and markers shrink, text has PAPER_PT, labels POINT_PT."""
    from matplotlib.lines import Line2D
    from matplotlib.text import Annotation, Text

    width, height = figure.get_size_inches()
    new = width_in or (COLUMN_IN if len(figure.axes) == 1 else TEXT_IN)
    scale, is_column = new / width, new < 0.7 * TEXT_IN
    panels = len(figure.axes) > 1
    figure.set_size_inches(new, height * (max(scale, 0.6) if panels and is_column else scale))
    for text in figure.findobj(Text):
        text.set_fontsize(PAPER_PT)
    for line in figure.findobj(Line2D):
        line.set_markersize(line.get_markersize() * scale)
        line.set_linewidth(line.get_linewidth() * scale)
    for axis in figure.axes:
        axis.tick_params(labelsize=PAPER_PT)
        for patch in axis.patches:
            patch.set_linewidth(patch.get_linewidth() * scale)
        for label in axis.texts:
            label.set_fontsize(POINT_PT)
            if isinstance(label, Annotation):
                label.xyann = tuple(scale * each for each in label.xyann)
        if is_column and panels and axis.get_title():
            axis.set_title("")
        legend = axis.get_legend() if panels else next(iter(figure.legends), None)
        if legend is not None and (is_column or not panels):
            found = axis.get_legend_handles_labels()
            legend.remove()
            below: dict[str, Any] = {"loc": "outside lower center", "fontsize": PAPER_PT}
            if panels:
                at = (0.5, -0.3)
                below = {"loc": "upper center", "bbox_to_anchor": at, "fontsize": POINT_PT}
            owner = axis if panels else figure
            owner.legend(*found, ncols=2 if is_column else 4, frameon=False, **below)
