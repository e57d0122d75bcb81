"""Compare the bits of a run between classes of processors.

    python -m tests.across                 waypoints, a piece of thesis, a piece of a data set
    python -m tests.across --only thesis   the cases whose name begins so

One process for each class, selected by environment variables of the core, NumPy, the C library and
OpenBLAS. The processor must have the class.
"""

import argparse
import hashlib
import os
import pickle
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path

from teamslam.sim.scenarios.scenario import Scenario
from tests import bits
from tests.scenarios import with_world

CLASSES: Mapping[str, Mapping[str, str]] = {
    "this processor": {},
    "without AVX": {
        "TEAMSLAM_CORE": "base",
        "NPY_DISABLE_CPU_FEATURES": "X86_V3 X86_V4 AVX512_ICL",
        "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX,-AVX2,-FMA,-FMA4,-AVX512F,-AVX512VL,-AVX512DQ",
        "OPENBLAS_CORETYPE": "Prescott",
    },
    "AVX2": {
        "NPY_DISABLE_CPU_FEATURES": "X86_V4 AVX512_ICL",
        "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX512F,-AVX512VL,-AVX512DQ",
        "OPENBLAS_CORETYPE": "Haswell",
    },
}
CASES = {
    "waypoints": lambda: bits.world("waypoints"),
    "thesis": lambda: bits.world("thesis", steps=60),
    "pair": lambda: bits.pair("hybrid", "join"),
    "utias": lambda: begun(bits.utias(1), 300.0),
}


def begun(scenario: Scenario, seconds: float) -> Scenario:
    return with_world(scenario, duration_s=seconds)


def measured(name: str, path: Path) -> None:
    scenario = CASES[name]()
    path.write_bytes(pickle.dumps((scenario, bits.streams_of(scenario))))


def digests(path: Path) -> dict[str, str]:
    scenario, streams = pickle.loads(path.read_bytes())
    found: dict[str, hashlib._Hash] = {}
    for sample in bits.run_team(scenario, streams):
        digest = found.setdefault(sample.key, hashlib.sha256())
        digest.update(sample.payload)
    return {key: digest.hexdigest()[:12] for key, digest in sorted(found.items())}


def compared(name: str, classes: int) -> list[str]:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "case"
        measured(name, path)
        found = {each: _elsewhere(path, extra) for each, extra in [*CLASSES.items()][:classes]}
    (first, reference), *others = found.items()
    print(f"{name}: {len(reference)} channels", flush=True)
    return [
        f"{name}: {key} of {other!r} is not that of {first!r}"
        for other, digest in others
        for key in sorted(reference.keys() | digest.keys())
        if reference.get(key) != digest.get(key)
    ]


def _elsewhere(path: Path, extra: Mapping[str, str]) -> dict[str, str]:
    code = (
        f"from pathlib import Path; from tests.across import *; print(digests(Path({str(path)!r})))"
    )
    told = subprocess.run(
        [sys.executable, "-c", code], env={**os.environ, **extra}, capture_output=True, text=True
    )
    if told.returncode:
        raise RuntimeError(told.stderr)
    found: dict[str, str] = eval(told.stdout, {}, {})
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description="The bits of a run on other processors.")
    parser.add_argument("--only", default="", metavar="NAME", help="the cases that begin so")
    parser.add_argument("--classes", type=int, default=len(CLASSES), help="how many of them")
    options = parser.parse_args()
    differences = [
        line
        for name in CASES
        if name.startswith(options.only)
        for line in compared(name, options.classes)
    ]
    print("\n".join(differences) if differences else "the same bits everywhere")
    return int(bool(differences))


if __name__ == "__main__":
    sys.exit(main())
