"""Tables 5.1 … 5.5 of J. Downs' thesis, on every given UTIAS set.

Printed figures, his protocol (`downs_joined`) and ours (`utias`), with the profile's models.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
from scipy.stats import ttest_rel

from teamslam.central.desk.drawing import BLUE, ORANGE, RED, SKY, TRUTH_COLOUR, VERMILION
from teamslam.sim.scenarios.scenario import Scenario, load, with_options
from teamslam.sim.studies.experiments.accuracy_utias import team_on
from teamslam.sim.studies.experiments.downs_joined import (
    his_protocol,
    spherical_task,
    whole_run_task,
)
from teamslam.sim.studies.experiments.drawing import add_grid, as_map, draw_map, figure
from teamslam.sim.studies.experiments.experiment import (
    Dataset,
    Options,
    Outcome,
    Picture,
    Results,
    Table,
    Task,
    without_datasets,
)
from teamslam.sim.studies.experiments.team_runs import Figures, table_of, team_task, with_world

Robots = tuple[float, float, float, float, float]

EKF_MAPS: Mapping[str, Robots] = {
    "1": (0.3304, 0.4240, 0.2255, 0.3733, 0.2437),
    "2": (0.3990, 0.1655, 0.6744, 0.3071, 0.5666),
    "3": (0.0599, 0.4383, 0.7593, 0.5151, 0.4371),
    "4": (0.2483, 0.3933, 0.5499, 0.3501, 0.2237),
    "5": (0.1555, 0.3135, 0.3689, 0.5330, 0.3344),
    "6": (0.6738, 0.5618, 0.5167, 0.5235, 0.5974),
    "7": (0.4676, 0.1768, 0.2946, 0.5613, 0.3348),
    "8": (0.2980, 0.2922, 0.1912, 0.7909, 0.1180),
    "9": (0.1874, 0.7517, 0.5520, 0.5976, 0.1405),
}
"""Table 5.1: maps of the EKF, one robot."""
EKF_PATHS: Mapping[str, Robots] = {
    "1": (0.0393, 0.0353, 0.0399, 0.0450, 0.0419),
    "2": (0.0526, 0.0352, 0.0467, 0.0362, 0.0455),
    "3": (0.0391, 0.0381, 0.0620, 0.0602, 0.0347),
    "4": (0.0437, 0.0412, 0.0412, 0.0516, 0.0479),
    "5": (0.0281, 0.0300, 0.0327, 0.0318, 0.0368),
    "6": (0.0563, 0.0557, 0.0634, 0.0609, 0.0474),
    "7": (0.0563, 0.0452, 0.0418, 0.0755, 0.0466),
    "8": (0.0391, 0.0381, 0.0620, 0.0602, 0.0347),
    "9": (0.0415, 0.0672, 0.0471, 0.0595, 0.0420),
}
"""Table 5.2: paths of the EKF, one robot."""
JOINED_MAPS: Mapping[str, Robots] = {
    "1": (0.0501, 0.0055, 0.0110, 0.0164, 0.0146),
    "2": (0.0268, 0.0031, 0.1410, 0.0312, 0.1102),
    "3": (0.0044, 0.0296, 0.0647, 0.1097, 0.0123),
    "4": (0.0345, 0.0212, 0.0046, 0.0008, 0.0302),
    "5": (0.0308, 0.0497, 0.0680, 0.0140, 0.0609),
    "6": (0.0337, 0.0220, 0.0054, 0.0000, 0.0310),
    "7": (0.0337, 0.0220, 0.0054, 0.0000, 0.0310),
    "8": (0.0419, 0.0484, 0.0004, 0.1284, 0.0114),
    "9": (0.0246, 0.0723, 0.0910, 0.0049, 0.0088),
}
"""Table 5.3: joined maps, one robot."""
SMOOTHED_PATHS: Mapping[str, Robots] = {
    "1": (1.3e-4, 2.8e-5, 3.5e-5, 1.4e-4, 6.1e-6),
    "2": (1.1e-4, 5.1e-5, 7.1e-6, 1.2e-4, 3.7e-5),
    "3": (1.4e-4, 6.2e-6, 2.0e-5, 2.1e-4, 2.4e-5),
    "4": (1.5e-4, 1.5e-5, 7.0e-5, 1.6e-4, 2.2e-5),
    "5": (5.8e-6, 9.1e-6, 6.2e-6, 2.3e-5, 2.6e-5),
    "6": (3.6e-5, 7.5e-5, 1.8e-4, 3.0e-5, 1.8e-4),
    "7": (2.0e-5, 9.4e-5, 1.7e-5, 1.5e-4, 6.0e-6),
    "8": (6.8e-7, 1.5e-5, 2.2e-5, 2.8e-6, 2.3e-5),
    "9": (1.6e-6, 1.4e-5, 1.0e-4, 1.3e-5, 7.6e-5),
}
"""Table 5.4: smoothed paths, one robot."""
TEAM_MAPS: Mapping[str, float] = {
    "1": 0.0480, "2": 0.0617, "3": 0.0254, "4": 0.0392, "5": 0.0726,
    "6": 0.0103, "7": 0.0335, "8": 0.0423, "9": 0.0877,
}  # fmt: skip
"""Table 5.5: joined maps of five robots."""
P_EKF_JOINED = 3.04e-4  # chapter 5: paired t-test of tables 5.1 and 5.3
P_JOINED_TEAM = 0.1018  # chapter 5: paired t-test of tables 5.3 and 5.5


Row = tuple[float | None, ...]  # errors [m] of robots 1 … 5, or of the team
Source = Callable[[Options, Dataset, Results], Sequence[Figures]]
"""Computed figures of each column of a table."""
QUICK_S = 300.0
TEAM = "team"


class _Method(NamedTuple):
    """Row of a table: the name of a figure of a source."""

    name: str
    source: Source
    figure: str
    colour: str = ""

    def row(self, options: Options, dataset: Dataset, results: Results) -> Row:
        return tuple(each.get(self.figure) for each in self.source(options, dataset, results))


class _Compared(NamedTuple):
    """Paired t-test: text, printed p, and the other table's rows."""

    text: str
    printed_p: float
    before: tuple[_Method, ...]
    printed_before: Mapping[str, Sequence[float]]


class _PrintedTable(NamedTuple):
    """Table of the thesis. printed: figures by set number.

    sample: run whose map is drawn, as in figure 5.1.
    """

    title: str
    columns: tuple[str, ...]
    printed: Mapping[str, Sequence[float]]
    methods: tuple[_Method, ...]
    remarks: tuple[str, ...]
    compared: _Compared | None = None
    sample: Callable[[Options, Dataset], Task] | None = None

    def outcome(self, options: Options, results: Results) -> Outcome:
        """Rows and pictures of the sets, and the t-tests."""
        if not options.datasets:
            return Outcome(self.title, {}, missing=(without_datasets(self.title),))
        sets = {dataset.name: self._set(options, dataset, results) for dataset in options.datasets}
        table = Table(
            f"{self.title} [m]",
            ("set", *self.columns, "mean", "sd"),
            tuple(
                (f"{name}, {method}", *_cells(row))
                for name, rows in sets.items()
                for method, row in rows.items()
            ),
            "as the map lies; aligned: after the rigid motion that fits the map to the truth",
        )
        tests = self._tests(options, results)
        tables = (table,) if not tests else (table, _test_table(self.compared, tests))
        picture = Picture(
            "errors",
            f"{self.title}: every column of every set, on a logarithmic scale.",
            partial(self._draw, sets),
        )
        pictures = [picture]
        if self.sample is not None:
            for dataset in options.datasets[:1]:
                run = results.of(self.sample(options, dataset))
                if run is not None:
                    pictures.append(_sample_picture(dataset.name, run["sample"]))
        figures: Figures = {"sets": sets, "t_tests": tests}
        remarks = self.remarks
        if options.quick:
            remarks += (f"Quick: only the first {QUICK_S:g} s of each set.",)
        given = {_number(dataset) for dataset in options.datasets}
        absent = [f"MRCLAM_Dataset{number}" for number in self.printed if number not in given]
        missing = (without_datasets(f"{', '.join(absent)} of this table"),) if absent else ()
        return Outcome(
            self.title, figures, tables, tuple(pictures), remarks=remarks, missing=missing
        )

    def _set(self, options: Options, dataset: Dataset, results: Results) -> dict[str, Row]:
        rows = {}
        if (number := _number(dataset)) in self.printed:
            rows["printed"] = tuple(self.printed[number])
        return rows | {m.name: m.row(options, dataset, results) for m in self.methods}

    def _tests(self, options: Options, results: Results) -> dict[str, Figures]:
        if self.compared is None:
            return {}
        one = len(self.columns) == 1
        found = {
            "printed, all nine sets": _test(
                [_paired(b, self.printed[n], one) for n, b in self.compared.printed_before.items()]
            )
        }
        by_name = {method.name: method for method in self.methods}
        for before in self.compared.before:
            rows = [
                [each.row(options, dataset, results) for each in (before, by_name[before.name])]
                for dataset in options.datasets
            ]
            found[before.name] = _test([_paired(old, new, one) for old, new in rows])
        return found

    def _draw(self, sets: Mapping[str, Mapping[str, Row]], path: Path) -> None:
        picture = figure(max(6.0, 1.0 + 0.5 * len(self.columns) * len(sets) + 2.5), 5.0)
        axis = picture.add_subplot()
        colours = {"printed": "#999999"} | {m.name: m.colour for m in self.methods}
        places = [(name, column) for name in sets for column in range(len(self.columns))]
        for k, (method, colour) in enumerate(colours.items()):
            points = [
                (x, row[column])
                for x, (name, column) in enumerate(places)
                if column < len(row := sets[name].get(method, ())) and row[column] is not None
            ]
            if points:
                xs, ys = zip(*points, strict=True)
                axis.plot(
                    np.array(xs) + 0.12 * (k - 1), ys, linestyle="none", marker="os^Dv"[k % 5],
                    color=colour, label=method,
                )  # fmt: skip
        axis.set_yscale("log")
        axis.set_ylabel("RMSE [m]")
        axis.set_xticks(
            range(len(places)),
            [f"{self.columns[c]}\n{name if c == 0 else ''}" for name, c in places],
            fontsize=8,
        )
        axis.set_title(self.title, fontsize=11)
        axis.legend(frameon=False, fontsize=9, loc="upper left", bbox_to_anchor=(1.0, 1.0))
        add_grid(axis)
        picture.savefig(path, dpi=120)


def _profile(options: Options) -> Scenario:
    scenario = load("utias")
    return with_world(scenario, duration_s=QUICK_S) if options.quick else scenario


def _ekf(options: Options, dataset: Dataset, *, his: bool) -> Task:
    scenario = with_options(_profile(options), estimator="ekf-slam", fusion="alone")
    return whole_run_task(his_protocol(scenario) if his else scenario, dataset, HIS if his else "")


def _spherical(options: Options, dataset: Dataset) -> Task:
    return spherical_task(_profile(options), dataset)


def _of_robots(
    options: Options, dataset: Dataset, results: Results, task: Callable[[Options, Dataset], Task]
) -> list[Figures]:
    robots = (results.of(task(options, dataset)) or {}).get("robots", {})
    return [robots.get(robot, {}) for robot in _ROBOTS]


def _of_singles(options: Options, dataset: Dataset, results: Results) -> list[Figures]:
    scenario = _profile(options)
    alone = (
        (msgspec.structs.replace(scenario, robots=(each,)), each.id) for each in scenario.robots
    )
    return [results.of(team_task(one, dataset=dataset, note=id_)) or {} for one, id_ in alone]


def _of_spherical_team(options: Options, dataset: Dataset, results: Results) -> list[Figures]:
    return [(results.of(_spherical(options, dataset)) or {}).get(TEAM, {})]


def _of_team(options: Options, dataset: Dataset, results: Results) -> list[Figures]:
    quick = options.quick
    task = team_task(_profile(options), dataset=dataset) if quick else team_on(dataset)
    return [results.of(task) or {}]


def _number(dataset: Dataset) -> str:
    return "".join(each for each in dataset.name if each.isdigit())


def _known(row: Sequence[float | None]) -> list[float]:
    return [value for value in row if value is not None]


def _cells(row: Row) -> list[str]:
    known = _known(row)
    cells = ["–" if value is None else f"{value:.3g}" for value in row]
    mean = f"{np.mean(known):.3g}" if known else "–"
    return [*cells, mean, f"{np.std(known, ddof=1):.3g}" if len(known) > 1 else "–"]


def _paired(
    before: Sequence[float | None], after: Sequence[float | None], one: bool
) -> list[tuple[float, float]]:
    if one:
        known, team = _known(before), _known(after)
        return [(float(np.mean(known)), team[0])] if known and team else []
    return [(b, a) for b, a in zip(before, after, strict=True) if a is not None and b is not None]


def _test(pairs_of_sets: Sequence[Sequence[tuple[float, float]]]) -> Figures:
    both = np.array([pair for pairs in pairs_of_sets for pair in pairs]).reshape(-1, 2)
    return {
        "pairs": len(both),
        "mean_before_m": float(both[:, 0].mean()) if len(both) else None,
        "mean_after_m": float(both[:, 1].mean()) if len(both) else None,
        "p": float(ttest_rel(both[:, 0], both[:, 1]).pvalue) if len(both) > 1 else None,
    }


def _test_table(compared: _Compared | None, tests: Mapping[str, Figures]) -> Table:
    text, printed = ("", 0.0) if compared is None else (compared.text, compared.printed_p)
    shown = (
        ("pairs", "pairs", "{}"),
        ("mean_before_m", "mean before [m]", "{:.3g}"),
        ("mean_after_m", "mean after [m]", "{:.3g}"),
        ("p", "p", "{:.3g}"),
    )
    note = f"the text prints p = {printed:g}; two-sided, scipy.stats.ttest_rel"
    return table_of(f"paired t-test, {text}", "figures", tests, shown, note)


def _sample_picture(title: str, sample: Figures) -> Picture:
    return Picture(
        "sample-real",
        f"As figure 5.1, a map of the EKF: {title}, {sample['robot']}. Ellipses: 95 % of "
        "the map's covariances; crosses are the true landmarks, grey the true path.",
        partial(_draw_sample, title, sample),
    )


def _draw_sample(title: str, sample: Figures, path: Path) -> None:
    picture = figure(7.5, 7.5)
    axis = picture.add_subplot()
    for key, colour, label in (
        ("truth", TRUTH_COLOUR, "true path"),
        ("online", VERMILION, f"{sample['robot']}, online"),
    ):
        axis.plot(*np.array(sample[key]).reshape(-1, 2).T, color=colour, linewidth=1.0, label=label)
    axis.plot(
        *np.array(sample["landmarks"]).reshape(-1, 2).T, linestyle="", marker="x",
        color=RED, label="true landmarks",
    )  # fmt: skip
    draw_map(axis, sample["means"], sample["blocks"], label="map, 95 %")
    as_map(axis, adjustable="datalim")
    axis.set_title(f"EKF: {title}", fontsize=11)
    picture.legend(loc="outside lower center", ncols=4, frameon=False, fontsize=9)
    picture.savefig(path, dpi=110)


HIS, OURS = "his protocol", "ours"
_COLOURS = (VERMILION, ORANGE, BLUE, SKY)
_ROBOTS = ("r1", "r2", "r3", "r4", "r5")
_HIS_EKF = partial(_ekf, his=True)
_EKFS = (partial(_of_robots, task=_HIS_EKF), partial(_of_robots, task=partial(_ekf, his=False)))
_JOINED = (partial(_of_robots, task=_spherical), _of_singles)
_MAPS = ("rmse", "rmse_aligned")
_DIFFERS = (
    "His filter's noise, his odometry's correction and what he did about set 1's exchanged "
    "landmarks are not printed: here all rows have the models of our profile and its repair. "
    "Errors are those of the map as it lies from its start pose."
)


def _pair(sources: Sequence[Source], figures: Sequence[str]) -> tuple[_Method, ...]:
    rows = [
        (f"{name}, aligned" if figure.endswith("aligned") else name, source, figure)
        for name, source in zip((HIS, OURS), sources, strict=True)
        for figure in figures
    ]
    return tuple(_Method(*row, colour) for row, colour in zip(rows, _COLOURS, strict=False))


TABLE_5_1 = _PrintedTable(
    "Downs, table 5.1: maps of the EKF, one robot",
    _ROBOTS,
    EKF_MAPS,
    _pair(_EKFS, _MAPS),
    (
        _DIFFERS,
        "Ours is the same filter with measurements sampled to half a second. The text explains "
        "his errors by linearisation; most of the error is a rotation of the whole map, which "
        "alignment removes: the start heading and the first metres of odometry determine it.",
    ),
    sample=_HIS_EKF,
)
TABLE_5_2 = _PrintedTable(
    "Downs, table 5.2: paths of the EKF, one robot",
    _ROBOTS,
    EKF_PATHS,
    _pair(_EKFS, ("position_rmse",)),
    (
        _DIFFERS,
        "The printed paths are some eight times better than the printed maps that they were made "
        "with, in one frame; the source does not explain how a path can be right within 0.04 m in "
        "a map that is wrong by 0.3 m. Rows 3 and 8 of the printed table are equal.",
    ),
)


TABLE_5_3 = _PrintedTable(
    "Downs, table 5.3: joined maps, one robot",
    _ROBOTS,
    JOINED_MAPS,
    _pair(_JOINED, _MAPS),
    (
        _DIFFERS,
        "A printed error of 0.0000 m is below the accuracy of the landmarks' survey, and rows 6 "
        "and 7 of the printed table are equal: these figures are not verified. The t-test of the "
        "45 printed pairs gives another p than the text.",
    ),
    _Compared(
        "EKF maps (table 5.1) against joined maps (table 5.3)",
        P_EKF_JOINED,
        _pair(_EKFS, ("rmse",)),
        EKF_MAPS,
    ),
)
TABLE_5_4 = _PrintedTable(
    "Downs, table 5.4: smoothed paths, one robot",
    _ROBOTS,
    SMOOTHED_PATHS,
    _pair(_JOINED, ("position_rmse",)),
    (
        _DIFFERS,
        "The printed 7.7·10⁻⁵ m is less than a tenth of the truth system's accuracy of a "
        "millimetre, so it cannot be a measured distance to the truth.",
    ),
)


TABLE_5_5 = _PrintedTable(
    "Downs, table 5.5: joined maps of five robots",
    (TEAM,),
    {number: (error,) for number, error in TEAM_MAPS.items()},
    _pair((_of_spherical_team, _of_team), _MAPS),
    (
        _DIFFERS,
        "He exchanges maps at each mutual sighting. Here the robots' whole maps are aligned once, "
        "by singular values over the common landmarks and the robots' own positions at every "
        "mutual sighting. Ours joins all submaps in one frame, with inter-robot measurements.",
    ),
    _Compared(
        "the mean of single joined maps (table 5.3) against the team's (table 5.5)",
        P_JOINED_TEAM,
        _pair(_JOINED, ("rmse",)),
        JOINED_MAPS,
    ),
)
