"""Saved maps and the fold: save its final map, and list changes since earlier days."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from importlib import metadata

import numpy as np

from teamslam.team import core, translate
from teamslam.team.config import BIASES, UNNAMED
from teamslam.team.datum import Datum
from teamslam.team.estimation import dense
from teamslam.team.estimation.consistency import chi2_limit
from teamslam.team.estimation.contribution import RobotBias, is_absolute, is_map, named, whole_of
from teamslam.team.estimation.gaussian import information
from teamslam.team.estimation.map_joining import saved_maps
from teamslam.team.estimation.map_joining.absence import absences
from teamslam.team.estimation.map_joining.fold_association import view_island
from teamslam.team.estimation.map_joining.gauss_newton import Island
from teamslam.team.estimation.map_joining.joining import Fold
from teamslam.team.estimation.map_joining.landmark_view import joint, points_of
from teamslam.team.estimation.map_joining.submap_graph import DRIFT
from teamslam.team.saved_map import datum_bytes
from teamslam.team.shapes import Float
from teamslam.team.wire import messages as m
from teamslam.team.wire.arrays import from_floats, from_ids, ids

SCALE = 3e-4
"""Share of all distances in a map by which every day may be off alike: the bias of the windows'
Gaussians, and of ranges whose scale is no state.
"""
REMAINDER = 1e-3  # part of a prior that stays in the evidence about an undetermined error

COUNTED_TWICE = "and count twice: use a map without them, or another day"
"""End of the warning of `describe_repetition`."""


class NothingToSaveError(ValueError):
    """A map that cannot be saved, with reason and remedy."""


def describe_repetition(robot: str, saved: m.SavedMap) -> str:
    """Describe that a robot's first submap of this day is in a saved map."""
    return (
        f"{robot}'s measurements of this day are in the saved map {saved.name} already, "
        f"{COUNTED_TWICE}"
    )


def save_map(
    fold: Fold,
    fused: m.FusedMap,
    name: str,
    before: Mapping[str, m.SavedMap],
    firsts: Collection[bytes],
    datum: Datum | None = None,
) -> m.SavedMap:
    """Make a saved map of a fold's final map; before: those of earlier days, by author. firsts:
    digests of the robots' first submaps, which reveal maps with measurements in common.

    With the biases c that all sensors share, landmarks and errors of single robots, y = (o, x), are
    N(ȳ + S (c − c̄), P − S C Sᵀ) given c, with S = Cov(y, c) C⁻¹. The map also has the likelihood
    of (c, o) by the measurements alone: the priors are the later day's, so that each counts once.

    Landmarks that are gone are left out. One that moved by e, which chance explains at SEQUENTIAL,
    has covariance P_ii + e eᵀ. Without a common bias of the ranges' scale, that of the map is
    uncertain by SCALE about the landmarks' centre.
    """
    gone = {each.landmark for each in fused.changes if each.state == "gone"}
    chosen = [id_ for id_ in ids(fused.ids, "ids").tolist() if id_ not in gone]
    if not 2 <= len(chosen) <= m.MOST_SAVED:
        raise NothingToSaveError(
            f"the final map has {len(chosen)} landmarks; a saved map has 2 to {m.MOST_SAVED}"
        )
    island = fold.main
    biases = tuple(bias for bias in sorted(BIASES) if bias in island.graph.common)
    own = _own_errors(island)
    nodes = [*(island.graph.common[bias] for bias in biases), *own.values()]
    likeliest, evidence = _evidence(island, nodes if own else ())
    mean, P = joint(island, nodes, chosen)
    k, K = len(biases), len(own)
    rows = dense.product(information(P[:k, :k], "the common biases"), P[:k, k:])
    means = mean[k:] - dense.product(mean[:k], rows)
    among = P[k:, k:] - dense.product(P[k:, :k], rows)
    among = 0.5 * (among + among.T)
    given = among[K:, K:]
    for each in fused.changes:
        if each.state == "moved" and each.chi2 < chi2_limit(2, saved_maps.SEQUENTIAL):
            at, e = 2 * chosen.index(each.landmark), np.array([each.dx, each.dy])
            given[at : at + 2, at : at + 2] += np.outer(e, e)
    if "range_scale" not in biases:
        points = means[K:].reshape(-1, 2)
        away = SCALE * (points - points.mean(axis=0)).ravel()
        given += np.outer(away, away)
    frame = fold.frame
    joined = [stream for stream, key in fold.home.items() if key == fold.main_key]
    earlier = [before[robot] for robot, _ in joined if robot in before]
    unnamed = [id_ for id_ in chosen if id_ >= UNNAMED]
    numbers = [id_ for id_ in chosen if id_ < UNNAMED]
    return m.SavedMap(
        stamp_ns=max([fused.stamp_ns, *(each.stamp_ns for each in earlier)]),
        name=name,
        ids=from_ids([*numbers, *range(UNNAMED, UNNAMED + len(unnamed))]),
        means=from_floats(means[K:]),
        covariance=translate.joint_bytes(given),
        biases=biases,
        sensitivity=from_floats(rows[:, K:]),
        counts=from_ids(_counts(island, chosen, before)),
        frame="" if frame is None else translate.frame_name(*frame),
        sets=tuple(sorted({*firsts, *(one for each in earlier for one in each.sets)})),
        software=metadata.version("teamslam"),
        core=core.digest[:16],
        datum=datum_bytes(datum),
        own=tuple(m.RobotBias(robot=robot, bias=bias) for robot, bias in own),
        own_means=from_floats(means[:K]),
        own_covariance=translate.joint_bytes(among[:K, :K]),
        own_cross=from_floats(among[:K, K:]),
        own_sensitivity=from_floats(rows[:, :K]),
        likeliest=from_floats(likeliest),
        evidence=translate.joint_bytes(evidence),
        classes=_classes(fold, unnamed),
    )


def _classes(fold: Fold, unnamed: Sequence[int]) -> bytes:
    if not any(each.observation.unnamed.classes.size for each in fold.main.graph.observed):
        return b""
    view = view_island(fold.main, fold.landmarks)
    assert view.joint.classes is not None
    return from_floats(view.joint.classes[[view.place_of[id_] for id_ in unnamed]])


def _own_errors(island: Island) -> dict[RobotBias, int]:
    found: dict[RobotBias, int] = {}
    for (stream, bias), node in sorted(
        island.graph.biases.items(), key=lambda each: (whole_of(each[0][0]), each[0])
    ):
        if bias in DRIFT and not is_map(stream):
            found[RobotBias(stream[0], bias)] = node
    return dict(sorted(found.items())[: m.MOST_OWN])


def _evidence(
    island: Island, nodes: Sequence[int]
) -> tuple[Float[np.ndarray, " E"], Float[np.ndarray, "E E"]]:
    """Compute the likelihood N(mean, J⁻¹) of some biases by the island's measurements: (mean, J).

    J = Σ⁻¹ − D with their posterior covariance Σ and the information D of their priors about 0, of
    which a part REMAINDER stays. The error of an earlier day that a bias drifted from is eliminated
    without its prior.
    """
    if not nodes:
        return np.zeros(0), np.zeros((0, 0))
    graph, weights = island.graph, island.estimate.prior_weights
    ties = [each.nodes for each in graph.priors if each.is_of_robot and len(each.nodes) > 1]
    both = [*nodes, *(before for own, before in ties if own in nodes)]
    place = {node: k for k, node in enumerate(both)}
    mean, covariance = joint(island, both, [])
    J = information(covariance, "the errors of the sensors")
    slope = dense.product(J, mean)
    for prior, weight in zip(graph.priors, weights.tolist(), strict=True):
        k = place.get(prior.nodes[0])
        if k is not None and len(prior.nodes) == 1:
            J[k, k] -= (1.0 - REMAINDER) * weight * prior.information[0, 0]
    E, what = len(nodes), "the evidence about the errors of the sensors"
    gain = dense.product(information(J[E:, E:], what), J[E:, :E])
    evidence = J[:E, :E] - dense.product(J[:E, E:], gain)
    evidence = 0.5 * (evidence + evidence.T)
    slope = slope[:E] - dense.product(slope[E:], gain)
    return dense.product(information(evidence, what), slope), evidence


def _counts(
    island: Island, chosen: Sequence[int], before: Mapping[str, m.SavedMap]
) -> Sequence[int]:
    count = np.zeros(len(island.graph.fixed), np.int64)
    for submap in island.graph.submaps:
        saved = before.get(submap.contribution.robot)
        count[submap.landmarks] += 1 if saved is None else ids(saved.counts, "counts")
    node_of = island.graph.landmarks
    return [max(1, int(count[node_of[id_]])) if id_ in node_of else 1 for id_ in chosen]


def sensor_warnings(fold: Fold) -> Iterator[str]:
    """Warn of robots whose own errors differ from a saved map's."""
    if fold.main_key is None:
        return
    for each in saved_maps.replaced_sensors(fold.main):
        robot, bias = each.error
        yield (
            f"{robot}: its {bias} is {each.value:.3g} and was {each.before:.3g} in "
            f"{named(each.saved)} (chi² {each.chi2:.0f}): a sensor, wheel or robot was exchanged; "
            "the saved value has no weight"
        )


def landmark_changes(fold: Fold, shown: Sequence[int]) -> tuple[m.LandmarkChange, ...]:
    """List the state of each landmark against the saved map in the main island with the largest
    change, by number.

    A landmark that one submap places elsewhere, while none sees it at its former place, is gone. An
    unnamed one has moved if its former place is empty; else the other place is a new landmark's.
    """
    if fold.main_key is None:
        return ()
    graph = fold.main.graph
    earlier = [
        each for each in saved_maps.maps_of(graph) if not is_absolute(each.contribution.stream)
    ]
    if not earlier:
        return ()
    island, found = fold.main, dict[int, m.LandmarkChange]()
    limit = chi2_limit(2, saved_maps.FALSE_ALARM)
    id_of = {node: id_ for id_, node in island.graph.landmarks.items()}
    own = {
        node
        for each in island.graph.submaps
        if not is_map(each.contribution.stream)
        for node in each.landmarks.tolist()
    }
    former: dict[int, int] = {}
    old: set[int] = {id_ for stream, id_ in graph.former if not is_absolute(stream)}
    for saved in earlier:
        old |= {id_of[node] for node in saved.landmarks.tolist() if node in id_of}
        for each in saved_maps.displacements(island, saved):
            is_beyond, is_unnamed = each.is_apart or each.chi2 > limit, each.landmark >= UNNAMED
            is_sure = not is_beyond or saved_maps.is_confirmed(graph, saved, each.landmark)
            if each.is_apart and (is_unnamed or not is_sure):
                former[each.landmark] = graph.former[saved.contribution.stream, each.landmark]
            before = found.get(each.landmark)
            if before is None or before.chi2 < each.chi2:
                found[each.landmark] = m.LandmarkChange(
                    landmark=each.landmark,
                    state="moved" if is_beyond else "unchanged",
                    dx=float(each.by[0]),
                    dy=float(each.by[1]),
                    sigma=each.sigma_m,
                    chi2=max(each.chi2, 0.0),
                )
    unseen = sorted(id_ for id_ in old & {*shown} if island.graph.landmarks.get(id_) not in own)
    found |= {x.landmark: x for x in _judge_former_places(island, unseen, former, found)}
    for id_ in {*shown} - old:
        found[id_] = m.LandmarkChange(landmark=id_, state="new")
    return tuple(found[id_] for id_ in sorted(found))


def _judge_former_places(
    island: Island,
    unseen: Sequence[int],
    former: Mapping[int, int],
    moved: Mapping[int, m.LandmarkChange],
) -> Iterator[m.LandmarkChange]:
    """List the landmarks that are gone, and unnamed ones new beside a former place."""
    places = [points_of(island, unseen), island.points([*former.values()])]
    for id_, absence in zip(
        [*unseen, *former], absences(island, np.concatenate(places)), strict=True
    ):
        is_empty = absence.chance < saved_maps.FALSE_ALARM
        if id_ in former and id_ >= UNNAMED:
            if not is_empty:
                yield m.LandmarkChange(landmark=id_, state="new")
        elif is_empty:
            dx, dy = (moved[id_].dx, moved[id_].dy) if id_ in former else (0.0, 0.0)
            yield m.LandmarkChange(
                landmark=id_, state="gone", dx=dx, dy=dy, expected=absence.expected
            )
