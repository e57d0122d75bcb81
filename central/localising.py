"""Localise robots in a saved map, which stays unchanged (`localise`).

The robots' submaps are their marginals without landmarks that the saved map lacks. Robots have no
start: the frame is the map's. Priors and paths are those of the joint solution.
"""

from collections.abc import Iterable
from dataclasses import replace

import msgspec
import numpy as np

from teamslam.central.fused_map import JOINT_LANDMARKS
from teamslam.team import translate
from teamslam.team.config import UNNAMED
from teamslam.team.core import packed, unpacked
from teamslam.team.estimation.contribution import Stream, is_map, named
from teamslam.team.estimation.map_joining.joining import EMPTY_FOLD, Fold
from teamslam.team.estimation.map_joining.saved_maps import REMEDY
from teamslam.team.wire import arrays, messages as m

NOT_JOINED = " not joined: "


def restricted(submap: m.Submap, maps: Iterable[m.SavedMap]) -> m.Submap:
    """Leave out the named landmarks of a submap that no saved map has."""
    numbers = arrays.ids(submap.ids, "ids")
    known = [arrays.ids(each.ids, "ids") for each in maps]
    keep = (numbers >= UNNAMED) | np.isin(numbers, np.concatenate([numbers[:0], *known]))
    if keep.all() or is_map((submap.robot, submap.incarnation)):
        return submap
    mean = arrays.floats(submap.mean, "mean")
    poses = len(mean) - 2 * len(numbers)
    rows = np.flatnonzero(np.concatenate([np.ones(poses, np.bool_), np.repeat(keep, 2)]))
    P = unpacked(arrays.floats(submap.covariance, "covariance"), len(mean))

    def kept(data: bytes, count: int, what: str) -> bytes:
        found = arrays.derivatives(data, len(mean) * count, what).reshape(count, len(mean))
        return arrays.from_derivatives(found[:, rows])

    return msgspec.structs.replace(
        submap,
        ids=arrays.from_ids(numbers[keep]),
        mean=arrays.from_floats(mean[rows]),
        covariance=arrays.from_floats(packed(P[np.ix_(rows, rows)])),
        sensitivity=kept(submap.sensitivity, len(submap.biases), "sensitivity"),
        curvature=kept(submap.curvature, int(bool(submap.curvature)), "curvature"),
    )


def in_saved_map(fold: Fold) -> Fold:
    """Return the fold with the island of the saved map alone, or empty; its reasons are why the
    other islands are not in that one. Merges of other islands are not listed.
    """
    key = next((key for stream, key in sorted(fold.home.items()) if is_map(stream)), None)
    if key is None:
        return EMPTY_FOLD
    home = {stream: at for stream, at in fold.home.items() if at == key}
    joined = {stream: words for stream, words in fold.joined.items() if stream in home}
    reasons = {**fold.reasons, **_refusals(fold, key)}
    return replace(fold, home=home, starts={}, reasons=reasons, joined=joined)


def _refusals(fold: Fold, key: Stream) -> dict[Stream, str]:
    of_map = fold.reasons.get(min(fold.islands[key].graph.streams), "")
    saved = named(next(stream for stream in sorted(fold.home) if is_map(stream)))
    found = {}
    for other, island in fold.islands.items():
        _, why = fold.judged.get((key, other)) or fold.judged.get((other, key)) or (0, "")
        if not why and other == fold.main_key:
            why = of_map.partition(NOT_JOINED)[2]
        if why and other != key:
            if saved not in why:
                why = f"with {saved} {why}; it may be the map of another site: {REMEDY}"
            streams = sorted(island.graph.streams)
            found[streams[0]] = ", ".join(map(named, streams)) + NOT_JOINED + why
    return found


def seeks_saved_map(fold: Fold, stream: Stream) -> bool:
    """Whether a robot is to be placed by a saved map's landmarks.

    No robot of the main island has a start or is in a saved map, and this one is alone in it or
    outside.
    """
    there = [each for each, key in fold.home.items() if key == fold.main_key]
    if any(each in fold.starts or is_map(each) for each in there):
        return False
    return len(there) == 1 or stream not in there


def saved_landmarks(fused: m.FusedMap, saved: m.SavedMap) -> m.FusedMap:
    """Replace the landmarks of a team's map by those saved."""
    n = len(arrays.ids(saved.ids, "ids"))
    joint = fused.final and n <= JOINT_LANDMARKS
    P = unpacked(arrays.floats(saved.covariance, "covariance"), 2 * n)
    return msgspec.structs.replace(
        fused,
        frame=translate.frame_name(saved.author, 0),
        joint=joint,
        ids=saved.ids,
        means=saved.means,
        covariance=translate.covariance_bytes(P, joint=joint),
    )
