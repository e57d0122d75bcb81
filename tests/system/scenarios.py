import hashlib
from functools import cache
from pathlib import Path

from teamslam.sim.in_memory.team import run_team
from teamslam.sim.scenarios.scenario import dumps, load, loads, with_options
from teamslam.sim.scenarios.source import streams_of
from teamslam.team.wire.channels import FINAL_MAP

STEPS = 60


def short(folder: Path, base: str = "thesis", steps: int = STEPS, more: str = "") -> Path:
    """A scenario file: `base` with fewer steps; `more`: further lines at its top."""
    path = folder / "short.toml"
    path.write_text(f'base = "{base}"\n{more}\n[world]\nsteps = {steps}\n')
    return path


def final_map(samples: "list[tuple[str, bytes]]") -> bytes:
    (payload,) = [payload for key, payload in samples if key == FINAL_MAP.key()]
    return payload


def map_in_memory(scenario: Path, seed: int = 1) -> bytes:
    """Bytes of the final map that the same nodes send in memory."""
    return _map_of(dumps(with_options(load(scenario), seed=seed)))


@cache
def _map_of(scenario: str) -> bytes:
    resolved = loads(scenario)
    samples = run_team(resolved, streams_of(resolved))
    return final_map([(sample.key, sample.payload) for sample in samples])


def sha256(payload: bytes) -> str:
    return hashlib.sha256(payload).hexdigest()
