"""Pictures for a paper: their width, their names, and text that stays true to size."""

from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread
from matplotlib.text import Text

from teamslam.central.desk.pictures.run import new_figure
from teamslam.central.desk.pictures.style import (
    PAPER_DPI,
    PAPER_PT,
    Form,
    Look,
    Picture,
    Style,
    drawn_in,
    parsed_width,
    save,
)


@pytest.mark.parametrize(
    ("text", "inches"), [("3.5in", 3.5), ("89mm", 89 / 25.4), ("8.9 cm", 8.9 / 2.54)]
)
def test_a_width_is_read_in_several_units(text: str, inches: float) -> None:
    assert parsed_width(text) == pytest.approx(inches)


@pytest.mark.parametrize("text", ["3.5", "wide", "0.1in", "9000mm", "-3in"])
def test_a_width_that_is_none_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match=r"give a width from 1in to 40in, as 3\.5in or 89mm"):
        parsed_width(text)


def test_png_for_a_paper_does_not_take_the_names_of_the_page() -> None:
    names = [Style(look, Form.PNG).file_name(Picture.MAP) for look in Look]
    assert names == ["map.png", "map-paper.png"]


@pytest.mark.parametrize(("width_in", "inches"), [(None, 3.5), (2.5, 2.5)])
def test_a_picture_has_the_width_of_the_column_and_its_text_true_to_size(
    tmp_path: Path, width_in: float | None, inches: float
) -> None:
    figure, axes = new_figure(9.0, 9.0, 1, 1)
    axes[0][0].plot([0, 1], [0, 1], "o-", label="r1")
    axes[0][0].set_xlabel("x [m]")
    axes[0][0].set_title("a title", fontsize=12)
    axes[0][0].legend(loc="upper center", bbox_to_anchor=(0.5, -0.07))
    with drawn_in(Style(Look.PAPER, Form.PNG, None, width_in)):
        save(figure, tmp_path / "a.png")
    assert np.asarray(imread(tmp_path / "a.png")).shape[1] == round(inches * PAPER_DPI)
    texts = [each for each in figure.findobj(Text) if each.get_text()]  # type: ignore[attr-defined]
    assert {each.get_fontsize() for each in texts} == {PAPER_PT}  # type: ignore[attr-defined]
    assert "a title" not in [each.get_text() for each in texts]  # type: ignore[attr-defined]
