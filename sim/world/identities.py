"""Worlds with hidden identities, missed detections and clutter.

The stream keeps the true identities, unpublished, for the evaluation.
"""

from dataclasses import dataclass, replace

import numpy as np

from teamslam.sim.world.streams import NO_LABEL, Detections, RobotStream, WorldStreams
from teamslam.team import core
from teamslam.team.shapes import Bool, Float, Int64, UInt32


@dataclass(frozen=True)
class Hiding:
    """Parameters of hidden identities.

    tagged: share of landmarks that keep identities. missed: probability that a detection is
    omitted. clutter: share of false detections, uniform in the disc of radius reach_m, or of the
    robot's farthest detection.
    """

    tagged: float = 0.0
    missed: float = 0.0
    clutter: float = 0.0
    reach_m: float | None = None


def with_hidden_identities(streams: WorldStreams, hiding: Hiding, seed: int) -> WorldStreams:
    """Replace observations by detections; random numbers are keyed by seed, robot and purpose."""
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
    message = np.repeat(np.arange(len(seen.stamps_ns)), np.diff(seen.offsets))
    detected = rng.random(len(seen.ids)) >= hiding.missed
    named = np.isin(seen.ids, tagged)
    parts = [_rows(seen, message, detected & named, hidden=False)] if len(tagged) else []
    untagged = _rows(seen, message, detected & ~named, hidden=True)
    if hiding.clutter:
        untagged = _add_clutter(untagged, hiding, rng)
    both = in_order([*parts, untagged])
    # An empty scan stays a measurement of either kind.
    return replace(stream, landmark_detections=both)


def _rows(
    seen: Detections,
    message: Int64[np.ndarray, " R"],
    chosen: Bool[np.ndarray, " R"],
    *,
    hidden: bool,
) -> Detections:
    count = len(seen.stamps_ns)
    offsets = np.concatenate(([0], np.cumsum(np.bincount(message[chosen], minlength=count))))
    was = seen.hidden
    return Detections(
        stamps_ns=seen.stamps_ns,
        offsets=offsets.astype(np.int64),
        ids=seen.ids[chosen],
        ranges=seen.ranges[chosen],
        bearings=seen.bearings[chosen],
        points=None if seen.points is None or hidden else seen.points[chosen],
        covariances=_covariances(seen, chosen, hidden=hidden),
        hidden=np.full(count, hidden) if was is None else was | hidden,
        signatures=None if seen.signatures is None else seen.signatures[chosen],
        classes=None if seen.classes is None else seen.classes[chosen],
    )


def _covariances(
    seen: Detections, chosen: Bool[np.ndarray, " R"], *, hidden: bool
) -> Float[np.ndarray, "chosen 3"] | None:
    """Covariances of the chosen rows; hidden points are converted to range and bearing."""
    if seen.covariances is None:
        return None
    covariances: Float[np.ndarray, "chosen 3"] = seen.covariances[chosen]
    if hidden and seen.points is not None:
        points = seen.points[chosen]
        rows = ~np.isnan(points[:, 0])
        covariances[rows] = _of_ranges(points[rows], covariances[rows])
    return covariances


def _of_ranges(
    points: Float[np.ndarray, "n 2"], covariances: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 3"]:
    """(rr, rb, bb) of points with (xx, xy, yy): J S Jᵀ with J = ∂(range, bearing)/∂(x, y)."""
    ranges = np.maximum(core.hypot(points[:, 0], points[:, 1]), 1e-6)
    c, s = (points / ranges[:, np.newaxis]).T
    xx, xy, yy = covariances.T
    rr = c * c * xx + 2.0 * c * s * xy + s * s * yy
    rb = (c * s * (yy - xx) + (c * c - s * s) * xy) / ranges
    bb = (s * s * xx - 2.0 * c * s * xy + c * c * yy) / ranges**2
    return np.column_stack((rr, rb, bb))


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


def in_order(parts: list[Detections]) -> Detections:
    """Merge messages by time; at equal times those with identities first.

    Columns of only some parts, such as points or covariances, are NaN elsewhere.
    """
    if len(parts) == 1:
        return parts[0]
    stamps = np.concatenate([part.stamps_ns for part in parts])
    order = np.argsort(stamps, kind="stable")
    pieces = [part.only(i, i + 1) for part in parts for i in range(len(part.stamps_ns))]
    chosen = [pieces[i] for i in order if len(pieces[i].ids)]
    counts = [len(piece.ids) for piece in chosen]
    width = max((p.classes.shape[1] for p in chosen if p.classes is not None), default=0)

    def joined(values: list[Float[np.ndarray, "..."]]) -> Float[np.ndarray, "..."]:
        return np.concatenate(values)

    def optional(name: str, width: int) -> Float[np.ndarray, "..."] | None:
        values = [getattr(piece, name) for piece in chosen]
        if all(value is None for value in values):
            return None
        shapes = [(count, width) if width > 1 else (count,) for count in counts]
        return joined(
            [
                np.full(shape, np.nan) if value is None else value
                for value, shape in zip(values, shapes, strict=True)
            ]
        )

    return Detections(
        stamps_ns=np.concatenate([piece.stamps_ns for piece in chosen]),
        offsets=np.concatenate(([0], np.cumsum(counts))).astype(np.int64),
        ids=np.concatenate([piece.ids for piece in chosen]),
        ranges=joined([piece.ranges for piece in chosen]),
        bearings=joined([piece.bearings for piece in chosen]),
        points=optional("points", 2),
        covariances=optional("covariances", 3),
        hidden=np.concatenate([piece.hidden for piece in chosen if piece.hidden is not None]),
        signatures=optional("signatures", 1),
        classes=optional("classes", width),
    )
