"""The experiments by name."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple


class Entry(NamedTuple):
    """Command, module, summary.

    module: has `outcome`, or `module:object`. seeds: by default, with --quick, at most in `all`.
    """

    name: str
    module: str
    summary: str
    seeds: int = 30
    quick_seeds: int = 5
    seeds_in_all: int = 30


@dataclass(frozen=True)
class Study:
    """Experiment and the options that determine its runs."""

    experiment: str
    seeds: int | None
    first: int
    quick: bool
    datasets: Sequence[str]


ENTRIES = (
    Entry(
        "accuracy",
        "accuracy",
        "The team against the batch optimiser: simulated worlds of all sizes, UTIAS sets, goals.",
        seeds=50,
        seeds_in_all=4,
    ),
    Entry(
        "association",
        "association",
        "Landmarks without names over spacing, clutter and misses; EKF and FastSLAM beside.",
        seeds=8,
        quick_seeds=1,
        seeds_in_all=2,
    ),
    Entry("ma-3", "ma_figures:FIGURE_3", "Ma & Ma: dead reckoning and FastSLAM on UTIAS.", 1, 1),
    Entry(
        "ma-4a", "ma_figures:FIGURE_4A", "Ma & Ma: path, dead reckoning against FastSLAM.", 10, 1, 5
    ),
    Entry(
        "ma-4b", "ma_figures:FIGURE_4B", "Ma & Ma: path error of FastSLAM, 1400 frames.", 10, 1, 5
    ),
    Entry("ma-4c", "ma_figures:FIGURE_4C", "Ma & Ma: landmark error of FastSLAM.", 10, 1, 5),
    Entry("ma-5", "ma_figures:FIGURE_5", "Ma & Ma: paths of three and of five robots.", 1, 1),
    Entry("ma-6a", "ma_figures:FIGURE_6A", "Ma & Ma: path, one robot against many.", 10, 1, 5),
    Entry("ma-6b", "ma_figures:FIGURE_6B", "Ma & Ma: landmarks, one robot against many.", 10, 1, 5),
    Entry("xu-3.5", "xu_localisation", "Thesis: particle-filter localisation on a known map."),
    Entry("xu-4.1", "xu_maps:FIGURE_4_1", "Thesis: the map of EKF-SLAM."),
    Entry("xu-4.2", "xu_maps:FIGURE_4_2", "Thesis: the map of FastSLAM."),
    Entry("xu-4.3", "xu_maps:FIGURE_4_3", "Thesis: the map of Hybrid-SLAM."),
    Entry("xu-4.4", "xu:FIGURE_4_4", "Thesis: pose error of EKF, FastSLAM, Hybrid."),
    Entry("xu-4.5", "xu_maps:FIGURE_4_5", "Thesis: paths under low and high odometry noise."),
    Entry("xu-4.6", "xu:FIGURE_4_6", "Thesis: error of the first landmark over time."),
    Entry("xu-5.1", "xu_maps:FIGURE_5_1", "Thesis: the two robots' map at four steps."),
    Entry("xu-5.2", "xu:FIGURE_5_2", "Thesis: pose error, one robot against two."),
    Entry("xu-5.3", "xu:FIGURE_5_3", "Thesis: first landmark, one robot against two."),
    Entry("downs-5.1", "downs:TABLE_5_1", "Downs: maps of the EKF, each robot and set."),
    Entry("downs-5.2", "downs:TABLE_5_2", "Downs: paths of the EKF, each robot and set."),
    Entry("downs-5.3", "downs:TABLE_5_3", "Downs: joined maps of one robot, t-test."),
    Entry("downs-5.4", "downs:TABLE_5_4", "Downs: smoothed paths of one robot."),
    Entry("downs-5.5", "downs:TABLE_5_5", "Downs: joined maps of five robots, t-test."),
)
