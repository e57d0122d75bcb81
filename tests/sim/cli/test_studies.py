"""The studies are a folder that an installation may lack: what is missing is named."""

import os
import shutil
import site
import subprocess
import sys
from pathlib import Path

import pytest

from teamslam.sim.cli.studies import COMMANDS

ROOT = Path(__file__).parents[3]


def without_studies(folder: Path) -> Path:
    for package in ("team", "central"):
        (folder / package).symlink_to(ROOT / package)
    shutil.copytree(ROOT / "teamslam", folder / "teamslam", symlinks=True)
    left_out = shutil.ignore_patterns("studies", "__pycache__")
    shutil.copytree(ROOT / "sim", folder / "sim", ignore=left_out)
    return folder


def teamslam(folder: Path, *words: str) -> "subprocess.CompletedProcess[str]":
    return subprocess.run(
        # -S: without the editable install, which would find the studies where they are.
        [sys.executable, "-S", "-c", "from teamslam.sim.cli.entry import main; main()", *words],
        cwd=folder,
        env={"PYTHONPATH": os.pathsep.join([str(folder), *site.getsitepackages()])},
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )


def test_without_the_studies_their_commands_say_so_and_the_others_run(tmp_path: Path) -> None:
    folder = without_studies(tmp_path)
    for words in (["experiment", "--help"], ["batch-reference", "a.mcap"]):
        asked = teamslam(folder, *words)
        assert asked.returncode == 2
        assert f"`teamslam {words[0]}` is a study" in asked.stderr
        assert "without the folder sim/studies" in asked.stderr
    listed = teamslam(folder, "scenarios")
    assert listed.returncode == 0, listed.stderr
    assert "thesis" in listed.stdout


@pytest.mark.parametrize("name", COMMANDS)
def test_with_the_studies_their_commands_are_there(name: str) -> None:
    from typer.testing import CliRunner

    from teamslam.sim.cli.main import app

    shown = CliRunner().invoke(app, [name, "--help"])
    assert shown.exit_code == 0
    assert "is a study" not in shown.output
