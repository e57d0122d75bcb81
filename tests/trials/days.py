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

import numpy as np

from teamslam.sim.in_memory.team import final_map
from teamslam.sim.scenarios.scenario import load, with_options
from teamslam.sim.scenarios.source import streams_of
from teamslam.team.wire import messages as m
from teamslam.team.wire.arrays import floats, ids
from teamslam.team.wire.bus import opened
from teamslam.team.wire.codec import encoded
from tests.central.test_saved_map import aligned_errors, covariance_of, day
from tests.scenarios import with_world

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
    site, maps = Site(seed), list[m.SavedMap]()
    pending: dict[int, str] = {}
    for number in range(count):
        pending |= site.change() if number else {}
        scenario = with_options(load("thesis-b"), seed=seed + 1000 * number)
        unknown = ("*",) if number else ()
        scenario = with_world(
            scenario, landmarks=tuple(site.places), unknown_starts=unknown, paths=()
        )
        begin = time.process_time()
        samples, centre, _ = day(0, maps, scenario=scenario, streams=streams_of(scenario))
        fused = final_map(samples)
        spent = time.process_time() - begin
        saved = centre.maps.fold.save_map(f"day{number + 1}")
        maps = [saved]
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
    P = covariance_of(saved)[np.ix_(rows, rows)]
    errors = aligned_errors(truth, means, P)
    return Day(len(numbers), len(encoded(saved)), cpu_s, *errors, *counts)


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
    for number, one in enumerate(run_days(options.days, options.seed), 1):
        days.append(one)
        print(
            f"{number:3d}  {one.landmarks:9d} {one.bytes:6d} {one.cpu_s:8.1f} {one.rmse_m:9.3f} "
            f"{one.nees:5.2f} {one.changed:8d} {one.found:6d} {one.missed:7d} {one.false:6d}",
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
