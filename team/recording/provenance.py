"""Where a log came from: what has to be equal for the same bits to come out again."""

import hashlib
import subprocess
from importlib import metadata
from pathlib import Path
from platform import platform, python_version

import numpy as np
from llvmlite import binding  # type: ignore[import-untyped] # llvmlite ships no types

import team.estimation

_PACKAGES = ("teamslam", "numpy", "scipy", "numba", "llvmlite", "eclipse-zenoh", "msgpack", "mcap")


def provenance() -> dict[str, str]:
    """Versions, BLAS, CPU and kernels of this process, as a log's metadata carries them."""
    cpu_features = binding.get_host_cpu_features()
    versions = {f"version.{package}": _version(package) for package in _PACKAGES}
    return {
        **versions,
        "version.python": python_version(),
        "platform": platform(),
        "blas": _blas(),
        "cpu.name": binding.get_host_cpu_name(),
        "cpu.features": " ".join(sorted(n for n, has in cpu_features.items() if has)),
        "kernels": kernel_fingerprint(),
        "git.commit": git_commit(),
    }


def kernel_fingerprint() -> str:
    """SHA-256 of the sources of `team.estimation`, in the order of their names; 16 hex digits."""
    digest = hashlib.sha256()
    for source in sorted(Path(team.estimation.__path__[0]).glob("*.py")):
        digest.update(f"{source.name}\n".encode() + source.read_bytes())
    return digest.hexdigest()[:16]


def git_commit() -> str:
    """The commit of the checkout that this program runs from, "+" when changed; else "unknown"."""
    root = Path(team.estimation.__path__[0]).parents[1]
    if not (root / ".git").exists():
        return "unknown"
    git = ["git", "-C", str(root)]
    try:
        commit, changes = (
            subprocess.run([*git, *what], capture_output=True, check=True, text=True).stdout.strip()  # noqa: S603 - fixed words, and the path of our own sources
            for what in (["rev-parse", "HEAD"], ["status", "--porcelain", "-uno"])
        )
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return commit + ("+" if changes else "")


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "unknown"


def _blas() -> str:
    found = np.show_config(mode="dicts")["Build Dependencies"]["blas"]
    return f"{found['name']} {found['version']}"
