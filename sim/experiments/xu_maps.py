"""Figures 4.1 to 4.3 and 5.1 of W. Xu's thesis: maps of one run, with the paths so far."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import msgspec
import numpy as np

from sim.evaluation.evaluation import evaluate
from sim.experiments.curves import messages, pose_keys, said_poses, true_landmarks
from sim.experiments.drawing import draw_map, figure, ruled
from sim.experiments.experiment import Options, Outcome, Picture, Results, Table
from sim.experiments.task import Task
from sim.experiments.team_runs import Figures, TimedRun, rms
from sim.experiments.xu import EKF, FASTSLAM, HYBRID, MULTI_HYBRID, OUR_TEAM, OURS, Method, Panel
from sim.experiments.xu import task as curves_of
from sim.pictures.run import ROBOT_COLOURS, TRUTH_COLOUR
from sim.scenario.scenario import loads
from team import translate
from team.wire import channels as ch
from team.wire import messages as m

if TYPE_CHECKING:  # Matplotlib takes half a second to import
    from matplotlib.axes import Axes


class MapFigure(NamedTuple):
    """Maps of some methods at some steps, of the first seed's run."""

    title: str
    methods: tuple[Method, ...]
    steps: tuple[int, ...]
    remark: str

    def tasks(self, options: Options) -> list[Task]:
        """One run of each method."""
        return [self._task(method, options) for method in self.methods]

    def outcome(self, options: Options, results: Results) -> Outcome:
        """A picture and a row for each method."""
        rows, pictures, figures = [], [], {}
        for method in self.methods:
            run = results.of(self._task(method, options))
            if run is None:
                continue
            name = method.name.replace(" ", "-").replace(",", "").lower()
            caption = (
                f"{self.title}: {method.name}, seed {options.seeds[0]}. Ellipses hold 95 % of "
                "what the map believes; crosses are the true landmarks, grey the true paths."
            )
            pictures.append(Picture(name, caption, _Drawing(f"{self.title}: {method.name}", run)))
            errors = [shot["rmse_m"] for shot in run["shots"]]
            rows.append((method.name, *("–" if e is None else f"{e:.2f}" for e in errors)))
            figures[method.name] = dict(zip(map(str, self.steps), errors, strict=True))
        table = Table(
            f"{self.title}: landmark RMSE [m]",
            ("method", *(f"step {step}" for step in self.steps)),
            tuple(rows),
        )
        return Outcome(
            self.title, {"rmse_m": figures}, (table,), tuple(pictures), remarks=(self.remark,)
        )

    def _task(self, method: Method, options: Options) -> Task:
        run = curves_of(Panel("", (method,), {}), method, options.seeds[0])
        return Task(
            "sim.experiments.xu_maps:maps_run",
            {"world": run.parameters["world"], "steps": list(self.steps)},
            f"maps of {run.label}",
            run.cost,
        )


def maps_run(world: Mapping[str, Any], steps: list[int]) -> Figures:
    """The map and the paths as they were known at these steps."""
    scenario = loads(msgspec.json.encode(world).decode())
    samples = list(TimedRun().samples(scenario))
    evaluation = evaluate(samples)
    ids, positions = true_landmarks(samples)
    key = ch.FUSED_MAP.key()
    fused = list(messages(samples, key))
    if not any(isinstance(each, m.FusedMap) and each.ids for each in fused):
        fused = list(messages(samples, ch.OWN_MAP.key(scenario.robots[0].id)))
    paths = {name: said_poses(samples, pose_keys(scenario, name))[0] for name in evaluation.robots}
    shots = []
    for step in steps:
        now_ns = round(step * 1e9)
        known = [
            each
            for each in fused
            if isinstance(each, m.FusedMap | m.MapEstimate) and each.stamp_ns <= now_ns
        ]
        shots.append(
            _shot(known[-1] if known else None, dict(zip(ids.tolist(), positions, strict=True)))
        )
        for name, robot in evaluation.robots.items():
            said, true = paths[name], robot.truth
            shots[-1].setdefault("paths", {})[name] = {
                "online": said.poses[said.stamps_ns <= now_ns, :2].round(2).tolist(),
                "truth": true.poses[true.stamps_ns <= now_ns, :2].round(2).tolist(),
            }
    return {"steps": steps, "shots": shots, "landmarks": positions.tolist()}


def _shot(known: m.FusedMap | m.MapEstimate | None, truth: Mapping[int, np.ndarray]) -> Figures:
    """The landmarks of one map, their 2 × 2 blocks, and their error."""
    if known is None:
        return {"means": [], "blocks": [], "rmse_m": None}
    ids, means = translate.landmarks_of(known)
    blocks = translate.landmark_blocks_of(known)
    distances = [
        float(np.hypot(*(mean - truth[int(landmark)])))
        for landmark, mean in zip(ids, means, strict=True)
    ]
    return {"means": means.tolist(), "blocks": blocks.tolist(), "rmse_m": rms(distances)}


@dataclass(frozen=True)
class _Drawing:
    title: str
    run: Figures

    def __call__(self, path: Path) -> None:
        """One panel for each step."""
        shots, steps = self.run["shots"], self.run["steps"]
        columns = min(2, len(shots))
        picture = figure(6.5 * columns, 6.3 * -(-len(shots) // columns) + 0.5)
        grid = picture.subplots(-(-len(shots) // columns), columns, squeeze=False)
        for axis, step, shot in zip(grid.ravel(), steps, shots, strict=True):
            _draw(axis, shot, np.array(self.run["landmarks"]))
            error = "" if shot["rmse_m"] is None else f", landmark RMSE {shot['rmse_m']:.2f} m"
            axis.set_title(f"step {step}{error}", fontsize=10)
        picture.suptitle(self.title)
        picture.savefig(path, dpi=110)


def _draw(axis: "Axes", shot: Figures, landmarks: np.ndarray) -> None:
    for i, (name, lines) in enumerate(shot["paths"].items()):
        colour = ROBOT_COLOURS[i % len(ROBOT_COLOURS)]
        for kind, each, width in (("truth", TRUTH_COLOUR, 0.8), ("online", colour, 1.4)):
            points = np.array(lines[kind]).reshape(-1, 2)
            label = f"{name}, online" if kind == "online" else None
            axis.plot(points[:, 0], points[:, 1], color=each, linewidth=width, label=label)
    axis.plot(*landmarks.T, linestyle="", marker="x", color="#C00000", label="true landmarks")
    draw_map(axis, shot["means"], shot["blocks"])
    axis.set_xlim(-10, 110)
    axis.set_ylim(-10, 110)
    axis.set_aspect("equal")
    axis.set_xlabel("x [m]")
    axis.set_ylabel("y [m]")
    axis.legend(fontsize=8, loc="upper left")
    ruled(axis)


_PRINTED = (
    "The thesis prints the maps without figures. Its program gives the filters the true controls "
    "(see xu-4.4); here the odometry has the noise of section 4.4.2."
)
FIGURE_4_1 = MapFigure("Thesis, figure 4.1", (EKF, OURS), (500,), _PRINTED)
FIGURE_4_2 = MapFigure("Thesis, figure 4.2", (FASTSLAM, OURS), (500,), _PRINTED)
FIGURE_4_3 = MapFigure("Thesis, figure 4.3", (HYBRID, OURS), (500,), _PRINTED)
FIGURE_5_1 = MapFigure(
    "Thesis, figure 5.1",
    (MULTI_HYBRID, OUR_TEAM),
    (20, 100, 200, 500),
    _PRINTED + " As written, the ellipses shrink to nothing far from the true landmarks: each "
    "exchange counts every reading again.",
)
