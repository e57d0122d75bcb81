"""Worlds with hidden identities, missed detections and clutter."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from teamslam.sim.world.streams import (
    COLUMNS,
    NO_LABEL,
    Detections,
    RobotStream,
    WorldStreams,
    polar_covariances,
)
from teamslam.team import core
from teamslam.team.shapes import Float, UInt32


@dataclass(frozen=True)
class Hiding:
    """tagged: share of landmarks with identities. missed: probability of an omitted detection.
    clutter: share of false detections, uniform in the disc of radius reach_m, or of the farthest
    detection.
    """

    tagged: float = 0.0
    missed: float = 0.0
    clutter: float = 0.0
    reach_m: float | None = None


def with_hidden_identities(streams: WorldStreams, hiding: Hiding, seed: int) -> WorldStreams:
    """Replace observations by detections."""
    rng = np.random.default_rng([seed, 0x7A65])
    ids = np.unique(np.concatenate([s.landmark_detections.ids for s in streams.streams]))
    ids = ids[ids != NO_LABEL]
    tagged = ids[rng.random(len(ids)) < hiding.tagged]
    hidden = tuple(
        _hidden(stream, hiding, tagged, np.random.default_rng([seed, 0x7A66, index]))
        for index, stream in enumerate(streams.streams)
    )
    return replace(streams, streams=hidden)


def _hidden(
    stream: RobotStream, hiding: Hiding, tagged: UInt32[np.ndarray, " T"], rng: np.random.Generator
) -> RobotStream:
    seen = stream.landmark_detections
    detected = rng.random(len(seen.ids)) >= hiding.missed
    named = np.isin(seen.ids, tagged)
    parts = [_mark(seen.where(detected & named), hidden=False)] if len(tagged) else []
    untagged = _mark(seen.where(detected & ~named), hidden=True)
    if hiding.clutter:
        untagged = _add_clutter(untagged, hiding, rng)
    both = in_order([*parts, untagged])
    # An empty scan stays a measurement of either kind.
    return replace(stream, landmark_detections=both)


def _mark(seen: Detections, *, hidden: bool) -> Detections:
    marks = np.full(len(seen.stamps_ns), hidden)
    seen = replace(seen, hidden=marks if seen.hidden is None else seen.hidden | hidden)
    return replace(seen, points=None, covariances=_polar_covariances(seen)) if hidden else seen


def _polar_covariances(seen: Detections) -> Float[np.ndarray, "R 3"] | None:
    if seen.covariances is None or seen.points is None:
        return seen.covariances
    covariances = seen.covariances.copy()
    rows = ~np.isnan(seen.points[:, 0])
    x, y = seen.points[rows].T
    ranges = np.maximum(core.hypot(x, y), 1e-6)
    covariances[rows] = polar_covariances(x, y, ranges, covariances[rows])
    return covariances


def _add_clutter(seen: Detections, hiding: Hiding, rng: np.random.Generator) -> Detections:
    counts = np.diff(seen.offsets)
    ratio = hiding.clutter / (1.0 - hiding.clutter)
    false = rng.poisson(ratio * counts)
    farthest = float(seen.ranges.max(initial=1.0))
    total = int(false.sum())
    reach = hiding.reach_m or farthest
    ranges = reach * np.sqrt(rng.uniform(0.01, 1.0, total))
    bearings = rng.uniform(-np.pi, np.pi, total)
    message = np.concatenate(
        (np.repeat(np.arange(len(counts)), counts), np.repeat(np.arange(len(counts)), false))
    )
    shuffle = rng.random(len(message))
    order = np.lexsort((shuffle, message))
    covariances = seen.covariances
    if covariances is not None and len(covariances):
        drawn = covariances[rng.integers(0, len(covariances), total)]
        covariances = np.concatenate((covariances, drawn))[order]
    return replace(
        seen,
        offsets=np.concatenate(([0], np.cumsum(counts + false))).astype(np.int64),
        ids=np.concatenate((seen.ids, np.full(total, NO_LABEL, np.uint32)))[order],
        ranges=np.concatenate((seen.ranges, ranges))[order],
        bearings=np.concatenate((seen.bearings, bearings))[order],
        covariances=covariances,
        signatures=None,
        classes=None,
    )


def in_order(parts: Sequence[Detections]) -> Detections:
    """Merge messages by time, those with identities first; NaN in columns of other parts."""
    if len(parts) == 1:
        return parts[0]
    parts = [part for part in parts if len(part.ids)] or parts[:1]
    counts = np.concatenate([np.diff(part.offsets) for part in parts])
    stamps = np.concatenate([part.stamps_ns for part in parts])
    whole = Detections(
        stamps_ns=stamps,
        offsets=np.concatenate(([0], np.cumsum(counts))),
        hidden=np.concatenate([part.hidden for part in parts if part.hidden is not None]),
        **{name: _column(parts, name) for name in COLUMNS},
    )
    order = np.argsort(stamps, kind="stable")
    return whole.take(order[counts[order] > 0])


def _column(parts: Sequence[Detections], name: str) -> Any:
    values = [getattr(part, name) for part in parts]
    given = [each for each in values if each is not None]
    if not given:
        return None
    return np.concatenate([
        np.full((len(part.ids), *given[0].shape[1:]), np.nan) if each is None else each
        for part, each in zip(parts, values, strict=True)
    ])  # fmt: skip
