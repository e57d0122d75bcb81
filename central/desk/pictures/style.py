"""The look and the file format of pictures: for a screen, or for a paper."""

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DPI = 120


class Form(StrEnum):
    """The file format of a picture."""

    PNG = "png"
    SVG = "svg"
    PDF = "pdf"


class Picture(StrEnum):
    """The pictures of a report."""

    MAP = "map"
    ERRORS = "errors"
    CONSISTENCY = "consistency"
    TRAFFIC = "traffic"
    LATENCY = "latency"
    TIMELINE = "timeline"


class Look(StrEnum):
    """For a screen with titles; for a paper without, since the caption has them."""

    SCREEN = "screen"
    PAPER = "paper"


@dataclass(frozen=True)
class Style:
    """The look and the form of every picture of a report; only: the one picture that is drawn."""

    look: Look = Look.SCREEN
    form: Form = Form.PNG
    only: Picture | None = None

    @property
    def drawn(self) -> tuple[Picture, ...]:
        """The pictures that are drawn."""
        return tuple(Picture) if self.only is None else (self.only,)


SCREEN = Style()
_current: ContextVar[Style] = ContextVar("style", default=SCREEN)


@contextmanager
def drawn_in(style: Style) -> Iterator[None]:
    """Pictures that are drawn in this context have this style."""
    from matplotlib import rc_context, rcParams

    token = _current.set(style)
    try:
        with rc_context():
            if style.look is Look.PAPER:
                rcParams["font.family"] = "serif"
                rcParams["pdf.fonttype"] = 42
                rcParams["svg.fonttype"] = "none"
                rcParams["axes.linewidth"] = 0.6
            yield
    finally:
        _current.reset(token)


def save(figure: "Figure", path: Path) -> None:
    """Write a picture in the format of its name's suffix; for a paper without its titles."""
    if _current.get().look is Look.PAPER:
        figure.suptitle("")
        if len(figure.axes) == 1:
            figure.axes[0].set_title("")
    figure.savefig(path, dpi=DPI)
