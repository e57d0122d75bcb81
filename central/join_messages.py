"""Make the messages of a fold: the map, priors for robots, their paths."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Literal, NamedTuple

import numpy as np

from teamslam.central.config import CentralConfig
from teamslam.central.fixes import fix_warnings
from teamslam.central.monitor import miscalibrations
from teamslam.central.saved_maps import sensor_warnings
from teamslam.central.sent_priors import in_main_island
from teamslam.central.survey import survey_warnings
from teamslam.team import translate
from teamslam.team.config import UNNAMED
from teamslam.team.estimation.association.verification import find_possible_duplicates
from teamslam.team.estimation.contribution import Stream, first_of, is_map, named, whole_of
from teamslam.team.estimation.gaussian import NO_LANDMARKS, LandmarkGaussian
from teamslam.team.estimation.map_joining import distinctness, landmark_view, marginals
from teamslam.team.estimation.map_joining.alignment import NEEDED, SharedPoints
from teamslam.team.estimation.map_joining.fold_association import view_island
from teamslam.team.estimation.map_joining.joining import Fold
from teamslam.team.estimation.map_joining.marginals import BiasEstimate
from teamslam.team.estimation.map_joining.minima import MISFIT, RIVAL
from teamslam.team.estimation.map_joining.tick import describe_refusals
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.arrays import from_floats, from_ids
from teamslam.team.wire.bus import Outgoing

Tail = Literal["final", "closed", "provisional"]
"""The kind of a map: the last one; one with all submaps up to a time; one with later ones, too."""
PRIOR_LANDMARKS = 30  # most landmarks in a robot's prior: the nearest ones
CONFIRMED_BY = 2
"""Least submaps of an unnamed landmark in the final map; a few false detections in a row look like
one. Running maps show tentative ones, too.
"""
NAMED = 10  # most names in a list of omitted landmarks, refusals, or robots of an island
LANDMARKS_ALONE = 100
"""Most landmarks, those nearest to the frame's origin, in the prior of a robot outside the map."""
FEW = 3  # most pairs of landmarks without names in such a list
NONE_SHARED = f"not joined: {SharedPoints(0)}, "


def encoded_landmarks(
    fold: Fold, shown: Sequence[int], *, joint: bool
) -> tuple[bytes, bytes, bytes]:
    """Encode ids, means and covariance of landmarks."""
    if not fold.contributions:
        return b"", b"", b""
    if joint:
        ids, means, matrix = marginals.landmark_map(fold, shown)
        return from_ids(ids), from_floats(means), translate.joint_bytes(matrix)
    ids, means, blocks = marginals.landmark_blocks(fold, shown)
    return from_ids(ids), from_floats(means), translate.block_bytes(blocks)


class Shown(NamedTuple):
    """The landmarks of a map, by ascending id.

    Left out: undecided, possible duplicates of a shown one; weak, missed, `repeated`: see
    `distinctness`. headings: largest heading standard deviation [rad] of each lost stream. tied: by
    odometry alone.
    """

    ids: Sequence[int] = ()
    undecided: Mapping[int, int] = MappingProxyType({})
    weak: Sequence[int] = ()
    missed: Sequence[int] = ()
    headings: Mapping[Stream, float] = MappingProxyType({})
    repeated: Sequence[distinctness.Repetition] = ()
    tied: Sequence[distinctness.OdometryTie] = ()


def shown_landmarks(fold: Fold, config: CentralConfig, tail: Tail) -> Shown:
    """Select the landmarks of the map; the final one has unnamed ones only if surely different."""
    if not fold.contributions:
        return Shown()
    if tail != "final":
        return Shown(marginals.confirmed(fold, config.landmark_submaps))
    most = len(fold.main.graph.submaps) + fold.condensed_count
    least = min(CONFIRMED_BY, most)
    ids = marginals.confirmed(fold, config.landmark_submaps, least)
    if not fold.condensed_count:
        ids = sorted({*ids}.difference(distinctness.find_disagreeing(fold, ids, least)))
    unnamed = [id_ for id_ in ids if id_ >= UNNAMED]
    if not unnamed:
        return Shown(ids)
    weak = distinctness.find_weakly_placed(fold.main, unnamed)
    seldom = distinctness.find_missed(fold, {*unnamed} - {*weak})
    out, view = {*weak, *seldom}, view_island(fold.main, fold.landmarks)
    unnamed = [id_ for id_ in unnamed if id_ not in out]
    parts = distinctness.find_parts(fold.main) if not fold.condensed_count else {}
    undecided = find_possible_duplicates(view, unnamed, parts)
    left = [id_ for id_ in ids if id_ not in out | {*undecided}]
    repeated = distinctness.find_repetitions(fold.main, left)
    copies = {id_ for each in repeated for id_ in each.ids}
    left = [id_ for id_ in left if id_ not in copies]
    lost = distinctness.find_lost_streams(fold.main)
    tied = (
        distinctness.find_odometry_ties(fold.main, left, undecided)
        if not fold.condensed_count
        else []
    )
    return Shown(left, undecided, weak, seldom, lost, repeated, tied)


def reasons(
    fold: Fold,
    shown: Shown,
    biases: Sequence[BiasEstimate],
    landmark_submaps: int,
    *,
    is_explained: bool = False,
) -> tuple[str, ...]:
    """List why robots and landmarks are not in the map, and warnings about the map."""
    diagnosed = (RIVAL, MISFIT) if is_explained else (RIVAL,)
    return (
        *_apart(fold),
        *_worded(describe_refusals(fold)),
        *(words for words in fold.warnings if not words.startswith(diagnosed)),
        *(survey_warnings(fold) if fold.has_maps else ()),
        *(fix_warnings(fold) if fold.has_maps else ()),
        *(sensor_warnings(fold) if fold.has_maps else ()),
        *_lost(shown),
        *_repeated(shown),
        *_tied(shown),
        *_left_out(fold, shown, landmark_submaps),
        *miscalibrations(biases),
    )


def _lost(shown: Shown) -> Iterator[str]:
    for stream, sigma in sorted(shown.headings.items()):
        yield (
            f"{named(stream)} was lost: its heading is known to {np.degrees(sigma):.0f}° at worst; "
            "its path there is not to be trusted"
        )


def _repeated(shown: Shown) -> Iterator[str]:
    for each in shown.repeated:
        x, y = each.place
        dx, dy, turn = each.displacement
        yield (
            f"two places look alike: from submap {each.first} on (t = {each.begin_ns * 1e-9:.0f} "
            f"to {each.end_ns * 1e-9:.0f} s) {named(each.stream)} maps {len(each.ids)} landmarks "
            f"that it shares with nothing before, and {len(each.pairs)} of them repeat the shape "
            f"of {len(each.pairs)} others; either the building repeats itself, or the robot was "
            f"carried off or slipped at ({x:.1f}, {y:.1f}) m by ({dx:+.1f}, {dy:+.1f}) m and "
            f"{np.degrees(turn):+.0f}°; these landmarks are left out"
        )


def _tied(shown: Shown) -> Iterator[str]:
    for each in shown.tied:
        metres, radians = each.sigmas
        yield (
            f"the map may be wrong from submap {each.first} of {named(each.stream)} on (t = "
            f"{each.begin_ns * 1e-9:.0f} to {each.end_ns * 1e-9:.0f} s): odometry alone, to "
            f"{metres:.1f} m and {np.degrees(radians):.0f}°, places its {each.later} landmarks "
            f"beside the {each.earlier} others; some of them may be the same, and if the robot was "
            "carried off or slipped there, no landmark shows it: drive past landmarks of both"
        )


def _left_out(fold: Fold, shown: Shown, landmark_submaps: int) -> tuple[str, ...]:
    if not fold.contributions:
        return ()
    known = landmark_view.known(fold.main)
    copies = {id_ for each in shown.repeated for id_ in each.ids}
    out = sorted({*known} - {*shown.ids, *shown.undecided, *shown.weak, *shown.missed, *copies})
    needed = max(landmark_submaps, CONFIRMED_BY if out and out[-1] >= UNNAMED else 0)
    pairs = [f"{id_} with {other}" for id_, other in sorted(shown.undecided.items())]
    named_out = [str(id_) for id_ in out if id_ < UNNAMED]
    return tuple(
        f"left out, {why}: {count} of {len(known)} landmarks{_listed(names, most)}"
        for why, count, names, most in (
            (f"{needed} submaps that agree needed", len(out), named_out, NAMED),
            ("may be one with another landmark", len(pairs), pairs, FEW),
            ("seen by robots that were lost", len(shown.weak), (), 0),
            ("missed by nearly all that looked there", len(shown.missed), (), 0),
        )
        if count
    )


def _listed(names: Sequence[str], most: int) -> str:
    return f" ({', '.join(names[:most])}{', …' * (len(names) > most)})" if names else ""


def priors(
    fold: Fold, shown: Sequence[int], fused: m.FusedMap, requested: Collection[Stream]
) -> list[Outgoing]:
    """Make the priors of these streams; outside the team's map they withdraw earlier ones."""
    given = [] if fused.final else [s for s in sorted(requested) if in_main_island(fold, s)]
    parts = [fold.latest_part(stream) for stream in given]
    found = marginals.main_priors(fold, parts, PRIOR_LANDMARKS, shown) if given else {}
    out = []
    for stream in sorted(requested):
        part = fold.latest_part(stream)
        if part in found:
            last = fold.next_sequence(part) - 1
            message = translate.prior_message(fused, stream, last, found[part])
        else:
            is_alone = gets_landmarks_alone(fold, shown, fused, stream)
            landmarks = _landmarks_alone(fold, shown) if is_alone else NO_LANDMARKS
            factor = fold.main.settings.covariance_factor if is_alone else 1.0
            message = translate.landmark_prior_message(fused, stream, landmarks, fold.frame, factor)
        out.append(Outgoing(ch.PRIOR, stream[0], message))
    return out


def gets_landmarks_alone(
    fold: Fold, shown: Sequence[int], fused: m.FusedMap, stream: Stream
) -> bool:
    """Whether a stream outside the team's map gets a running map's landmarks."""
    if fused.final or stream[0] in fused.withdrawn or in_main_island(fold, stream):
        return False
    named_ones = sum(id_ < UNNAMED for id_ in shown)
    return named_ones >= NEEDED and fold.latest_part(stream) == stream


def _landmarks_alone(fold: Fold, shown: Sequence[int]) -> LandmarkGaussian:
    chosen = sorted(id_ for id_ in shown if id_ < UNNAMED)
    if len(chosen) > LANDMARKS_ALONE:
        points = landmark_view.points_of(fold.main, chosen)
        order = np.argsort((points * points).sum(axis=1), kind="stable")
        chosen = sorted(chosen[k] for k in order[:LANDMARKS_ALONE].tolist())
    return LandmarkGaussian(*marginals.landmark_map(fold, chosen))


def trajectories(
    fold: Fold, digest: bytes, submaps: Mapping[Stream, Sequence[m.Submap]]
) -> list[Outgoing]:
    """Make the path of every stream or part in the team's frame: the end poses of its submaps."""
    paths = []
    for part in sorted(stream for stream in fold.home if not is_map(stream)):
        if fold.home[part] != fold.main_key:
            continue
        found = marginals.trajectory(fold, *part)
        stream = whole_of(part)
        own = submaps[stream][first_of(part) :]
        message = translate.trajectory_message(
            stream,
            digest,
            [each.stamp_ns for each in own[: len(found.poses)]],
            found.poses,
            found.covariances,
            start=from_floats(found.start),
            start_covariance=from_floats(found.start_covariance),
            crosses=from_floats(found.crosses),
        )
        paths.append(Outgoing(ch.TRAJECTORY, part[0], message))
    return paths


def _apart(fold: Fold) -> Iterator[str]:
    """Describe why islands are not joined: without landmark names the test that failed last."""
    frames = {min(fold.islands[key].graph.streams): key for key in fold.islands}
    for frame in sorted(frames):
        key = frames[frame]
        if key == fold.main_key:
            continue
        by_name = fold.reasons.get(frame, "")
        found = _best_attempt(fold, key)
        if found is None and (by_name and not (fold.has_unnamed and NONE_SHARED in by_name)):
            yield by_name
            continue
        streams = sorted(fold.islands[key].graph.streams)
        who = ", ".join(map(named, streams[:NAMED])) + ", …" * (len(streams) > NAMED)
        why = "no place that fits was found in another map" if found is None else found
        yield f"{who} not joined: {why}"


def _best_attempt(fold: Fold, key: Stream) -> str | None:
    attempts = []
    for (stream, other), decision in sorted(fold.landmarks.waits.items()):
        mine = fold.home[stream]
        if other in fold.islands and mine != other and key in (mine, other):
            partner = other if mine == key else mine
            attempts.append((decision.pairs, decision.llr, partner, decision.why))
    if not attempts:
        return None
    *_, partner, why = max(attempts, key=lambda each: each[:2])
    return f"with {named(min(fold.islands[partner].graph.streams))} {why}"


def _worded(words: Sequence[str]) -> tuple[str, ...]:
    more = len(words) - NAMED
    return (*words[:NAMED], *([f"{more} more refusals"] if more > 0 else []))
