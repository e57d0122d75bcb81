"""Draw a run as an animated GIF."""

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path as FilePath
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from teamslam.central.desk.drawing import (
    MAP_COLOUR,
    TRUE_LANDMARK_COLOUR,
    draw_ellipses,
    robot_colours,
)
from teamslam.central.desk.evaluation.results import Evaluation
from teamslam.central.desk.pictures.run import (
    in_the_maps_frame,
    magnification,
    new_figure,
    set_grid,
)
from teamslam.team import translate
from teamslam.team.estimation.dense import diagonal_blocks
from teamslam.team.shapes import Float
from teamslam.team.wire import messages as m

if TYPE_CHECKING:  # Matplotlib is slow to import
    from matplotlib.axes import Axes

FRAMES, LAST_FRAMES, PER_S = 136, 24, 8  # frames of the run, of its result, and per second: 20 s
SIZE_IN, DPI = 5.0, 96


class _MapAt(NamedTuple):
    """Map at a team time [ns]: landmarks, covariances."""

    stamp_ns: int
    means: Float[np.ndarray, "L 2"]
    blocks: Float[np.ndarray, "L 2 2"]


def maps_over_time(maps: Iterable[m.FusedMap]) -> list[_MapAt]:
    """Sort maps by team time."""
    found = [
        _MapAt(each.stamp_ns, translate.landmarks_of(each)[1], translate.landmark_blocks_of(each))
        for each in maps
    ]
    return sorted(found, key=lambda each: each.stamp_ns)


def draw_film(
    evaluation: Evaluation,
    maps: Sequence[_MapAt],
    path: FilePath,
    progress: Callable[[float], None] = lambda _: None,
) -> bool:
    """Write the GIF of online paths, then the final map; False without a map.

    progress: receives the drawn share.
    """
    from matplotlib.animation import PillowWriter

    evaluation = in_the_maps_frame(evaluation)
    fused = evaluation.map
    paths = {n: r.online_path for n, r in evaluation.robots.items() if len(r.online_path.stamps_ns)}
    if fused is None or not len(fused.ids) or not paths:
        return False
    final = diagonal_blocks(fused.covariance)
    times = magnification(evaluation, final)
    smoothed = [each.smoothed_path for each in evaluation.robots.values()]
    points = [each.poses[:, :2] for each in (*paths.values(), *smoothed)]
    everything = np.vstack([fused.means, *points])
    low, high = everything.min(axis=0), everything.max(axis=0)
    middle, half = 0.5 * (low + high), 0.54 * float((high - low).max())
    first = min(int(each.stamps_ns[0]) for each in paths.values())
    last = max(int(each.stamps_ns[-1]) for each in paths.values())
    colours = robot_colours(evaluation.robots)
    figure, axes = new_figure(SIZE_IN, SIZE_IN, 1, 1)
    axis = axes[0][0]
    writer = PillowWriter(fps=PER_S)
    with writer.saving(figure, str(path), dpi=DPI):
        for frame in range(FRAMES + LAST_FRAMES):
            is_last = frame >= FRAMES
            now = last if is_last else first + (last - first) * frame // (FRAMES - 1)
            _begin_frame(axis, evaluation, middle, half)
            for name, robot in evaluation.robots.items():
                shown = robot.smoothed_path if is_last else robot.online_path
                until = int(np.searchsorted(shown.stamps_ns, now, "right"))
                if until:
                    x, y, heading = shown.poses[:until].T
                    axis.plot(x, y, color=colours[name], linewidth=1.2)
                    axis.plot(
                        x[-1:], y[-1:], color=colours[name], markersize=11, linestyle="",
                        marker=(3, 0, np.degrees(heading[-1]) - 90.0), label=name,
                    )  # fmt: skip
            earlier = [each for each in maps if each.stamp_ns <= now]
            if is_last:
                _draw_map(axis, fused.means, final, times)
            elif earlier:
                _draw_map(axis, earlier[-1].means, earlier[-1].blocks, times)
            axis.set_xlabel("x [m]" + (f"; 95 % ellipses × {times}" if times > 1 else ""))
            axis.set_title(_words(evaluation, (now - first) * 1e-9, is_last=is_last), fontsize=10)
            writer.grab_frame()
            progress((frame + 1) / (FRAMES + LAST_FRAMES))
    return True


def _begin_frame(
    axis: "Axes", evaluation: Evaluation, middle: Float[np.ndarray, "2"], half: float
) -> None:
    axis.clear()
    axis.set_aspect("equal")
    axis.set_xlim(middle[0] - half, middle[0] + half)
    axis.set_ylim(middle[1] - half, middle[1] + half)
    set_grid(axis, "#e4e4e4")
    axis.set_ylabel("y [m]")
    if len(evaluation.true_landmarks):
        axis.plot(
            *evaluation.true_landmarks.T, linestyle="", marker="x", markersize=4,
            color=TRUE_LANDMARK_COLOUR, alpha=0.6,
        )  # fmt: skip


def _draw_map(
    axis: "Axes", means: Float[np.ndarray, "L 2"], blocks: Float[np.ndarray, "L 2 2"], times: int
) -> None:
    axis.plot(*means.T, linestyle="", marker=".", markersize=2, color=MAP_COLOUR)
    draw_ellipses(axis, means, times**2 * blocks, MAP_COLOUR)


def _words(evaluation: Evaluation, seconds: float, *, is_last: bool) -> str:
    if not is_last:
        return f"{evaluation.title}: {seconds:.0f} s"
    errors = None if evaluation.map is None else evaluation.map.errors
    if errors is None or errors.aligned_rmse_m is None:
        return f"{evaluation.title}: final map"
    return f"{evaluation.title}: final map, RMSE {errors.aligned_rmse_m:.2g} m aligned"
