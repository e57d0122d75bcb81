"""Contents of the team's map: submaps and initial poses."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from types import MappingProxyType
from typing import NamedTuple, TypeAlias

import numpy as np

from teamslam.team import core
from teamslam.team.config import GNSS, MAP, SURVEY, Bias
from teamslam.team.estimation import dense
from teamslam.team.estimation.gaussian import information
from teamslam.team.estimation.submap import NO_COLUMNS, LocalMap, Unnamed
from teamslam.team.shapes import Bool, Float, UInt32

Stream: TypeAlias = tuple[str, int]
"""(robot, incarnation): one unbroken life of a robot's sensor stream."""
Key: TypeAlias = tuple[int, str, int, int]
"""(end stamp, robot, incarnation, sequence): a submap's place in the canonical order."""
RANGE_POWER: Mapping[Bias, int] = MappingProxyType(
    {
        "bearing": 1,
        "clock_offset": 0,
        "forward_scale": -1,
        "range_offset": 0,
        "range_scale": 1,
    }
)
"""Power of a landmark's range with which each bias moves it; −1: it moves none."""
UNIX_S = 1e9  # team times from here on [s] are Unix times (2001)


def is_map(stream: Stream) -> bool:
    """Return whether a stream is the saved map of an earlier day."""
    return stream[0].startswith(MAP)


SURVEYED: Stream = (SURVEY, 0)
"""Stream of the surveyed landmarks, a saved map with a known start in an absolute frame."""


STATION: Stream = (GNSS, 0)
"""Stream of the station that measures fixes: an exact pose without landmarks."""


def is_absolute(stream: Stream) -> bool:
    """Return whether a stream has absolute positions."""
    return stream in (SURVEYED, STATION)


PART = 1 << 64  # step of the incarnation number from which a part of a cut stream is numbered


def part_of(stream: Stream, first: int) -> Stream:
    """Name the part of a stream from submap `first` on, after a cut (`continuity`).

    A fold treats it as an incarnation; sequence numbers stay.
    """
    return stream[0], stream[1] % PART + first * PART


def whole_of(stream: Stream) -> Stream:
    """Name the stream of a part."""
    return stream[0], stream[1] % PART


def first_of(stream: Stream) -> int:
    """Return the first sequence number of a stream or part."""
    return stream[1] // PART


def named(stream: Stream) -> str:
    """Name a stream: `r3 (incarnation 2)`, `…, from submap 12 on`, `the saved map site`."""
    if stream == STATION:
        return "the fixes"
    if is_absolute(stream):
        return "the surveyed landmarks"
    if is_map(stream):
        return f"the saved map {stream[0].removeprefix(MAP)}"
    first = first_of(stream)
    part = f", from submap {first} on" if first else ""
    return f"{stream[0]} (incarnation {whole_of(stream)[1]}{part})"


def moment(stamp_ns: int) -> str:
    """Format a team time: seconds, or time of day (UTC) if Unix time."""
    seconds = 1e-9 * stamp_ns
    if seconds < UNIX_S:
        return f"{seconds:,.1f} s"
    return f"{str(np.datetime64(int(seconds), 's')).replace('T', ' ')} UTC"


class Observation(NamedTuple):
    """The landmarks of a submap for data association; fields as in `LocalMap`."""

    stream: Stream
    sequence: int
    ids: UInt32[np.ndarray, " L"]
    unnamed: Unnamed
    spacings: Float[np.ndarray, "U U"]
    distinct: Bool[np.ndarray, "L L"]


class RobotBias(NamedTuple):
    """An error of one robot on the days of a saved map."""

    robot: str
    bias: Bias


@dataclass(frozen=True, eq=False)
class OwnBiases:
    """Errors o of single robots in a saved map: given the errors b that all robots share,

        o ~ N(mean + Gᵀ b, covariance),   cov(o, landmarks) = cross.

    errors: ascending. by_common: G, a row for each of the map's `biases`. likeliest, evidence: the
    likelihood N(likeliest, evidence⁻¹) of (b, o) without their priors.
    """

    errors: tuple[RobotBias, ...] = ()
    mean: Float[np.ndarray, " K"] = field(default_factory=lambda: np.empty(0))
    covariance: Float[np.ndarray, "K K"] = field(default_factory=lambda: np.empty((0, 0)))
    cross: Float[np.ndarray, "K n"] = field(default_factory=lambda: np.empty((0, 0)))
    by_common: Float[np.ndarray, "B K"] = field(default_factory=lambda: np.empty((0, 0)))
    likeliest: Float[np.ndarray, " E"] = field(default_factory=lambda: np.empty(0))
    evidence: Float[np.ndarray, "E E"] = field(default_factory=lambda: np.empty((0, 0)))

    @cached_property
    def information(self) -> Float[np.ndarray, "K K"]:
        """covariance⁻¹. Raises NotACovarianceError."""
        return information(self.covariance, "the robots' own errors in a saved map")

    def given(self, local: LocalMap) -> tuple[LocalMap, Float[np.ndarray, "K m"]]:
        """Condition the saved map's submap x on the errors: x | o, b ~ N(x̄ + Sᵀ o + …, P − crossᵀ
        S).

        Returns it at o = 0, and S = covariance⁻¹ cross over its mean.
        """
        poses = len(local.mean) - self.cross.shape[1]
        rows = np.hstack(
            [np.zeros((len(self.errors), poses)), dense.product(self.information, self.cross)]
        )
        covariance = local.covariance.copy()
        covariance[poses:, poses:] -= dense.product(self.cross.T, rows[:, poses:])
        sensitivity = local.sensitivity
        if len(local.biases):
            sensitivity = sensitivity - dense.product(self.by_common, rows)
        given = replace(
            local,
            mean=local.mean - dense.product(self.mean, rows),
            covariance=0.5 * (covariance + covariance.T),
            sensitivity=sensitivity,
        )
        return given, rows


NO_OWN = OwnBiases()


@dataclass(frozen=True, eq=False)
class Contribution:
    """One submap of the set: `sequence` counts those of (robot, incarnation) from 0.

    A saved map has landmarks only. own, by_own: its errors of single robots, and ∂mean/∂o of
    `local`, given at o = 0.
    """

    robot: str
    incarnation: int
    sequence: int
    end_ns: int
    local: LocalMap
    own: OwnBiases = NO_OWN
    by_own: Float[np.ndarray, "K m"] = field(default_factory=NO_COLUMNS.copy)

    @property
    def stream(self) -> Stream:
        """(robot, incarnation)."""
        return (self.robot, self.incarnation)

    @property
    def key(self) -> Key:
        """Place in the canonical order: (end stamp, robot, incarnation, sequence)."""
        return (self.end_ns, self.robot, self.incarnation, self.sequence)

    @cached_property
    def observation(self) -> Observation:
        """Landmarks for data association."""
        of = self.local
        return Observation(self.stream, self.sequence, of.ids, of.unnamed, of.spacings, of.distinct)

    @cached_property
    def information(self) -> Float[np.ndarray, "n n"]:
        """P⁻¹. Raises NotACovarianceError that names the submap."""
        return information(self.local.covariance, f"submap {self.sequence} of {named(self.stream)}")

    @cached_property
    def factor(self) -> core.SubmapFactor:
        """Submap as a factor. Raises NotACovarianceError that names it."""
        local = self.local
        first = len(local.mean) - 2 * len(local.ids)
        variances, covariances = (local.covariance.diagonal(k)[first:] for k in (0, 1))
        return core.SubmapFactor(
            local.mean,
            self.information,
            np.array([variances[::2], covariances[::2], variances[1::2]]).T.copy(),
            local.sensitivity,
            np.array([RANGE_POWER[each] for each in local.biases], np.int64),
            is_measured=not is_map(self.stream),
            curvature=local.curvature,
        )


@dataclass(frozen=True, eq=False)
class InitialPoseFactor:
    """A stream's initial pose in the common frame: N(pose, covariance), exact if None."""

    robot: str
    incarnation: int
    pose: Float[np.ndarray, "3"]
    covariance: Float[np.ndarray, "3 3"] | None = None

    @property
    def stream(self) -> Stream:
        """(robot, incarnation)."""
        return (self.robot, self.incarnation)

    @cached_property
    def information(self) -> Float[np.ndarray, "3 3"] | None:
        """P⁻¹; None for an exact pose."""
        if self.covariance is None:
            return None
        return information(self.covariance, f"the start of {named(self.stream)}")
