"""Palette, robot colours and covariance ellipses of all views."""

from collections.abc import Collection, Iterable
from typing import TYPE_CHECKING

import numpy as np

from teamslam.central.desk.names import in_order
from teamslam.team.shapes import Float

if TYPE_CHECKING:
    from matplotlib.axes import Axes

BLUE, VERMILION, GREEN, PURPLE, SKY, ORANGE = (
    "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00"
)  # fmt: skip
"""Okabe and Ito's colour-blind-safe colours."""
RED, BLACK, GREY = "#C00000", "#111111", "#7a7a7a"
MAP_COLOUR, TRUTH_COLOUR, TRUE_LANDMARK_COLOUR = BLACK, GREY, RED
ROBOT_COLOURS = (
    "#3b9dff", "#ff7a33", "#19c37d", "#e667b3", "#f2c230", "#9a7bff", "#33c7d9", "#ff5d6c",
    "#a3c644", "#c79a6b",
)  # fmt: skip
"""Robot colours in order of name, for dark and light ground."""
ELLIPSE_SCALE = float(np.sqrt(5.991))
"""Mahalanobis distance that contains 95 % of a planar Gaussian."""
BENT_RAD = 0.09  # heading difference [rad] above which a path segment is drawn as a curve


def colour_of(number: int) -> str:
    """Colour of a robot number as #rrggbb."""
    return ROBOT_COLOURS[number % len(ROBOT_COLOURS)]


def robot_colours(names: Iterable[str]) -> dict[str, str]:
    """Colour of each robot."""
    return {name: colour_of(number) for number, name in enumerate(in_order(names))}


def robot_labels(names: Collection[str]) -> dict[str, str]:
    """Legend entry of each robot, or one for all; Matplotlib omits "_"."""
    ordered = in_order(names)
    if len(ordered) <= len(ROBOT_COLOURS):
        return {name: name for name in ordered}
    return {
        name: "_" if number else f"{len(ordered)} robots" for number, name in enumerate(ordered)
    }


def curve_through(poses: Float[np.ndarray, "K 3"]) -> Float[np.ndarray, "N 2"]:
    """Sample a curve through poses that follows their headings.

    It is the cubic closest to an arc, or the chord where the headings oppose along it.
    """
    if len(poses) < 2:
        return poses[:, :2].copy()
    chords = np.diff(poses[:, :2], axis=0)
    turns = (np.diff(poses[:, 2]) + np.pi) % (2.0 * np.pi) - np.pi
    ahead = np.column_stack([np.cos(poses[:, 2]), np.sin(poses[:, 2])])
    along = np.einsum("ki,ki->k", ahead[:-1], chords), np.einsum("ki,ki->k", ahead[1:], chords)
    lengths = np.linalg.norm(chords, axis=1) / np.cos(0.25 * turns) ** 2
    pieces = np.where(along[0] * along[1] > 0.0, np.ceil(np.abs(turns) / BENT_RAD), 1).astype(int)
    points = [poses[:1, :2]]
    for k, count in enumerate(np.maximum(pieces, 1).tolist()):
        s = np.arange(1, count + 1)[:, np.newaxis] / count
        tangent = np.sign(along[0][k]) * lengths[k] * (s - 2.0 * s**2 + s**3) * ahead[k]
        tangent += np.sign(along[1][k]) * lengths[k] * (s**3 - s**2) * ahead[k + 1]
        bent = poses[k, :2] + (3.0 * s**2 - 2.0 * s**3) * chords[k] + tangent
        points.append(bent if count > 1 else poses[k + 1 : k + 2, :2])
    return np.concatenate(points)


def ellipses(
    blocks: Float[np.ndarray, "L 3"],
) -> tuple[Float[np.ndarray, " L"], Float[np.ndarray, " L"], Float[np.ndarray, " L"]]:
    """Half axes [m] and direction of the major axis [rad] of 95 % ellipses.

    blocks: covariances (xx, xy, yy) [m²].
    """
    xx, xy, yy = blocks.T
    middle, half = 0.5 * (xx + yy), 0.5 * (xx - yy)
    root = np.hypot(half, xy)
    return (
        ELLIPSE_SCALE * np.sqrt(middle + root),
        ELLIPSE_SCALE * np.sqrt(np.maximum(middle - root, 0.0)),
        0.5 * np.arctan2(xy, half),
    )


def draw_ellipses(
    axis: "Axes",
    means: Float[np.ndarray, "L 2"],
    covariances: Float[np.ndarray, "L 2 2"],
    colour: str,
    *,
    width: float = 1.0,
    zorder: float = 1.0,
) -> None:
    """Draw each point's 95 % ellipse."""
    from matplotlib.patches import Ellipse

    major, minor, direction = ellipses(covariances[:, (0, 0, 1), (0, 1, 1)])
    for (x, y), a, b, turn in zip(means.tolist(), major, minor, direction, strict=True):
        axis.add_patch(
            Ellipse(
                (x, y), 2.0 * float(a), 2.0 * float(b), angle=float(np.degrees(turn)),
                fill=False, edgecolor=colour, linewidth=width, zorder=zorder,
            )
        )  # fmt: skip
