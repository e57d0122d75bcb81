"""A world with hidden identities: the covariances of its detections, in any form."""

import msgspec
import numpy as np
import pytest

from teamslam.sim.scenarios.scenario import load
from teamslam.sim.scenarios.source import streams_of


def streams(form: str, identities: str):
    """Waypoints whose sensors claim the covariance of each measurement, in a form."""
    scenario = load("waypoints")
    world = msgspec.structs.replace(
        scenario.world,
        steps=60,
        landmark_form=form,
        landmark_claims=(0.5, 2.0),
        identities=identities,
    )
    return streams_of(msgspec.structs.replace(scenario, world=world)).streams


@pytest.mark.parametrize("form", ["ranges", "points"])
def test_hidden_detections_have_the_covariances_of_their_range_and_bearing(form: str) -> None:
    known, hidden = streams(form, "known")[0], streams(form, "hidden")[0]
    seen, unnamed = known.landmark_detections, hidden.landmark_detections
    assert unnamed.covariances is not None
    assert len(unnamed.ranges) > 20
    np.testing.assert_allclose(unnamed.ranges, seen.ranges)
    rr, rb, bb = unnamed.covariances.T
    # A point's covariance, turned into the line of sight: along it, and across it by the range.
    if form == "ranges":
        np.testing.assert_array_equal(unnamed.covariances, seen.covariances)
        return
    c, s = np.cos(seen.bearings), np.sin(seen.bearings)
    xx, xy, yy = seen.covariances.T
    np.testing.assert_allclose(rr, c * c * xx + 2 * c * s * xy + s * s * yy, rtol=1e-9)
    across = s * s * xx - 2 * c * s * xy + c * c * yy
    np.testing.assert_allclose(bb, across / seen.ranges**2, rtol=1e-9)
    np.testing.assert_allclose(
        rb * seen.ranges, c * s * (yy - xx) + (c * c - s * s) * xy, atol=1e-9
    )
