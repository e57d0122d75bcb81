"""Bits of final maps, which a change of structure alone must not move.

    python -m tests.bits                 computes every case and compares it with the table
    python -m tests.bits --only pair     the cases whose name begins so
    python -m tests.bits --rewrite       writes what was computed into the table

A row hashes the encoded final map, its means and covariance alone, and each robot's last own pose
and map. The rows depend on the libraries that the table names, not on the processor's features.
"""

import argparse
import hashlib
import json
import platform
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import msgspec
import numpy as np
import scipy

from teamslam.sim.in_memory.team import final_map, run_team
from teamslam.sim.scenarios.scenario import Scenario, load, with_options
from teamslam.sim.scenarios.source import streams_of
from teamslam.team.pairs import PAIRS
from teamslam.team.wire import messages as m
from teamslam.team.wire.bus import Sample, opened
from teamslam.team.wire.codec import encoded
from tests.scenarios import with_world
from tests.support import ROOT

TABLE = Path(__file__).with_suffix(".json")
SETS = ROOT.parent / "shared" / "utias"
PAIR_STEPS = 30
ESTIMATES = ("estimate", "robots")  # the hashes that no version of a message changes
Row = Mapping[str, str]


def world(name: str, seed: int = 1, **changes: object) -> Scenario:
    scenario = with_options(load(name), seed=seed)
    return with_world(scenario, **changes)


def pair(estimator: str, fusion: str) -> Scenario:
    return with_options(world("thesis", steps=PAIR_STEPS), estimator=estimator, fusion=fusion)


def outliers() -> Scenario:
    scenario = world("thesis", outlier_share=0.3)
    central = msgspec.structs.replace(scenario.central, landmark_submaps=2)
    return msgspec.structs.replace(scenario, central=central)


def utias(number: int) -> Scenario:
    return with_options(load("utias"), dataset=SETS / f"MRCLAM_Dataset{number}.zip")


CASES: Mapping[str, Callable[[], Scenario]] = {
    "thesis 1": lambda: world("thesis"),
    "thesis 2": lambda: world("thesis", seed=2),
    "thesis-b 1": lambda: world("thesis-b"),
    "random-3 1": lambda: world("random-3"),
    "waypoints 1": lambda: world("waypoints"),
    "unknown initial poses": lambda: world("thesis", unknown_starts=("*", "!r1")),
    "outliers": outliers,
    "hidden identities": lambda: with_options(world("waypoints"), identities="hidden"),
    "hidden identities and initial poses": lambda: with_options(
        world("thesis-b", unknown_starts=("*", "!r1")), identities="hidden"
    ),
    # The optimum of `batch` is GTSAM's, which promises no bits.
    **{f"pair {e} + {f}": lambda e=e, f=f: pair(e, f) for e, f in sorted(PAIRS) if f != "batch"},
    "utias 1": lambda: utias(1),
    "utias 2": lambda: utias(2),
    "utias 6": lambda: utias(6),
}


def is_here(name: str) -> bool:
    return not name.startswith("utias") or (SETS / f"MRCLAM_Dataset{name[-1]}.zip").is_file()


def computed(name: str) -> Row:
    scenario = CASES[name]()
    samples = list(run_team(scenario, streams_of(scenario)))
    fused = final_map(samples)
    return {
        "message": _hash(encoded(fused)),
        "estimate": _hash(fused.means + fused.covariance),
        "robots": _hash(b"".join(_own_estimates(samples))),
    }


def _own_estimates(samples: list[Sample]) -> Iterator[bytes]:
    last = {s.key: s for s in samples if s.key.endswith(("/own/pose", "/own/map"))}
    for key in sorted(last):
        _, _, message = opened(last[key])
        means = message.pose if isinstance(message, m.PoseEstimate) else message.means
        yield means + message.covariance


def _hash(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()[:16]


def machine() -> dict[str, str]:
    return {"processor": platform.machine(), "numpy": np.__version__, "scipy": scipy.__version__}


def table() -> dict[str, dict[str, str]]:
    """The committed rows; `machine`: processor and libraries of their computation."""
    return json.loads(TABLE.read_text("utf-8")) if TABLE.is_file() else {}


def differences(names: list[str]) -> Iterator[tuple[str, Row, str]]:
    committed = table()
    for name in names:
        now = computed(name)
        before = committed.get(name, {})
        fields = [field for field in now if now[field] != before.get(field)]
        yield name, now, "" if not fields else "new" if not before else ", ".join(fields)


def main() -> int:
    parser = argparse.ArgumentParser(description="The bits of final maps against the table.")
    parser.add_argument("--only", default="", metavar="NAME", help="the cases that begin so")
    parser.add_argument("--rewrite", action="store_true", help="write what was computed")
    options = parser.parse_args()
    rows, moved = table(), 0
    chosen = [name for name in CASES if name.startswith(options.only) and is_here(name)]
    if rows and rows["machine"] != machine():
        print(f"the table was made with {rows['machine']}, this is {machine()}")
    begun = time.perf_counter()
    for name, now, differs in differences(chosen):
        took, begun = time.perf_counter() - begun, time.perf_counter()
        moved += any(field in differs for field in ESTIMATES)
        print(f"{name:42} {' '.join(now.values())} {took:5.1f} s {differs}", flush=True)
        rows[name] = dict(now)
    if options.rewrite:
        kept = {name: rows[name] for name in CASES if name in rows}
        text = json.dumps({"machine": machine()} | kept, indent=1)
        TABLE.write_text(text + "\n", "utf-8")
    elif moved:
        print(f"{moved} of {len(chosen)} cases have other estimates", file=sys.stderr)
    return int(bool(moved) and not options.rewrite)


if __name__ == "__main__":
    sys.exit(main())
