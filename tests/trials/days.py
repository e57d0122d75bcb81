"""Thirty days of a site whose landmarks change: size, cost, accuracy and detection day by day.

    python -m tests.trials.days --days 30 --seed 1 --picture docs/maps_days.png

Each day a team without known starts loads the map of the day before and saves its own. Overnight 5
% of the landmarks change: moved by 2 m, or gone and replaced by a new one. In memory.
"""

import argparse
import time
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np

from teamslam.central.node import CentralNode, make_centre
from teamslam.sim.in_memory.team import final_map, run_team
from teamslam.sim.scenarios.scenario import load
from teamslam.sim.scenarios.source import streams_of
from teamslam.team.core import unpacked
from teamslam.team.estimation.map_joining.alignment import Maps, align, procrustes
from teamslam.team.wire import messages as m
from teamslam.team.wire.arrays import floats, ids
from teamslam.team.wire.bus import opened
from teamslam.team.wire.codec import encoded

LANDMARKS, SITE_M = 40, 100.0
CHANGED, MOVED_M = 0.05, 2.0
AWAY = (-900.0, -900.0)  # out of every robot's sight


class Day(NamedTuple):
    """Figures of a day.

    changed: landmarks whose change was found or missed. missed: moved or new, observed, not
    reported. false: wrongly reported as moved or gone. Errors are of landmarks whose changes were
    observed.
    """

    landmarks: int
    bytes: int
    cpu_s: float
    rmse_m: float
    nees: float
    changed: int
    found: int
    missed: int
    false: int


class Site:
    """True landmarks by number, from 1; one that is gone is AWAY."""

    def __init__(self, seed: int) -> None:
        self._random = np.random.default_rng(seed)
        self.places = list(map(tuple, self._random.uniform(0.0, SITE_M, (LANDMARKS, 2)).tolist()))

    def change(self) -> dict[int, str]:
        changes = {}
        for number, place in enumerate(tuple(self.places), 1):
            if place == AWAY or self._random.random() >= CHANGED:
                continue
            if self._random.random() < 0.5:
                angle = self._random.uniform(0.0, 2.0 * np.pi)
                by = MOVED_M * np.array([np.cos(angle), np.sin(angle)])
                self.places[number - 1] = tuple((np.array(place) + by).tolist())
                changes[number] = "moved"
            else:
                self.places[number - 1] = AWAY
                self.places.append(tuple(self._random.uniform(0.0, SITE_M, 2).tolist()))
                changes |= {number: "gone", len(self.places): "new"}
        return changes


def run_days(count: int, seed: int) -> Iterator[Day]:
    site, saved = Site(seed), None
    pending: dict[int, str] = {}
    for day in range(count):
        pending |= site.change() if day else {}
        scenario = msgspec.structs.replace(load("thesis-b"), seed=seed + 1000 * day)
        world = msgspec.structs.replace(
            scenario.world,
            landmarks=tuple(site.places),
            unknown_starts=("*",) if day else (),
            paths=(),
        )
        scenario = msgspec.structs.replace(scenario, world=world)
        centres: list[CentralNode] = []

        def central(config, names, centres=centres, saved=saved) -> CentralNode:
            centres.append(make_centre(config, names, maps=() if saved is None else (saved,)))
            return centres[-1]

        begin = time.process_time()
        streams = streams_of(scenario)
        samples = list(run_team(scenario, streams, central=central))
        fused = final_map(samples)
        spent = time.process_time() - begin
        saved = centres[0].maps.fold.save_map(f"day{day + 1}")
        messages = (opened(sample)[2] for sample in samples)
        seen = {k for x in messages if isinstance(x, m.Submap) for k in ids(x.ids, "ids").tolist()}
        told = {each.landmark: each.state for each in fused.changes if each.state != "unchanged"}
        found = {k for k, state in pending.items() if told.get(k) == state}
        missed = {k for k in pending.keys() & seen if pending[k] != "gone"} - found
        false = {k for k, state in told.items() if state != "new" and pending.get(k) != state}
        pending = {k: state for k, state in pending.items() if k not in found | missed}
        counts = (len(found) + len(missed), len(found), len(missed), len(false))
        yield _figures(saved, pending, np.array(site.places), spent, counts)


def _figures(
    saved: m.SavedMap,
    pending: Collection[int],
    places: np.ndarray,
    cpu_s: float,
    counts: tuple[int, int, int, int],
) -> Day:
    numbers = ids(saved.ids, "ids")
    known = np.array([k not in pending and places[k - 1, 0] > AWAY[0] for k in numbers.tolist()])
    truth, rows = places[numbers - 1][known], np.repeat(known, 2)
    means = floats(saved.means, "means").reshape(-1, 2)[known]
    P = unpacked(floats(saved.covariance, "covariance"), len(rows))[np.ix_(rows, rows)]
    fit = align(Maps(truth, 1e-12 * np.eye(len(P)), means, P))
    x, y, turn = procrustes(truth, means, np.ones(len(truth)))
    s, c = np.sin(turn), np.cos(turn)
    off = truth - means @ np.array([[c, s], [-s, c]]) - [x, y]
    rmse = float(np.sqrt((off**2).sum(axis=1).mean()))
    return Day(len(numbers), len(encoded(saved)), cpu_s, rmse, fit.chi2 / fit.dof, *counts)


def draw(days: list[Day], path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    x = np.arange(1, len(days) + 1)
    figure, axes = plt.subplots(2, 2, figsize=(9.0, 5.6), sharex=True, layout="constrained")
    (size, cost), (nees, change) = axes
    size.plot(x, [d.bytes / 1024 for d in days], marker=".")
    size.set(ylabel="saved map [KiB]", ylim=(0, None), title="Size")
    cost.plot(x, [d.cpu_s for d in days], marker=".")
    cost.set(ylabel="CPU of the day's run [s]", ylim=(0, None), title="Cost")
    nees.plot(x, [d.nees for d in days], marker=".", label="NEES per dof")
    nees.plot(x, [10.0 * d.rmse_m for d in days], marker=".", label="RMSE, aligned [dm]")
    nees.axhline(1.0, color="0.6", linewidth=0.8)
    nees.set(xlabel="day", ylim=(0, None), title="Accuracy and consistency")
    nees.legend(frameon=False)
    change.bar(x, [d.found for d in days], label="found")
    change.bar(x, [d.missed for d in days], bottom=[d.found for d in days], label="missed")
    change.plot(x, [d.false for d in days], "kx", label="false")
    change.set(xlabel="day", ylabel="landmarks", title="Changed landmarks that were observed")
    change.legend(frameon=False)
    figure.savefig(path, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--days", type=int, default=30)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--picture", type=Path)
    options = parser.parse_args()
    print("day  landmarks  bytes  CPU [s]  RMSE [m]  NEES  changed  found  missed  false")
    days = []
    for number, day in enumerate(run_days(options.days, options.seed), 1):
        days.append(day)
        print(
            f"{number:3d}  {day.landmarks:9d} {day.bytes:6d} {day.cpu_s:8.1f} {day.rmse_m:9.3f} "
            f"{day.nees:5.2f} {day.changed:8d} {day.found:6d} {day.missed:7d} {day.false:6d}",
            flush=True,
        )
    print(
        f"{sum(d.found for d in days)} of {sum(d.changed for d in days)} observed changes found, "
        f"{sum(d.false for d in days)} false; mean NEES {np.mean([d.nees for d in days]):.2f}"
    )
    if options.picture is not None:
        draw(days, options.picture)


if __name__ == "__main__":
    main()
