"""The program as it is installed: from its wheel, and beside folders that are named as its own."""

import shutil
import sys
import sysconfig
from collections.abc import Sequence
from pathlib import Path

from sim.scenarios.scenario import builtin_names
from team.recording.reader import open_log
from tests.support import ROOT
from tests.system.processes import Processes
from tests.system.scenarios import short

PACKAGES = ("team", "central", "sim")
COMMAND = Path(sys.executable).with_name("teamslam")


async def test_a_user_s_own_folders_do_not_shadow_ours(team: Processes) -> None:
    for package in PACKAGES:
        folder = team.folder / package
        folder.mkdir()
        (folder / "__init__.py").write_text("raise RuntimeError('this is the user\\'s own')\n")
        (team.folder / f"{package}.py").write_text("raise RuntimeError('the user\\'s own')\n")
    launch = await team.run(
        "launch",
        [COMMAND, "launch", short(team.folder, steps=20), "--no-report", "--output", "run"],
    )
    assert await launch.ended() == 0, launch.said()
    assert open_log(team.folder / "run" / "log.mcap").complete


async def done(team: Processes, name: str, command: Sequence[object]) -> str:
    """Output of a command that ends with 0, without a PYTHONPATH to our sources."""
    words = ["env", "-u", "PYTHONPATH", *(str(word) for word in command)]
    process = await team.run(name, words)
    assert await process.ended() == 0, process.said()
    return process.said()


async def test_the_wheel_runs_in_an_environment_of_its_own(team: Processes) -> None:
    """Our dependencies are lent by the environment of the tests; nothing is fetched."""
    source, fresh = team.folder / "source", team.folder / "fresh"
    source.mkdir()
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    for package in PACKAGES:
        leave = shutil.ignore_patterns("__pycache__", "*.so")
        shutil.copytree(ROOT / package, source / package, ignore=leave)
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet"]
    offline = ["--no-deps", "--no-index"]
    build = [*pip, "wheel", *offline, "--no-build-isolation", "--wheel-dir", "dist", source]
    await done(team, "build", build)
    (wheel,) = (team.folder / "dist").glob("*.whl")

    await done(team, "venv", [sys.executable, "-m", "venv", "--without-pip", fresh])
    python = fresh / "bin" / "python"
    install = [pip[0], "-m", "pip", "--python", python, *pip[3:], "install", *offline, wheel]
    await done(team, "install", install)
    (packages,) = fresh.glob("lib/python*/site-packages")
    (packages / "lent.pth").write_text(sysconfig.get_path("purelib") + "\n")

    where = await done(team, "where", [python, "-P", "-c", "import sim; print(sim.__file__)"])
    assert Path(where.strip()).is_relative_to(fresh)
    teamslam = fresh / "bin" / "teamslam"
    version = await done(team, "version", [teamslam, "--version"])
    assert wheel.name.startswith(f"teamslam-{version.split()[1]}-")
    scenarios = await done(team, "scenarios", [teamslam, "scenarios"])
    assert [line.split()[0] for line in scenarios.splitlines()] == list(builtin_names())
    await done(team, "simulate", [teamslam, "simulate", "waypoints", "--output", "set"])
    assert (team.folder / "set" / "Robot3_Odometry.dat").stat().st_size > 0
