"""Surveyed landmarks as a saved map whose start is exactly known.

Landmark i ~ N(surveyed place, P_i) in the team's frame, independent of the others. The survey
places streams without an initial pose; a contradictory landmark is separated from it.
"""

from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from teamslam.central.config import CentralConfig, SurveyedLandmark
from teamslam.team.config import GNSS, SURVEY, SURVEY_FRAME
from teamslam.team.datum import Datum
from teamslam.team.estimation import contribution
from teamslam.team.estimation.inter_robot import STATION_POSE
from teamslam.team.estimation.map_joining.joining import Fold
from teamslam.team.estimation.map_joining.saved_maps import displacements_apart
from teamslam.team.saved_map import datum_in, member_of
from teamslam.team.wire.arrays import floats, from_ids
from teamslam.team.wire.messages import FusedMap, SavedMap, Submap

FARTHEST_M = 2e5  # largest coordinate in the tangent plane of a datum
DIGEST = bytes(8)  # the configuration names the survey, its submap names no other one


def survey_of(
    surveyed: Sequence[SurveyedLandmark],
) -> tuple[Submap, contribution.InitialPoseFactor]:
    """Make the submap of surveyed landmarks about their centroid, and its exact start."""
    order = sorted(surveyed, key=lambda each: each.landmark)
    points = np.array([[each.x, each.y] for each in order])
    origin = points.mean(axis=0)
    covariance = np.zeros((2 * len(order), 2 * len(order)))
    for k, each in enumerate(order):
        covariance[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = each.matrix
    submap = member_of(
        SURVEY,
        from_ids([each.landmark for each in order]),
        (points - origin).ravel(),
        covariance,
        from_ids([1] * len(order)),
        config=DIGEST,
    )
    return submap, contribution.InitialPoseFactor(*contribution.SURVEYED, np.array([*origin, 0.0]))


def station() -> tuple[Submap, contribution.InitialPoseFactor]:
    """Make the station of fixes, a submap without landmarks, and its start."""
    submap = member_of(GNSS, b"", np.zeros(0), np.zeros((0, 0)), b"", config=DIGEST)
    return submap, contribution.InitialPoseFactor(*contribution.STATION, STATION_POSE)


def datum_of(config: CentralConfig, fused: FusedMap, maps: Iterable[SavedMap]) -> Datum | None:
    """Return the datum of a map's frame: the configuration's, else that of a loaded map in the
    survey's frame. None where a landmark is farther than FARTHEST_M, as with coordinates of a
    national grid.
    """
    places = floats(fused.means, "means")
    if fused.frame != SURVEY_FRAME or np.abs(places).max(initial=0.0) > FARTHEST_M:
        return None
    loaded = (datum_in(each) for each in maps if each.frame == SURVEY_FRAME)
    return config.datum or next((each for each in loaded if each is not None), None)


def survey_warnings(fold: Fold) -> Iterator[str]:
    """Warn of surveyed landmarks that contradict the map, and of saved maps with a survey."""
    if not fold.contributions:
        return
    for stream in sorted(
        s for s in fold.starts if contribution.is_map(s) and contribution.SURVEYED in fold.starts
    ):
        if not contribution.is_absolute(stream):
            yield (
                f"{contribution.named(stream)} contains a survey, which central.surveyed counts a "
                "second time: leave that out"
            )
    for each in displacements_apart(fold.main, contribution.SURVEYED):
        yield (
            f"the surveyed landmark {each.landmark} is ({each.by[0]:+.2f}, {each.by[1]:+.2f}) m "
            f"from its surveyed place, with a standard deviation of {each.sigma_m:.2g} m (chi² "
            f"{each.chi2:.0f}): it is left out of the survey; check its number and place in "
            "central.surveyed"
        )
