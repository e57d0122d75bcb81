"""Provenance of a log: everything that must be equal to recompute the same bits."""

import hashlib
import subprocess
import sys
from importlib import metadata
from pathlib import Path
from platform import libc_ver, machine, platform, python_version

from team import core

ESTIMATION = Path(__file__).parents[1] / "estimation"
_PACKAGES = ("teamslam", "numpy", "scipy", "numba", "llvmlite", "eclipse-zenoh", "msgpack", "mcap")


def provenance() -> dict[str, str]:
    """Versions, BLAS, CPU and kernels of this process for a log's metadata."""
    cpu_name, cpu_features, blas = _computer()
    versions = {f"version.{package}": _version(package) for package in _PACKAGES}
    return {
        **versions,
        "version.python": python_version(),
        "platform": platform(),
        "arithmetic": arithmetic(),
        "blas": blas,
        "cpu.name": cpu_name,
        "cpu.features": cpu_features,
        "core": f"{core.digest[:16]} {core.level}",
        "kernels": kernel_fingerprint(),
        "git.commit": git_commit(),
    }


def kernel_fingerprint() -> str:
    """SHA-256 of the core and all `team.estimation` sources in path order; 16 hex digits."""
    digest = hashlib.sha256(core.digest.encode())
    for source in sorted(ESTIMATION.rglob("*.py")):
        digest.update(f"{source.relative_to(ESTIMATION).as_posix()}\n".encode())
        digest.update(source.read_bytes())
    return digest.hexdigest()[:16]


def arithmetic() -> str:
    """Platform on which the bits depend, besides program and libraries.

    The C library's logarithm affects the tails of NumPy's normal numbers.
    """
    return " ".join((machine(), *libc_ver())).strip()


def git_commit() -> str:
    """Commit of the running checkout, "+" if changed; else "unknown"."""
    root = ESTIMATION.parents[1]
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


def computer() -> tuple[str, str, str]:
    """Processor and features, as named by the kernel compiler, and NumPy's BLAS."""
    import numpy as np
    from llvmlite import binding  # type: ignore[import-untyped] # llvmlite ships no types

    features = binding.get_host_cpu_features()
    names = " ".join(sorted(name for name, has in features.items() if has))
    blas = np.show_config(mode="dicts")["Build Dependencies"]["blas"]
    return binding.get_host_cpu_name(), names, f"{blas['name']} {blas['version']}"


def _computer() -> tuple[str, str, str]:
    """Determine it in a separate process unless the compiler is loaded: it takes 110 MB, NumPy
    14.
    """
    if "llvmlite.binding" in sys.modules:
        return computer()
    code = f"from {__name__} import computer; print(*computer(), sep='\\n')"
    asked = [sys.executable, "-P", "-c", code]
    output = subprocess.run(asked, capture_output=True, check=True, text=True).stdout  # noqa: S603 - our own program
    name, features, blas = output.splitlines()
    return name, features, blas


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "unknown"
