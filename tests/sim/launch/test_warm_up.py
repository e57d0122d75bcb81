"""The kernels are compiled before a team starts, once per program."""

from pathlib import Path

import pytest

from sim.launch import warm_up
from team.estimation.geometry import wrapped
from team.estimation.map_joining.marginals import landmark_map


def test_the_submaps_that_are_made_up_to_compile_the_centre_make_a_map() -> None:
    fold = warm_up.fold_made_up_submaps()
    assert landmark_map(fold).means == pytest.approx(warm_up.PLACES, abs=1e-6)


def test_the_submaps_that_are_made_up_to_compile_the_robots_agree() -> None:
    found = warm_up.follow_made_up_submaps()
    assert found.known == (5, 5)
    assert found.whole.mean == pytest.approx([3.0, 0.0, 0.0, *warm_up.PLACES.ravel()], abs=1e-6)


def stamps() -> set[Path]:
    return set(Path(wrapped.stats.cache_path).glob("ready-*"))


def test_a_program_warms_its_kernels_up_once_and_another_program_its_own(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    before = stamps()
    ran: list[tuple[str, str]] = []
    monkeypatch.setattr(warm_up, "run_small_team", lambda *pair: ran.append(pair))
    monkeypatch.setattr(warm_up, "_VERSIONS", (str(tmp_path),))
    pairs = [("hybrid", "join"), ("hybrid", "join"), ("ekf-slam", "latest"), ("hybrid", "join")]
    try:
        for pair in pairs:
            warm_up.warm_up(*pair)
        assert ran == [("hybrid", "join"), ("ekf-slam", "latest")]
        monkeypatch.setattr(warm_up, "_VERSIONS", (str(tmp_path), "a later compiler"))
        warm_up.warm_up("hybrid", "join")
        assert ran[2:] == [("hybrid", "join")]
        assert len(stamps() - before) == 3
    finally:
        for stamp in stamps() - before:
            stamp.unlink()
