from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from matplotlib.figure import Figure
from matplotlib.image import imread
from matplotlib.patches import Ellipse
from matplotlib.text import Text
from PIL import Image

from teamslam.central.desk.compare import compare_rows, draw_maps, filled_rows
from teamslam.central.desk.drawing import ELLIPSE_SCALE, curve_through, ellipses
from teamslam.central.desk.evaluation.evaluation import evaluate
from teamslam.central.desk.pictures import film
from teamslam.central.desk.pictures.run import error_picture, map_picture, new_figure
from teamslam.central.desk.pictures.style import (
    PAPER_DPI,
    PAPER_PT,
    Form,
    Look,
    Style,
    drawn_in,
    save,
)
from teamslam.central.desk.report.tables import team_rows
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.codec import decoded
from tests.sim.logs import joined_log, scenario, without_starts


@pytest.fixture(scope="module")
def run():
    return evaluate(joined_log(scenario(robots=2), 0.1))


@pytest.fixture
def drawn(monkeypatch):
    """The figures that would be saved."""
    found: list[Figure] = []
    for module in ("pictures.run", "compare"):
        name = f"teamslam.central.desk.{module}.save"
        monkeypatch.setattr(name, lambda figure, _: found.append(figure))
    return found


def labels_of(figure: Figure) -> list[str]:
    (legend,) = figure.legends
    return [text.get_text() for text in legend.get_texts()]


@settings(deadline=None, max_examples=50)
@given(a=st.floats(0.1, 5.0), b=st.floats(0.1, 5.0), share=st.floats(-0.95, 0.95))
def test_the_ends_of_the_ellipse_are_at_the_95_percent_distance(a, b, share):
    P = np.array([[a, share * np.sqrt(a * b)], [share * np.sqrt(a * b), b]])
    (major,), (minor,), (turn,) = ellipses(np.array([[P[0, 0], P[0, 1], P[1, 1]]]))
    ends = (
        major * np.array([np.cos(turn), np.sin(turn)]),
        minor * np.array([-np.sin(turn), np.cos(turn)]),
    )
    for end in ends:
        assert end @ np.linalg.solve(P, end) == pytest.approx(ELLIPSE_SCALE**2, rel=1e-6)
    assert major >= minor


@pytest.mark.parametrize("speed", [0.4, -0.4])
def test_between_two_poses_a_path_is_drawn_as_the_arc_that_it_was(speed):
    theta = np.array([0.3, 0.35, 2.0, 3.3])  # landmarks are in sight here; up to 95° between
    radius = speed / 0.2
    arc = np.column_stack([radius * np.sin(theta), -radius * np.cos(theta), theta])
    drawn = curve_through(arc)
    assert len(drawn) > 30
    assert np.abs(np.linalg.norm(drawn, axis=1) - abs(radius)).max() < 0.01 * abs(radius)
    on_the_spot = np.array([[0.0, 0.0, 0.0], [0.01, 0.0, 3.0], [0.01, 0.0, 0.1]])
    assert curve_through(on_the_spot).tolist() == on_the_spot[:, :2].tolist()


def test_the_same_run_draws_the_same_bytes(run, tmp_path):
    for name in ("a.png", "b.png"):
        map_picture(run, tmp_path / name)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_a_robot_without_a_place_in_the_map_is_not_drawn_in_its_frame(run, tmp_path, drawn):
    """Such a path would begin at the origin of the team's map."""
    path = run.robots["r2"].smoothed_path
    nowhere = replace(path, stamps_ns=path.stamps_ns[:0], poses=path.poses[:0])
    alone = replace(run.robots["r2"], smoothed_path=nowhere)
    assert map_picture(replace(run, robots={**run.robots, "r2": alone}), tmp_path / "map.png")
    labels = labels_of(drawn[0])
    assert {"r1", "r2: not in this map"} <= {*labels}
    entry = drawn[0].legends[0].legend_handles[labels.index("r2: not in this map")]
    assert (entry.get_linestyle(), entry.get_marker()) == ("None", "s")  # its start alone is drawn
    assert not any("online" in label for label in labels)


def test_a_run_is_drawn_as_a_film_and_nothing_without_a_map(run, tmp_path, monkeypatch):
    monkeypatch.setattr(film, "FRAMES", 3)
    monkeypatch.setattr(film, "LAST_FRAMES", 1)
    log = joined_log(scenario(robots=2), 0.1)
    maps = [decoded(s.payload, m.FusedMap) for s in log if s.key == ch.FINAL_MAP.key()]
    moving = {n: replace(r, online_path=r.smoothed_path) for n, r in run.robots.items()}
    path = tmp_path / "team.gif"
    done: list[float] = []
    moved = replace(run, robots=moving)
    assert film.draw_film(moved, film.maps_over_time(maps), path, done.append)
    assert done == [0.25, 0.5, 0.75, 1.0]
    with Image.open(path) as drawn:
        assert drawn.format == "GIF"
        assert getattr(drawn, "n_frames", 1) > 1
    assert not film.draw_film(evaluate([]), [], tmp_path / "none.gif")
    assert not (tmp_path / "none.gif").exists()


def test_small_ellipses_are_magnified_with_the_errors_and_the_legend_has_the_factor(
    run, tmp_path, drawn
):
    small = replace(run, map=replace(run.map, covariance=1e-8 * np.eye(len(run.map.covariance))))
    assert map_picture(small, tmp_path / "map.png")
    labels = labels_of(drawn[0])
    assert "landmarks, 95 % ellipses × 100" in labels
    assert "true landmarks, errors × 100" in labels
    (crosses,) = (x for x in drawn[0].axes[0].lines if str(x.get_label()).startswith("true land"))
    error = run.map.truth[run.map.known] - run.map.means[run.map.known]
    expected = run.map.means[run.map.known] + 100 * error
    found = np.column_stack([crosses.get_xdata(), crosses.get_ydata()])
    np.testing.assert_allclose(found[: len(expected)], expected)


def test_changes_since_the_saved_map_are_drawn_as_on_the_page(run, tmp_path, drawn):
    first, second, third = run.map.ids[:3].tolist()
    changes = (
        m.LandmarkChange(landmark=first, state="moved", dx=2.0, dy=1.0),
        m.LandmarkChange(landmark=second, state="gone", dx=0.5),
        m.LandmarkChange(landmark=third, state="new"),
        *(m.LandmarkChange(landmark=i, state="unchanged") for i in run.map.ids[3:].tolist()),
    )
    changed = replace(run, map=replace(run.map, changes=changes))
    assert map_picture(run, tmp_path / "map.png")
    assert map_picture(changed, tmp_path / "map.png")
    before, after = (figure.axes[0] for figure in drawn)
    assert not before.collections
    count = len(run.map.ids)
    assert [len(axis.findobj(Ellipse)) for axis in (before, after)] == [count, count - 1]
    marks = {each.get_label().split()[0]: each for each in after.collections}
    place = dict(zip(run.map.ids.tolist(), run.map.means.tolist(), strict=True))
    gone = [place[second][0] - 0.5, place[second][1]]
    for state, at in (("moved", place[first]), ("gone", gone), ("new", place[third])):
        np.testing.assert_allclose(marks[state].get_offsets(), [at])
        assert not len(marks[state].get_facecolor())
    (arrow,) = (x for x in after.texts if x.arrow_patch is not None)
    np.testing.assert_allclose(arrow.xy, place[first])
    np.testing.assert_allclose(arrow.xyann, np.array(place[first]) - [2.0, 1.0])
    assert dict(team_rows(changed))["landmarks"] == f"{count} in the final map, 1 of them gone"
    assert dict(team_rows(run))["landmarks"] == f"{count} in the final map"


def test_errors_in_an_arbitrary_frame_are_neither_printed_nor_drawn(tmp_path, drawn):
    of = scenario(robots=2)
    run = evaluate(joined_log(without_starts(of), 0.1))
    assert run.arbitrary_frame
    known = evaluate(joined_log(of, 0.1))
    assert not known.arbitrary_frame
    told = dict(team_rows(run))
    assert "arbitrary" in told["landmark RMSE"]
    assert told["after rigid alignment"] != "–"
    assert "map NEES per dof" not in told
    assert not error_picture(run, tmp_path / "errors.png")
    for each in (run, known):
        assert map_picture(each, tmp_path / "map.png")
    texts = [" ".join(labels_of(figure)) for figure in drawn]
    assert ["the frame's own error" in each for each in texts] == [True, False]
    assert compare_rows({"a": run, "b": run})[3] == ("landmark RMSE [m]", ("–", "–"))
    assert "landmark RMSE [m]" not in dict(filled_rows({"a": run, "b": run}))
    assert dict(filled_rows({"a": run, "b": known}))["landmark RMSE [m]"][0] == "–"


def test_compared_maps_in_an_arbitrary_frame_lie_over_the_aligned_truth(tmp_path, drawn):
    of = scenario(robots=2)
    for each in (of, without_starts(of)):
        run = evaluate(joined_log(each, 3.0))
        assert draw_maps({"recorded": run, "recomputed": run}, tmp_path / "maps.png")
    known, arbitrary = (
        next(x for x in figure.axes[0].lines if x.get_label() == "true landmarks").get_xydata()
        for figure in drawn
    )
    np.testing.assert_allclose(known, run.map.means - [3.0, -3.0])
    np.testing.assert_allclose(arbitrary, run.map.means)


@pytest.mark.parametrize(("width_in", "inches"), [(None, 3.5), (2.5, 2.5)])
def test_a_picture_has_the_width_of_the_column_and_its_text_true_to_size(
    tmp_path, width_in, inches
):
    figure, axes = new_figure(9.0, 9.0, 1, 1)
    axes[0][0].plot([0, 1], [0, 1], "o-", label="r1")
    axes[0][0].set_xlabel("x [m]")
    axes[0][0].set_title("a title", fontsize=12)
    axes[0][0].legend(loc="upper center", bbox_to_anchor=(0.5, -0.07))
    with drawn_in(Style(Look.PAPER, Form.PNG, None, width_in)):
        save(figure, tmp_path / "a.png")
    assert np.asarray(imread(tmp_path / "a.png")).shape[1] == round(inches * PAPER_DPI)
    texts = [each for each in figure.findobj(Text) if each.get_text()]
    assert {each.get_fontsize() for each in texts} == {PAPER_PT}
    assert "a title" not in [each.get_text() for each in texts]
