"""The command that installs what an extra needs."""

import sys
from importlib.metadata import PackageNotFoundError

import pytest

from teamslam.team import extras


def test_an_extra_is_installed_by_its_packages_wherever_we_come_from(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(sys, "executable", "/opt/a b/python")
    cluster = extras.install_command("cluster")
    assert cluster.startswith("'/opt/a b/python' -m pip install 'scipy>=")
    assert "'joblib>=1.5' 'distributed>=" in cluster
    assert "teamslam" not in cluster

    def unknown(_: str) -> None:
        raise PackageNotFoundError

    monkeypatch.setattr(extras, "requires", unknown)
    assert extras.install_command("cluster").endswith("pip install '.[cluster]'")
