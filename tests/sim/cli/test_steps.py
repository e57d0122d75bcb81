"""Progress of long work on standard error."""

import pytest

from teamslam.sim.cli import steps
from teamslam.sim.cli.steps import Steps


def test_short_work_says_nothing_and_long_work_what_it_does_and_how_far_it_is(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    at_s = [0.0]
    monkeypatch.setattr(steps.time, "monotonic", lambda: at_s[0])
    told = Steps()
    told.begin("scoring the run")
    told.share(0.3)
    assert capsys.readouterr().err == ""
    at_s[0] = 3.5
    told.share(0.42)
    told.share(0.43)
    told.begin("proving the ledger")
    at_s[0] = 7.0
    told.robot("r3")
    assert capsys.readouterr().err == "scoring the run: 42%\nproving the ledger: r3\n"
