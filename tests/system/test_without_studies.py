import os
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path

from teamslam.team.recording.reader import open_log
from tests.support import ROOT
from tests.system.processes import Processes
from tests.system.scenarios import short

PACKAGES = ("team", "central", "sim", "teamslam")
PATIENCE_S = 300.0  # time limit [s] of a command
REMOVABLE = ("sim/studies",)
REMOVED = """import sys


class Removed:
    @staticmethod
    def find_spec(name, path=None, target=None):
        if f"{name}.".startswith("teamslam.sim.studies."):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
        return None


sys.meta_path.insert(0, Removed)
"""
"""Every process of the test begins with it: an editable install finds a removed package, which is
a direct child of another, in the checkout.
"""


def without_studies(folder: Path) -> Path:
    for package in PACKAGES:
        shutil.copytree(ROOT / package, folder / package, symlinks=True)
    for name in REMOVABLE:
        shutil.rmtree(folder / name, ignore_errors=True)
    (folder / "sitecustomize.py").write_text(REMOVED)
    return folder


async def done(
    team: Processes, sources: Path, name: str, words: Sequence[object], status: int = 0
) -> str:
    path = f"PYTHONPATH={sources}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"
    program = ["env", path, sys.executable, "-P", "-m", "teamslam"]
    process = await team.run(name, [*program, *(str(word) for word in words)])
    assert await process.ended(PATIENCE_S) == status, process.said()
    return process.said()


async def test_the_product_launches_records_reruns_and_shows_without_them(team):
    sources = without_studies(team.folder / "sources")
    scenario = short(team.folder, steps=30)
    await done(team, sources, "launch", ["launch", scenario, "--output", "run"])
    log = team.folder / "run" / "log.mcap"
    assert open_log(log).complete
    assert (team.folder / "run" / "report.html").is_file()
    assert "all equal" in await done(team, sources, "rerun", ["rerun", log, "--verify"])
    await done(team, sources, "view", ["view", log, "--export", "shown.mcap"])
    assert open_log(team.folder / "shown.mcap").complete
    chosen = ["launch", scenario, "--estimator", "ekf-slam", "--fusion", "latest"]
    said = await done(team, sources, "absent", chosen, status=2)
    assert "ekf-slam is not installed" in said
    study = await done(team, sources, "study", ["batch-reference", log], status=2)
    assert "`teamslam batch-reference` is a study" in study
