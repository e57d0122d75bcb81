"""Score data association with labels that no estimator receives.

A landmark takes the majority label of its detections. A pair of detections with the same label and
landmark is right, with one label in two landmarks missed, with two labels in one landmark wrong.
"""

from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from teamslam.central.desk.evaluation.log import Collected
from teamslam.team.config import UNNAMED
from teamslam.team.shapes import Int64
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.arrays import ids, stamps

Place = tuple[str, int, int, int]
"""Robot, incarnation, sequence of the submap, landmark number in it."""
UNKNOWN = int(m.NO_LABEL)


@dataclass(frozen=True, kw_only=True)
class Pairs:
    """Pairs of labelled detections, and wrong detections."""

    right: int
    wrong: int
    missed: int
    wrong_detections: int
    detections: int

    @property
    def precision(self) -> float | None:
        """right/(right + wrong)."""
        associated = self.right + self.wrong
        return self.right / associated if associated else None

    @property
    def recall(self) -> float | None:
        """right/(right + missed)."""
        real = self.right + self.missed
        return self.right / real if real else None

    @property
    def f1(self) -> float | None:
        """Harmonic mean of precision and recall."""
        total = 2 * self.right + self.wrong + self.missed
        return 2.0 * self.right / total if total else None

    @property
    def wrong_percent(self) -> float | None:
        """Percentage of detections of another label than their landmark's."""
        return 100.0 * self.wrong_detections / self.detections if self.detections else None


@dataclass(frozen=True, kw_only=True)
class AssociationResult:
    """Association scores: over all detections, inside windows, and of the map.

    duplicates: landmarks beyond the first of a label; confirmed: with two submaps; shown: in the
    final map. merges_right: pairs of robots that share landmarks, half of which agree by label.
    merges_refused: pending attempts. left_out: labelled detections in no submap. clutter_in_map:
    unlabelled ones in a submap.
    """

    pairs: Pairs
    inside: Pairs
    label_of: Mapping[int, int]
    landmarks: int
    duplicates: int
    duplicates_confirmed: int
    duplicates_shown: int
    merges_right: int
    merges_wrong: int
    merges_refused: int
    left_out: int
    clutter_in_map: int


def association_result(log: Collected) -> AssociationResult | None:
    """Compute the scores; None without labels."""
    labels = _labels(log)
    if all(label == UNKNOWN for label in labels.values()):
        return None
    final = log.final_map
    detections = list(_detections(log, labels))
    places = [place for _, place, _ in detections]
    # Without submaps, a place has the number of the estimator's own map.
    identity = _identities(final) or {place: place[3] for place in places if place is not None}
    label = np.array([each[0] for each in detections], np.int64)
    windows = [each[2] for each in detections]
    local = _numbered(places)
    joined = _numbered([None if p is None else identity.get(p, p) for p in places])
    known = label != UNKNOWN
    votes, submaps = _votes(label, places, identity)
    label_of = {number: _most_voted(of.values()) for number, of in votes.items()}
    several = len({place[:3] for place in identity}) > 1
    named = [number for number in label_of if label_of[number] != UNKNOWN]
    confirmed = [number for number in named if len(submaps[number]) > 1 or not several]
    decisions = () if final is None else final.decisions
    in_map = {*confirmed} if final is None else {*ids(final.ids, "ids").tolist()}
    right, wrong = _merges(votes.values())
    return AssociationResult(
        pairs=_pairs(label[known], joined[known]),
        inside=_pairs(label[known], local[known], _numbered(windows)[known]),
        label_of=label_of,
        landmarks=len(label_of),
        duplicates=_beyond_the_first(named, label_of),
        duplicates_confirmed=_beyond_the_first(confirmed, label_of),
        duplicates_shown=_beyond_the_first(in_map.intersection(confirmed), label_of),
        merges_right=right,
        merges_wrong=wrong,
        merges_refused=sum(each.kind == "waits" for each in decisions),
        left_out=int(np.count_nonzero(known & (local < 0))),
        clutter_in_map=int(np.count_nonzero(~known & (local >= 0))),
    )


def _beyond_the_first(numbers: Collection[int], label_of: Mapping[int, int]) -> int:
    return len(numbers) - len({label_of[number] for number in numbers})


def _labels(log: Collected) -> dict[tuple[str, int, int], int]:
    found: dict[tuple[str, int, int], int] = {}
    for message in log.of_all(ch.TRUTH_LABELS, m.TruthLabels):
        counts = ids(message.counts, "counts").tolist()
        labels = iter(ids(message.labels, "labels").tolist())
        for stamp, count in zip(stamps(message.stamps, "stamps").tolist(), counts, strict=True):
            for row in range(count):
                found[message.robot, stamp, row] = next(labels)
    return found


def _detections(
    log: Collected, labels: Mapping[tuple[str, int, int], int]
) -> Iterable[tuple[int, Place | None, tuple[str, int, int]]]:
    seen: set[tuple[str, int, int]] = set()
    for message in log.of_all(ch.ASSOCIATION, m.Association):
        window = (message.robot, message.incarnation, message.sequence)
        if window in seen:
            continue
        seen.add(window)
        scans = np.repeat(stamps(message.stamps, "stamps"), ids(message.counts, "counts"))
        rows = ids(message.rows, "rows").tolist()
        numbers = ids(message.landmarks, "landmarks").tolist()
        for stamp, row, number in zip(scans.tolist(), rows, numbers, strict=True):
            label = labels.get((message.robot, stamp, row), UNKNOWN)
            yield label, (*window, number) if number >= UNNAMED else None, window


def members_of(fused: m.FusedMap) -> Iterator[tuple[Place, int]]:
    """Submap landmarks in a map, by number less UNNAMED, each with its number there."""
    for of in fused.memberships:
        columns = [ids(each, "members") for each in (of.sequences, of.locals, of.identities)]
        for sequence, local, identity in np.transpose(columns).tolist():
            yield (of.robot, of.incarnation, sequence, local), identity


def _identities(final: m.FusedMap | None) -> dict[Place, int]:
    members = () if final is None else members_of(final)
    return {(r, i, k, UNNAMED + local): identity for (r, i, k, local), identity in members}


def _numbered(values: Sequence[object]) -> Int64[np.ndarray, " n"]:
    numbers: dict[object, int] = {}
    return np.array(
        [-1 if v is None else numbers.setdefault(v, len(numbers)) for v in values], np.int64
    )


def _pairs(
    label: Int64[np.ndarray, " n"],
    landmark: Int64[np.ndarray, " n"],
    window: Int64[np.ndarray, " n"] | None = None,
) -> Pairs:
    window = np.zeros(len(label), np.int64) if window is None else window
    used = landmark >= 0
    real = _choose_two(np.column_stack((window, label)))
    associated = _choose_two(landmark[used][:, None])
    right = _choose_two(np.column_stack((window, label, landmark))[used])
    members, counts = np.unique(
        np.column_stack((landmark, label))[used], axis=0, return_counts=True
    )
    most: dict[int, int] = {}
    for (of, _), count in zip(members.tolist(), counts.tolist(), strict=True):
        most[of] = max(most.get(of, 0), count)
    return Pairs(
        right=right,
        wrong=associated - right,
        missed=real - right,
        wrong_detections=int(used.sum()) - sum(most.values()),
        detections=len(label),
    )


def _choose_two(rows: Int64[np.ndarray, "n columns"]) -> int:
    if not len(rows):
        return 0
    _, counts = np.unique(rows, axis=0, return_counts=True)
    return int((counts * (counts - 1) // 2).sum())


Votes = Mapping[str, Counter[int]]
"""Number of a landmark's detections by robot and label; a robot without labelled ones has none."""


def _votes(
    label: Int64[np.ndarray, " n"], places: list[Place | None], identity: Mapping[Place, int]
) -> tuple[dict[int, Votes], dict[int, set[Place]]]:
    votes: dict[int, dict[str, Counter[int]]] = {}
    submaps: dict[int, set[Place]] = {}
    for own, place in zip(label.tolist(), places, strict=True):
        if place is None or (number := identity.get(place)) is None:
            continue
        of_robot = votes.setdefault(number, {}).setdefault(place[0], Counter())
        of_robot.update([own] * (own != UNKNOWN))
        submaps.setdefault(number, set()).add((*place[:3], 0))
    return {**votes}, submaps


def _most_voted(votes: Iterable[Counter[int]]) -> int:
    total = sum(votes, Counter[int]())
    return max(sorted(total), key=total.__getitem__, default=UNKNOWN)


def _merges(votes: Iterable[Votes]) -> tuple[int, int]:
    """Pairs of robots that share landmarks, at least half of which agree by label, and others."""
    agreed: dict[tuple[str, str], list[bool]] = {}
    for by_robot in votes:
        best = {robot: _most_voted([of]) for robot, of in by_robot.items() if of}
        for a, b in combinations(sorted(best), 2):
            agreed.setdefault((a, b), []).append(best[a] == best[b])
    right = sum(2 * sum(each) >= len(each) for each in agreed.values())
    return right, len(agreed) - right
