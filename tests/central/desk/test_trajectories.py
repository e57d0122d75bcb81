"""Errors of paths by the field's definitions, and the files for other tools.

tests/golden/evo.json holds the results of evo 1.38.1; where evo is installed it runs again, as a
separate program (GPL-3.0).
"""

import json
import shutil
import subprocess
import zipfile
from pathlib import Path as FilePath

import numpy as np
import pytest

from teamslam.central.desk.evaluation.errors import Path, trajectory_errors
from teamslam.central.desk.evaluation.evaluation import evaluate
from teamslam.central.desk.export.take_home import write_trajectories, write_tum
from tests.support import ROOT

GOLDEN = ROOT / "tests" / "golden" / "evo.json"
START_NS = 1_248_272_273_000_000_123
FIGURES = {
    "ape_m": ("evo_ape", "trans_part", ()),
    "ape_rad": ("evo_ape", "angle_rad", ()),
    "ape_aligned_m": ("evo_ape", "trans_part", ("-a",)),
    "ape_aligned_rad": ("evo_ape", "angle_rad", ("-a",)),
    "rpe_m": ("evo_rpe", "trans_part", ("--delta", "1", "--delta_unit", "f")),
    "rpe_rad": ("evo_rpe", "angle_rad", ("--delta", "1", "--delta_unit", "f")),
}


def paths() -> tuple[Path, Path]:
    """A loop with headings across ±π, and a noisy, shifted estimate of it."""
    rng = np.random.default_rng(7)
    stamps = START_NS + np.arange(60) * 500_000_000
    angle = np.linspace(0.0, 9.0, 60)
    true = np.column_stack((5.0 * np.cos(angle), 3.0 * np.sin(angle), angle + np.pi / 2))
    c, s = np.cos(0.2), np.sin(0.2)
    places = true[:, :2] @ np.array([[c, s], [-s, c]]) + [1.5, -0.7]
    noisy = np.column_stack((places, true[:, 2] + 0.2)) + 0.05 * rng.standard_normal((60, 3))
    return Path(stamps, noisy), Path(stamps, true)


def asked(program: str, relation: str, options: tuple[str, ...], folder: FilePath) -> float:
    estimate, true = paths()
    write_tum(estimate, folder / "estimate.tum")
    write_tum(true, folder / "true.tum")
    result = folder / "result.zip"
    result.unlink(missing_ok=True)
    tool = shutil.which(program)
    assert tool is not None
    command = [tool, "tum", str(folder / "true.tum"), str(folder / "estimate.tum")]
    command += ["-r", relation, *options, "--save_results", str(result)]
    subprocess.run(command, check=True, capture_output=True, timeout=120, env={"HOME": str(folder)})
    with zipfile.ZipFile(result) as archive:
        return float(json.loads(archive.read("stats.json"))["rmse"])


def test_evo_still_says_what_the_golden_file_holds(tmp_path):
    if shutil.which("evo_ape") is None:
        pytest.skip("evo_ape is not on the path: pip install evo, in an environment of its own")
    golden = json.loads(GOLDEN.read_text())
    for name, (program, relation, options) in FIGURES.items():
        assert asked(program, relation, options, tmp_path) == pytest.approx(golden[name], rel=1e-6)


def test_a_path_that_is_its_truth_has_no_error_and_another_frame_only_an_absolute_one():
    _, true = paths()
    exact = trajectory_errors(true, true)
    assert max(exact.ape_m, exact.ape_rad, exact.rpe_m, exact.rpe_rad) < 1e-12
    moved = Path(true.stamps_ns, true.poses + np.array([3.0, 4.0, 0.0]))
    found = trajectory_errors(moved, true)
    assert found.ape_m == pytest.approx(5.0)
    assert max(found.ape_aligned_m, found.rpe_m) < 1e-12


def test_a_file_has_each_pose_with_its_nanoseconds_and_its_turn(tmp_path):
    stamps = np.array([-1_500_000_000, 0, START_NS])
    poses = np.array([[1.0, 2.0, 0.0], [0.1, -0.2, np.pi], [3.0, 4.0, -np.pi / 2]])
    write_tum(Path(stamps, poses), tmp_path / "a.tum")
    lines = (tmp_path / "a.tum").read_text().splitlines()[1:]
    assert [line.split()[0] for line in lines] == [
        "-1.500000000", "0.000000000", "1248272273.000000123",
    ]  # fmt: skip
    rows = np.array([[float(x) for x in line.split()] for line in lines])
    np.testing.assert_array_equal(rows[:, 1:4], np.column_stack((poses[:, :2], np.zeros(3))))
    turns = 2.0 * np.arctan2(rows[:, 6], rows[:, 7])
    np.testing.assert_allclose(np.cos(turns - poses[:, 2]), 1.0)


def test_every_robots_paths_are_written_and_agree_with_the_figures(log, tmp_path):
    run = evaluate(log)
    written = write_trajectories(run, tmp_path)
    kinds = ("truth", "smoothed", "smoothed.truth", "online", "online.truth")
    assert {p.name for p in written} == {f"{r}.{k}.tum" for r in ("r1", "r2") for k in kinds}
    ours = trajectory_errors(run.robots["r1"].online_path, run.robots["r1"].truth)
    tables = [np.loadtxt(tmp_path / f"r1.online{k}.tum") for k in ("", ".truth")]
    np.testing.assert_array_equal(tables[0][:, 0], tables[1][:, 0])
    distances = np.hypot(*(tables[0][:, 1:3] - tables[1][:, 1:3]).T)
    assert np.sqrt(np.mean(distances**2)) == pytest.approx(ours.ape_m)
