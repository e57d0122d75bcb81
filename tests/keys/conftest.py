from datetime import UTC, datetime, timedelta

import pytest

from teamslam.team.keys.authority import make_keys
from teamslam.team.keys.roster import nodes_of
from tests.keys.certificates import TEAM, Folders


@pytest.fixture(scope="session")
def keys(tmp_path_factory):
    folders = Folders(*(tmp_path_factory.mktemp(name) for name in ("own", "strange", "ended")))
    nodes = [*nodes_of(["r1", "r2"])]
    make_keys(folders.own, TEAM, nodes)
    make_keys(folders.strange, TEAM, nodes)
    past = datetime.now(UTC) - timedelta(days=3)
    for path in folders.own.iterdir():
        (folders.ended / path.name).write_bytes(path.read_bytes())
    make_keys(folders.ended, TEAM, [], renew=["robot-r1"], days=1.0, now=past)
    return folders
