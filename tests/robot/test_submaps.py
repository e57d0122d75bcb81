import gc

import numpy as np

from teamslam.team.estimation.hybrid_slam.window import ClosedWindow
from teamslam.team.estimation.submap import LocalMap
from teamslam.team.robot.maps import CONDENSED
from teamslam.team.robot.node import RobotNode
from teamslam.team.wire import channels as ch
from tests import build
from tests.teams import config, driven, of, published, stream


def test_a_stored_submap_has_the_bits_of_the_window_that_closed():
    windows: list[ClosedWindow] = []
    node = RobotNode(config(), on_window=windows.append)
    driven(node, published(stream("r1", 30)))
    stored = node.mapper.submaps
    assert len(stored) == len(windows) > 5
    for local, window in zip(stored, windows, strict=True):
        assert local.ids.tobytes() == window.local.ids.tobytes()
        assert local.mean.tobytes() == window.local.mean.tobytes()
        assert local.covariance.tobytes() == window.local.covariance.tobytes()
    assert [x.mean.tobytes() for x in stored[2:]] == [w.local.mean.tobytes() for w in windows[2:]]


def local_maps() -> int:
    gc.collect()
    return sum(isinstance(each, LocalMap) for each in gc.get_objects())


def test_of_closed_windows_a_robot_keeps_nothing_but_the_messages():
    """The number of local maps is that of the submaps that a prior lacks, at most 2 · CONDENSED."""
    before = local_maps()
    node = RobotNode(config())
    out = driven(node, published(stream("r1", 60)), end=False)
    assert len(of(out, ch.SUBMAP)) == 20
    del out
    assert local_maps() - before <= 1
    prior = build.prior(
        sequence=16,
        digest=bytes(8),
        mean=np.zeros(3).tobytes(),
        covariance=np.eye(3)[np.triu_indices(3)].tobytes(),
    )
    node.handle(prior)
    driven(node, published(stream("r1", 70))[len(published(stream("r1", 60))) :], end=False)
    assert 0 < local_maps() - before <= 2 * CONDENSED
