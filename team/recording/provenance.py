"""Provenance of a log: everything that must be equal to recompute the same bits."""

import subprocess
from contextlib import suppress
from importlib import metadata
from pathlib import Path
from platform import libc_ver, machine, platform, processor, python_version

from teamslam.team import core

ESTIMATION = Path(__file__).parents[1] / "estimation"
_PACKAGES = ("teamslam", "numpy", "scipy", "eclipse-zenoh", "msgpack", "mcap")


def provenance() -> dict[str, str]:
    """Return versions, processor, core and estimation of this process."""
    versions = {f"version.{package}": version(package) for package in _PACKAGES}
    return {
        **versions,
        "version.python": python_version(),
        "platform": platform(),
        "arithmetic": arithmetic(),
        "cpu.name": _processor(),
        "core": core.digest[:16],
        "core.level": core.level,
        "estimation": estimation_digest(),
        "git.commit": git_commit(),
    }


def estimation_digest() -> str:
    """Return 16 hex digits of the BLAKE2b digest of all `team/estimation` sources."""
    digest = core.Blake2b(8)
    for source in sorted(ESTIMATION.rglob("*.py")):
        digest.update(f"{source.relative_to(ESTIMATION).as_posix()}\n".encode())
        digest.update(source.read_bytes())
    return digest.digest().hex()


def arithmetic() -> str:
    """Return the platform: the C library affects the tails of NumPy's normal numbers."""
    return " ".join((machine(), *libc_ver())).strip()


def git_commit() -> str:
    """Return the commit of the running checkout, "+" if changed; else "unknown"."""
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


def _processor() -> str:
    with suppress(OSError), Path("/proc/cpuinfo").open(encoding="utf-8") as file:
        for line in file:
            name, _, value = line.partition(":")
            if name.strip() == "model name":
                return value.strip()
    return processor() or machine()


def version(package: str) -> str:
    """Return the installed version of a package, or "unknown"."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "unknown"
