import shutil
import subprocess
import sys
import sysconfig
import tomllib
import zipfile
from collections.abc import Sequence
from pathlib import Path

import pytest

from teamslam.sim.scenarios.scenario import builtin_names
from tests.support import ROOT
from tests.system.processes import Processes

FOLDERS = ("team", "central", "sim")
PIP = (sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet")
OFFLINE = ("--no-deps", "--no-index")


async def done(team: Processes, name: str, command: Sequence[object]) -> str:
    words = ["env", "-u", "PYTHONPATH", *(str(word) for word in command)]
    process = await team.run(name, words)
    assert await process.ended() == 0, process.said()
    return process.said()


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    source = tmp_path_factory.mktemp("source")
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    for package in (*FOLDERS, "teamslam"):
        leave = shutil.ignore_patterns("__pycache__", "*.so")
        shutil.copytree(ROOT / package, source / package, ignore=leave, symlinks=True)
    return source


def build_wheel(source: Path, levels: str) -> subprocess.CompletedProcess[str]:
    build = [
        *PIP,
        "wheel",
        *OFFLINE,
        "--no-build-isolation",
        f"--config-settings=cmake.define.TEAMSLAM_LEVELS={levels}",
        "--wheel-dir",
        source / "dist",
        source,
    ]
    return subprocess.run(build, capture_output=True, text=True, timeout=600, check=False)


@pytest.fixture(scope="module")
def wheel(source):
    ended = build_wheel(source, levels="")
    assert ended.returncode == 0, ended.stderr
    (built,) = (source / "dist").glob("*.whl")
    return built


def test_an_unknown_level_of_the_core_ends_the_build(source):
    ended = build_wheel(source, levels="base;avx9")
    assert ended.returncode != 0
    assert "has no level avx9; choose of base" in " ".join((ended.stdout + ended.stderr).split())


def test_the_wheel_holds_one_package_and_nothing_else(wheel):
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    about = f"teamslam-{version}.dist-info/"
    with zipfile.ZipFile(wheel) as archive:
        shipped = {name for name in archive.namelist() if not name.startswith(about)}
        assert f"{about}licenses/LICENSE" in archive.namelist()
    expected = {
        f"teamslam/{path.relative_to(ROOT).as_posix()}".replace("teamslam/teamslam/", "teamslam/")
        for package in (*FOLDERS, "teamslam")
        for path in (ROOT / package).rglob("*")
        if path.suffix in {".py", ".pyi", ".toml", ".html", ".js", ".json", ".css", ".svg"}
        or path.name == "py.typed"
    }
    assert shipped == {name for name in expected if "team/core/building/" not in name}


async def test_the_wheel_runs_in_an_environment_of_its_own(team, wheel):
    """Dependencies and core are those of the tests' environment; nothing is fetched."""
    fresh = team.folder / "fresh"
    await done(team, "venv", [sys.executable, "-m", "venv", "--without-pip", fresh])
    python = fresh / "bin" / "python"
    install = [PIP[0], "-m", "pip", "--python", python, *PIP[3:], "install", *OFFLINE, wheel]
    await done(team, "install", install)
    (packages,) = fresh.glob("lib/python*/site-packages")
    (packages / "lent.pth").write_text(sysconfig.get_path("purelib") + "\n")
    for module in (ROOT / "team" / "core").glob("_core_*.so"):
        shutil.copy(module, packages / "teamslam" / "team" / "core")

    where = await done(
        team, "where", [python, "-P", "-c", "import teamslam; print(teamslam.__file__)"]
    )
    assert Path(where.strip()).is_relative_to(fresh)
    teamslam = fresh / "bin" / "teamslam"
    version = await done(team, "version", [teamslam, "--version"])
    assert wheel.name.startswith(f"teamslam-{version.split()[1]}-")
    scenarios = await done(team, "scenarios", [teamslam, "scenarios"])
    assert [line.split()[0] for line in scenarios.splitlines()] == list(builtin_names())
    await done(team, "simulate", [teamslam, "simulate", "waypoints", "--output", "set"])
    assert (team.folder / "set" / "Robot3_Odometry.dat").stat().st_size > 0
