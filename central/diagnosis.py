"""The causes of a map's misfit, with remedies: a function of the fold and the withdrawn robots'
submaps.

Landmarks with two places and jumps are hypotheses (`map_joining.hypotheses`), shared errors of a
robot's submaps states of the map. The covariance scale is judged beside all accepted causes.
"""

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from statistics import median
from types import MappingProxyType
from typing import Final, NamedTuple

import msgspec
import numpy as np

from teamslam.central.monitor import SCALE_SIGMAS, find_misscaled
from teamslam.central.withdrawal import SUSPICION, cost_share
from teamslam.team import core
from teamslam.team.config import MAP, UNNAMED
from teamslam.team.estimation import dense
from teamslam.team.estimation.contribution import Contribution, Stream, moment, named, part_of
from teamslam.team.estimation.gaussian import UNSOLVABLE, NotACovarianceError, information
from teamslam.team.estimation.map_joining import hypotheses, marginals
from teamslam.team.estimation.map_joining.continuity import Seam
from teamslam.team.estimation.map_joining.joining import Fold
from teamslam.team.estimation.map_joining.reflections import Reflection, find_reflections
from teamslam.team.estimation.se2 import Pose, compose, wrapped
from teamslam.team.shapes import Float
from teamslam.team.wire import messages as m

Values = Float[np.ndarray, " _"]
Covariance = Float[np.ndarray, "3 3"]
Spoilt = Mapping[Seam, Sequence[Contribution]]
NO_SPOILT: Spoilt = MappingProxyType({})
SIGMAS = 4.0  # least size of a shared error in its standard deviations
NONLINEAR = 0.08
"""Standard deviation of a shared error's estimate as a share of it: sensitivities are a smoother's,
the mean of particles answers errors by a few per cent more.
"""
LEAST_SHARED = 3  # least landmarks that a submap shares with the others' map to show a reflection
LEAST_MIRRORED = 4  # least number of such submaps
MIRRORED = 0.8  # least share of them that fit reflected, and not as they are
MIRRORED_REMEDY = (
    "negate the robot's bearings, or its odometry's turns if these are wrong "
    "(counter-clockwise is positive)"
)

BETWEEN = 0.25
"""Least distance of a moved landmark's mean from the middle of its two places to be at one of
them, as a share of the displacement.
"""
SEAM_DOF = 3.0  # degrees of freedom of a seam

REMEDY = "leave the robot on the ground, or restart its process where it is put down"
OFTEN = 3  # least number of times that a robot is carried off from which its bearings are doubted
SIGN_REMEDY = (
    "it is named several times: check the sign of its bearings first (counter-clockwise is "
    "positive, docs/faq.md)"
)
START_REMEDY = "correct its initial pose by that, or remove it: a robot is joined without one"
OTHER_START = "; two initial poses contradict each other, so {other}'s may be the wrong one"
"""For a team with two known initial poses, where no majority decides."""


class _SharedError(NamedTuple):
    """A shared error of a robot's submaps: cause, least size, unit, words, remedy."""

    cause: m.Cause
    least: float
    unit: str
    subject: str
    positive: str
    negative: str
    remedy: str


NOISY: Final = "noise_underestimated"
DOUBTFUL_SCALE = 10.0
"""Covariance scale, and inverse of one, from which the data are doubted beside the sigmas."""
MOST_SCALE = 100.0  # least covariance scale that no noise explains: sigmas ten times too small
_CLOCK = (
    "add {value:.3g} to its clock_offset_s, which moves its path to the camera's clock, or, to "
    "keep the team's clock, subtract {value:.3g} s from the stamps of its detections"
)
_ERRORS: Mapping[str, _SharedError] = {
    "clock_offset": _SharedError(
        "clock_offset", 0.02, " s", "camera clock is", "late", "early", _CLOCK
    ),
    "forward_scale": _SharedError(
        "odometry_scale",
        0.01,
        "",
        "odometry is",
        "too short",
        "too long",
        "multiply its motion.forward_scale by {factor:.4g}",
    ),
    "bearing": _SharedError(
        "bearing_offset",
        0.01,
        " rad",
        "bearings are",
        "to the left",
        "to the right",
        "add {value:.3g} to its sensor.bearing_offset",
    ),
    "range_offset": _SharedError(
        "range_offset",
        0.05,
        " m",
        "ranges are",
        "too long",
        "too short",
        "add {value:.3g} to its sensor.range_offset",
    ),
}
"""By the bias's name. Below the least size a calibration is no better."""


def diagnose(
    fold: Fold,
    biases: Sequence[marginals.BiasEstimate],
    withdrawn: Mapping[str, Sequence[Contribution]],
    normal: float,
    scale: float,
    *,
    final: bool,
    spoilt: Spoilt = NO_SPOILT,
    localise: bool = False,
) -> tuple[m.Diagnosis, ...]:
    """Find the causes of a map's misfit, the best one by evidence per degree of freedom first.

    withdrawn: submaps of withdrawn robots. normal: the right covariance scale; scale: the team's,
    or its cost per degree of freedom. final: see `find_misscaled`. spoilt: see `cuts_of`. localise:
    the map is a saved one, which may be mirrored itself.
    """
    if not fold.contributions or not fold.main.graph.submaps:
        return ()
    shared = list(_shared_errors(fold, biases, scale))
    reflected = [] if localise else list(_mirrored(fold, withdrawn))
    cuts = list(cuts_of(fold, spoilt))
    if final and not localise:
        reflected += [_reflected(each) for each in find_reflections(fold, _cut_robots(cuts))]
    mirrored = {each.robot for each in reflected}
    found = [*shared, *reflected, *(each for each in cuts if each.robot not in mirrored)]
    undecided = set() if final else _landmarks_of_saved_maps(fold)
    noise: list[m.Diagnosis] = []
    try:
        accepted, island = hypotheses.explain(fold.main)
    except UNSOLVABLE:
        accepted = []
    else:
        found += [
            m.Diagnosis(
                cause=each.cause,
                robot=each.subject if isinstance(each.subject, str) else "",
                landmark=each.subject if isinstance(each.subject, int) else None,
                value=each.value,
                sigma=each.sigma,
                evidence=each.evidence / each.dof,
                remedy=_start_remedy(fold, each) if _is_start(each) else _REMEDIES[each.cause],
                at_ns=each.at_ns,
                place=_first_place(each),
            )
            for each in accepted
            if each.subject not in mirrored | undecided and not _is_bent(each, shared)
        ]
        costs = marginals.unbounded_costs(island) if final else marginals.terms(island).submaps
        left = find_misscaled(costs, normal, final=final)
        noise = [_noise(*each) for each in left if each.robot not in mirrored]
    found = doubt_signs(found)
    found += _wrong_minimum(fold)
    found.sort(key=lambda each: (-each.evidence, each.cause, each.robot, each.landmark or 0))
    return (*found, *noise)


def _first_place(found: hypotheses.Hypothesis) -> tuple[float, ...]:
    if found.cause != hypotheses.MOVED:
        return ()
    island = found.island
    return tuple(island.value(island.graph.landmarks[int(found.subject)]).tolist())


def mark_places(found: Sequence[m.Diagnosis], fold: Fold) -> tuple[m.Diagnosis, ...]:
    """Add the place that a map has of each moved landmark: the map solves it as one place."""
    return tuple(
        msgspec.structs.replace(each, map_has=_held_place(each, fold))
        if each.cause == hypotheses.MOVED
        else each
        for each in found
    )


def _held_place(found: m.Diagnosis, fold: Fold) -> m.MapPlace:
    """Name the place of the two that the map's mean has, by its share of the displacement."""
    island = fold.main
    node = island.graph.landmarks.get(-1 if found.landmark is None else found.landmark)
    if node is None or not found.place:
        return ""
    x, y = island.value(node).tolist()
    (x0, y0), (dx, dy) = found.place, found.value
    share = ((x - x0) * dx + (y - y0) * dy) / (dx * dx + dy * dy)
    if abs(share - 0.5) < BETWEEN:
        return "between"
    return "first" if share < 0.5 else "second"


def _cut_robots(cuts: Sequence[m.Diagnosis]) -> list[str]:
    return sorted({each.robot for each in cuts})


def _reflected(found: Reflection) -> m.Diagnosis:
    return m.Diagnosis(
        cause="mirrored",
        robot=found.robot,
        value=(-1.0,),
        sigma=(0.0,),
        evidence=found.evidence,
        remedy=MIRRORED_REMEDY,
    )


def doubt_signs(found: Sequence[m.Diagnosis]) -> list[m.Diagnosis]:
    """Add the signs of the bearings to the remedies of a robot that is carried off again and again,
    as a mirrored one of few landmarks is without their names.
    """
    jumps = Counter(
        each.robot for each in found if each.cause == hypotheses.CARRIED_OFF and each.at_ns
    )
    return [
        msgspec.structs.replace(each, remedy=f"{each.remedy}; {SIGN_REMEDY}")
        if each.cause == hypotheses.CARRIED_OFF and jumps[each.robot] >= OFTEN
        else each
        for each in found
    ]


def _landmarks_of_saved_maps(fold: Fold) -> set[int | str]:
    """List the landmarks that may have moved since a saved map: the final map lists the changes."""
    graph = fold.main.graph
    maps = (graph.submaps[k].contribution.local for k in graph.saved_maps.tolist())
    return {id_ for each in maps for id_ in each.ids.tolist()}


def cuts_of(fold: Fold, spoilt: Spoilt = NO_SPOILT) -> Iterator[m.Diagnosis]:
    """Describe the cuts of a fold, except where a part lies where the odometry puts it, with the
    motion that the odometry did not measure, in the map's frame (x [m], y [m], turn [rad]), if both
    parts are in one island.

    spoilt: submaps that a cut leaves out between the parts; their motion was measured.
    """
    for cut in fold.cuts:
        later = part_of(cut.stream, cut.after)
        island = fold.island(*cut.stream)
        place = island.value(island.graph.streams[cut.stream][-1])
        by: tuple[float, ...] = ()
        sigma: tuple[float, ...] = ()
        if fold.home.get(later, later) == fold.home[cut.stream]:
            between = spoilt.get(cut, ())
            gap, spread = _gap(fold, cut.stream, later, between)
            is_plain = cut.after == cut.before + 1
            if is_plain and cost_share(_chi2(gap, spread), SEAM_DOF, SUSPICION) <= 1.0:
                continue
            is_whole = len(between) == cut.after - cut.before - 1
            if is_whole and fold.island(*later).graph.first_sequence(later) == cut.after:
                by = (float(gap[0]), float(gap[1]), wrapped(gap[2]))
                sigma = tuple(np.sqrt(np.maximum(np.diagonal(spread), 0.0)).tolist())
        yield m.Diagnosis(
            cause="carried_off",
            robot=cut.stream[0],
            value=by,
            sigma=sigma,
            evidence=cut.evidence,
            remedy=REMEDY,
            at_ns=cut.begin_ns,
            place=(float(place[0]), float(place[1])),
        )


def _gap(
    fold: Fold, earlier: Stream, later: Stream, between: Sequence[Contribution]
) -> tuple[Pose, Covariance]:
    island = fold.islands[fold.home[earlier]]
    nodes = island.graph.streams[earlier][-1], island.graph.streams[later][0]
    return hypotheses.motion_beyond(island, *nodes, *_motion_over(between))


def _motion_over(submaps: Sequence[Contribution]) -> tuple[Pose, Covariance]:
    """Compose the motion of consecutive submaps: pose and covariance in the frame of the start."""
    pose, P = np.zeros(3), np.zeros((3, 3))
    for each in submaps:
        end, Q = each.local.end_pose, each.local.covariance[:3, :3]
        after = compose(pose, end)
        s, c = core.sin_and_cos(float(pose[2]))
        R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        F = np.eye(3)
        F[0, 2], F[1, 2] = pose[1] - after[1], after[0] - pose[0]
        P = dense.congruent(F, P) + dense.congruent(R, Q)
        pose = after
    return pose, P


def _chi2(gap: Pose, spread: Covariance) -> float:
    try:
        metric = information(spread, "a seam")
    except NotACovarianceError:
        return math.inf
    return dense.quadratic(metric, gap)


def _is_start(found: hypotheses.Hypothesis | m.Diagnosis) -> bool:
    """Whether a jump is an error of an initial pose: it has no time."""
    return found.cause == hypotheses.CARRIED_OFF and not found.at_ns


def _start_remedy(fold: Fold, found: hypotheses.Hypothesis) -> str:
    own = fold.main.graph.streams
    others = {each for each in fold.starts if each in own and each[0] != found.subject}
    if len(others) != 1:
        return START_REMEDY
    (other,) = others
    return START_REMEDY + OTHER_START.format(other=named(other).removesuffix(" (incarnation 1)"))


def _is_bent(jump: hypotheses.Hypothesis, shared: Sequence[m.Diagnosis]) -> bool:
    """Whether an apparent jump has less evidence than a shared error, as of a late clock."""
    if jump.cause != hypotheses.CARRIED_OFF:
        return False
    evidence = jump.evidence / jump.dof
    return any(each.robot == jump.subject and each.evidence > evidence for each in shared)


_REMEDIES: Mapping[str, str] = {
    hypotheses.MOVED: "remove the landmark, or give it another number from that time on",
    hypotheses.SHARED: "give each of the two landmarks a number of its own",
    hypotheses.CARRIED_OFF: REMEDY,
}


def _shared_errors(
    fold: Fold, biases: Sequence[marginals.BiasEstimate], scale: float
) -> Iterator[m.Diagnosis]:
    """Find errors that differ from the robot's configuration beyond doubt, by the larger of the
    stated standard deviation, times the root of a covariance scale above 1, and that from the
    scatter of the submaps (Student's t).
    """
    for found in biases:
        (robot, _), bias, value, stated = found
        error, sigma = _ERRORS.get(bias), stated * math.sqrt(max(scale, 1.0))
        if error is None or sigma == 0.0 or abs(value) <= max(error.least, SIGMAS * sigma):
            continue
        scatter = marginals.scatter_of(fold, found)
        sigma = max(sigma, scatter.sigma)
        if abs(value) > max(
            SIGMAS * sigma, _student(SCALE_SIGMAS, scatter.freedom) * scatter.sigma
        ):
            yield m.Diagnosis(
                cause=error.cause,
                robot=robot,
                value=(value,),
                sigma=(math.hypot(sigma, NONLINEAR * value),),
                evidence=(value / sigma) ** 2,
                remedy=error.remedy.format(value=value, factor=1.0 + value),
            )


def _student(sigmas: float, freedom: float) -> float:
    """Multiple of an estimated sigma as rare as of an exact one: t ≈ √(ν (exp(z²/ν) − 1)) (Wallace
    1959).
    """
    if freedom == math.inf:
        return sigmas
    freedom = max(freedom, 1.0)
    return math.sqrt(freedom * core.expm1(sigmas**2 / freedom))


def clock_remedy(late_s: float) -> str:
    """Describe the remedy for late stamps of detections."""
    return _CLOCK.format(value=late_s)


def _mirrored(fold: Fold, withdrawn: Mapping[str, Sequence[Contribution]]) -> Iterator[m.Diagnosis]:
    """Find robots whose submaps fit the others' landmarks only reflected; a saved map is no other.

    With the centred landmarks z of the map and w of a submap as complex numbers, the best rotation
    leaves Σ|z|² + Σ|w|² − 2 |Σ z conj(w)|, the best reflection the same with |Σ z w|.
    """
    graph, state = fold.main.graph, fold.main.state
    submaps = [each for each in fold.contributions if each.robot not in withdrawn]
    submaps += [each for chain in withdrawn.values() for each in chain]
    robots = sorted({each.robot for each in (*submaps, *fold.contributions)})
    number = {robot: k for k, robot in enumerate(robots)}
    of_robot = np.array([number[each.robot] for each in submaps])
    seen = np.zeros((len(robots), len(graph.fixed)), np.bool_)
    observers = [number[each.contribution.robot] for each in graph.submaps]
    seen[np.repeat(observers, np.diff(graph.landmark_start)), graph.landmark_nodes] = True
    seen[[number[robot] for robot in robots if robot.startswith(MAP)]] = False
    count = seen.sum(axis=0)

    of = np.repeat(np.arange(len(submaps)), [len(each.local.ids) for each in submaps])
    ids = np.concatenate([each.local.ids for each in submaps]).tolist()
    node = np.array([graph.landmarks.get(id_, -1) if id_ < UNNAMED else -1 for id_ in ids], int)
    is_shared = (node >= 0) & (count[node] > seen[of_robot[of], node])
    if not is_shared.any():
        return
    points = np.concatenate([each.local.landmarks for each in submaps])[is_shared]
    at, own = graph.offset[node[is_shared]], of[is_shared]
    shared = np.bincount(own, minlength=len(submaps))

    def sums(values: Values) -> Values:
        return np.bincount(own, values, len(submaps)).astype(np.float64)  # integers if empty

    x, y, u, v = (
        values - (sums(values) / np.maximum(shared, 1))[own]
        for values in (state[at], state[at + 1], points[:, 0], points[:, 1])
    )
    xu, yv, xv, yu = sums(x * u), sums(y * v), sums(x * v), sums(y * u)
    gain = 2.0 * (core.hypot(xu - yv, xv + yu) - core.hypot(xu + yv, yu - xv))
    is_judged = shared >= LEAST_SHARED
    judged, fit = (
        np.bincount(of_robot[which], minlength=len(robots))
        for which in (is_judged, is_judged & (gain > 0.0))
    )
    for k in np.flatnonzero((judged >= LEAST_MIRRORED) & (fit >= MIRRORED * judged)).tolist():
        chain = np.flatnonzero(is_judged & (of_robot == k)).tolist()
        chi2 = [
            gain[s] / median(submaps[s].factor.landmarks[is_shared[of == s]][:, [0, 2]].ravel())
            for s in chain
        ]
        yield m.Diagnosis(
            cause="mirrored",
            robot=robots[k],
            value=(-1.0,),
            sigma=(0.0,),
            evidence=math.fsum(chi2) / len(chain),
            remedy=MIRRORED_REMEDY,
        )


def _wrong_minimum(fold: Fold) -> Iterator[m.Diagnosis]:
    if fold.rival_m is not None:
        yield m.Diagnosis(
            cause="wrong_minimum",
            value=(fold.rival_m,),
            remedy="give the robots' initial poses, or measure more landmarks in common",
        )


def _noise(robot: str, value: float, log_sigma: float) -> m.Diagnosis:
    return m.Diagnosis(
        cause=NOISY if value > 1.0 else "noise_overestimated",
        robot=robot,
        value=(value,),
        sigma=(value * log_sigma,),
        evidence=(core.log(value) / log_sigma) ** 2,
        remedy=_remedy_of_scale(robot, value),
    )


def _remedy_of_scale(robot: str, value: float) -> str:
    if robot.startswith(MAP):
        if value < 1.0:
            return "leave out days that the saved map contains already: each counts once"
        return "the place has changed since the map was saved, or the map is of another place"
    data = "the columns (range and bearing, ids), units, clocks and robots' names of the data"
    if value >= MOST_SCALE:
        return f"noise is not stated that far off: check {data} (docs/faq.md)"
    remedy = (
        f"multiply the sigmas of sensor and odometry by {math.sqrt(value):.2g}, or with ground "
        "truth learn them by `teamslam calibrate`"
    )
    if value >= DOUBTFUL_SCALE:
        return f"check {data} first (docs/faq.md); if they are right, {remedy}"
    return remedy if value > 1.0 / DOUBTFUL_SCALE else f"{remedy}; check the units of the data, too"


def widening(found: Sequence[m.Diagnosis]) -> float:
    """Return the team's covariance scale where above 1 beyond doubt, else 1."""
    scales = (each.value[0] for each in found if each.cause == NOISY and not each.robot)
    return next(scales, 1.0)


def contradicts(found: m.Diagnosis) -> bool:
    """Whether measurements contradict each other by more than noise does: a wrong map."""
    is_data = found.cause == NOISY and not found.robot.startswith(MAP)
    return is_data and found.value[0] >= MOST_SCALE


_HELD: Mapping[m.MapPlace, str] = {
    "": "",
    "first": ", and the map has its first place",
    "second": ", and the map has its second place",
    "between": ", and the map has it between the two places",
}


def describe(found: m.Diagnosis) -> str:
    """Describe a cause, with figures and remedy."""
    return f"{_statement(found)}: {found.remedy}"


def _statement(found: m.Diagnosis) -> str:
    value, sigma = found.value, found.sigma or (0.0,) * len(found.value)
    when = f" at {moment(found.at_ns)}" if found.at_ns else ""
    match found.cause:
        case "landmark_moved":
            by = f"({value[0]:.2f}, {value[1]:.2f}) ± {max(sigma):.2f} m"
            return f"landmark {found.landmark} moved by {by}{when}{_HELD[found.map_has]}"
        case "identity_shared":
            return (
                f"two landmarks {math.hypot(*value):.1f} m apart have the number {found.landmark}"
            )
        case "carried_off":
            at = f" at ({found.place[0]:.1f}, {found.place[1]:.1f}) m" if found.place else ""
            text = f"{found.robot} was carried off or slipped{when}{at}"
            if not value:
                return f"{text}, to an unknown place; its later submaps are a map of their own"
            dx, dy, turn = value
            by = f"by ({dx:+.1f}, {dy:+.1f}) m and {math.degrees(turn):+.0f}°"
            if _is_start(found):
                return f"{found.robot}'s initial pose is wrong: the map puts the start off it {by}"
            return f"{text} {by}"
        case "mirrored":
            return f"{found.robot}'s bearings have the wrong sign"
        case "wrong_minimum":
            return f"another map, up to {value[0]:.1f} m away, fits about as well as this one"
        case "noise_underestimated" | "noise_overestimated":
            too, factor = ("small", value[0]) if value[0] > 1.0 else ("large", 1.0 / value[0])
            return (
                f"{found.robot or 'team'}: the submaps' covariances are too {too} by a factor of "
                f"{factor:.1f}, by the differences between submaps"
            )
        case _:
            return _describe_shared_error(found)


def _describe_shared_error(found: m.Diagnosis) -> str:
    error = next(each for each in _ERRORS.values() if each.cause == found.cause)
    (value,), (sigma,) = found.value, found.sigma
    words = error.positive if value > 0.0 else error.negative
    size = f"{abs(value):.3g} ± {sigma:.2g}{error.unit}"
    if found.cause == "odometry_scale":
        size = f"{100.0 * abs(value):.1f} ± {100.0 * sigma:.1f} %"
    return f"{found.robot}'s {error.subject} {size} {words}"


def to_object(found: m.Diagnosis) -> dict[str, object]:
    """Make the JSON object of a cause; `value`: a number, or [dx, dy]."""
    values: list[object] = []
    for numbers in (found.value, found.sigma):
        if found.cause == hypotheses.MOVED:
            values.append(list(numbers))
        elif found.cause in (hypotheses.SHARED, hypotheses.CARRIED_OFF) and numbers:
            values.append(math.hypot(*numbers[:2]))
        else:
            values.append(numbers[0] if numbers else None)
    is_of_landmark = found.landmark is not None
    subject = {"landmark": found.landmark} if is_of_landmark else {"robot": found.robot or None}
    more: dict[str, object] = {"at_s": found.at_ns * 1e-9} if found.at_ns else {}
    if found.cause == hypotheses.MOVED:
        more["map_has"] = found.map_has or None
        second = [a + d for a, d in zip(found.place, found.value, strict=False)]
        more["places"] = [list(found.place), second] if found.place else []
    elif found.place:
        more["place"] = list(found.place)
    if found.cause in (hypotheses.SHARED, hypotheses.CARRIED_OFF):
        more["displacement"] = list(found.value)
    return {
        "cause": found.cause,
        **subject,
        "value": values[0],
        "sigma": values[1],
        "evidence": found.evidence,
        "remedy": found.remedy,
        "text": describe(found),
        **more,
    }
