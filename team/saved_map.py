"""A saved map as a file, and as a submap of the team's set."""

import math
import re
from collections.abc import Mapping
from itertools import combinations
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from teamslam.team.config import MAP, SURVEY, UNNAMED
from teamslam.team.core import packed, unpacked
from teamslam.team.datum import Datum
from teamslam.team.geodesy import geodetic_from_local
from teamslam.team.shapes import Float
from teamslam.team.wire import messages as m
from teamslam.team.wire.arrays import floats, from_floats, from_ids, ids
from teamslam.team.wire.codec import WireError, decoded, encoded

LEAF_SIGMA = 1e-3
"""Standard deviation [m, rad] of the end pose of a saved map's submap, which nothing depends on."""


class SavedMapError(ValueError):
    """An unusable file; the text names it, the reason and the remedy."""


def read_map(path: Path) -> m.SavedMap:
    """Read and check the file of a saved map; raises SavedMapError."""
    try:
        return decoded(path.read_bytes(), m.SavedMap)
    except IsADirectoryError:
        raise SavedMapError(
            f"{path}: a folder is no saved map; if it is a run's, save its map by "
            f"`teamslam map save {path} -o site.map`"
        ) from None
    except OSError as error:
        raise SavedMapError(f"{path}: cannot be read: {error.strerror}") from None
    except WireError as error:
        remedy = {
            "wrong tag": "it is no saved map: `teamslam map save RUN -o site.map` writes one",
            "wrong version": "another version of teamslam has written it: save it again with this",
            "truncated": "it is cut off: copy or save it again",
        }.get(error.reason, "it is damaged or no saved map: save it again")
        raise SavedMapError(f"{path}: {remedy} ({error})") from None


def find_overlap(maps: Mapping[str, m.SavedMap]) -> str | None:
    """Describe the first two maps, by file, that have measurements in common; None without.

    A chain of days contains all sets of the earlier days; two maps may also share only some.
    """
    for (one, a), (other, b) in combinations(maps.items(), 2):
        first, second = set(a.sets), set(b.sets)
        if not first & second:
            continue
        if first == second:
            return f"{one} and {other} are maps of the same measurements: load one of them"
        if first < second or second < first:
            part, whole = (one, other) if first < second else (other, one)
            return (
                f"{whole} contains the measurements of {part}, which would count twice: load "
                f"{whole} only"
            )
        return (
            f"{one} and {other} have measurements in common, which would count twice: load one of "
            "them"
        )
    return None


def write_map(path: Path, saved: m.SavedMap) -> None:
    """Write the file of a saved map; raises SavedMapError."""
    try:
        path.write_bytes(encoded(saved))
    except OSError as error:
        raise SavedMapError(f"{path}: cannot be written: {error.strerror}") from None


def submap_of(saved: m.SavedMap) -> m.Submap:
    """Make the submap of a saved map: landmarks only, all distinct, before the team's time."""
    n = 2 * len(ids(saved.ids, "ids"))
    submap = member_of(
        saved.author,
        saved.ids,
        floats(saved.means, "means"),
        unpacked(floats(saved.covariance, "covariance"), n),
        saved.counts,
        config=saved.sets[-1],
    )
    submap = msgspec.structs.replace(submap, classes=saved.classes)
    rows = floats(saved.sensitivity, "sensitivity").reshape(len(saved.biases), n)
    if not len(rows):
        return submap
    rows = np.hstack([np.zeros((len(rows), 3)), rows])
    return msgspec.structs.replace(submap, biases=saved.biases, sensitivity=from_floats(rows))


def member_of(
    author: str,
    numbers: bytes,
    means: Float[np.ndarray, " n"],
    covariance: Float[np.ndarray, "n n"],
    counts: bytes,
    *,
    config: bytes,
) -> m.Submap:
    """Make a submap of landmarks only; numbers, counts: as in `SavedMap.ids` and `counts`."""
    n = len(means)
    joint = np.zeros((3 + n, 3 + n))
    joint[:3, :3] = LEAF_SIGMA**2 * np.eye(3)
    joint[3:, 3:] = covariance
    unnamed = ids(counts, "counts")[ids(numbers, "ids") >= UNNAMED]
    return m.Submap(
        stamp_ns=0,
        robot=author,
        incarnation=0,
        sequence=0,
        first_measurement=0,
        last_measurement=0,
        start_ns=0,
        config=config,
        ids=numbers,
        mean=from_floats(np.concatenate([np.zeros(3), means])),
        covariance=from_floats(packed(joint)),
        counts=from_ids(unnamed),
        seen=b"\1" * len(unnamed),
        keyframes=min(1, len(unnamed)),
    )


def datum_in(saved: m.SavedMap) -> Datum | None:
    """Read the datum of a saved map; None: not stated."""
    return Datum(*floats(saved.datum, "datum").tolist()) if saved.datum else None


def datum_bytes(datum: Datum | None) -> bytes:
    """Encode a datum as in `SavedMap.datum`."""
    if datum is None:
        return b""
    return from_floats([datum.latitude_deg, datum.longitude_deg, datum.height_m])


def map_name(text: str) -> str:
    """Check the name of a map; raises SavedMapError."""
    if re.fullmatch("[a-z][a-z0-9_]{0,31}", text) is None:
        raise SavedMapError(
            f"{text!r} is no name of a map: up to 32 small letters, digits and _, a letter first; "
            "give one by --name"
        )
    if MAP + text == SURVEY:
        raise SavedMapError(f"{text!r} names the surveyed landmarks; give another name by --name")
    return text


def map_figures(saved: m.SavedMap) -> dict[str, Any]:
    """Figures of a saved map: provenance, own errors, landmarks given the shared errors."""
    numbers = ids(saved.ids, "ids").tolist()
    points = floats(saved.means, "means").reshape(-1, 2).tolist()
    covariance = unpacked(floats(saved.covariance, "covariance"), 2 * len(numbers))
    sigmas = np.sqrt(np.diag(covariance)).reshape(-1, 2).tolist()
    counts = ids(saved.counts, "counts").tolist()
    datum, degrees = datum_in(saved), [dict[str, float]()] * len(numbers)
    if datum is not None:
        columns = ("latitude_deg", "longitude_deg")
        places = geodetic_from_local(datum, np.array(points)).tolist()
        degrees = [dict(zip(columns, each, strict=True)) for each in places]
    return {
        "name": saved.name,
        "frame": saved.frame,
        "stamp_s": saved.stamp_ns * 1e-9,
        "sets": [each.hex() for each in saved.sets],
        "biases": list(saved.biases),
        "own": _own_figures(saved),
        **({} if datum is None else {"datum": msgspec.to_builtins(datum)}),
        "software": saved.software,
        "core": saved.core,
        "landmarks": [
            {
                "landmark": number,
                "x_m": x,
                "y_m": y,
                "sigma_x_m": sigma_x,
                "sigma_y_m": sigma_y,
                "submaps": count,
                **place,
            }
            for number, (x, y), (sigma_x, sigma_y), count, place in zip(
                numbers, points, sigmas, counts, degrees, strict=True
            )
        ],
    }


def _own_figures(saved: m.SavedMap) -> list[dict[str, Any]]:
    K = len(saved.own)
    means = floats(saved.own_means, "own_means").tolist()
    variances = np.diag(unpacked(floats(saved.own_covariance, "own_covariance"), K)).tolist()
    return [
        {"robot": each.robot, "bias": each.bias, "value": value, "sigma": math.sqrt(variance)}
        for each, value, variance in zip(saved.own, means, variances, strict=True)
    ]
