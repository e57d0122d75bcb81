"""What the team's map is made of: submaps with their place in the set, and known starts."""

from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

import numpy as np
from jaxtyping import Float

from team.estimation.gaussian import information
from team.estimation.submap import LocalMap

Stream: TypeAlias = tuple[str, int]
"""(robot, epoch): one unbroken life of a robot's sensor stream."""
Key: TypeAlias = tuple[int, str, int, int]
"""(end stamp, robot, epoch, sequence): a submap's place in the canonical order."""


def named(stream: Stream) -> str:
    """`r3 (epoch 2)`."""
    return f"{stream[0]} (epoch {stream[1]})"


@dataclass(frozen=True, eq=False)
class Contribution:
    """One submap of the set: `sequence` counts the submaps of (robot, epoch) from 0."""

    robot: str
    epoch: int
    sequence: int
    end_ns: int
    local: LocalMap

    @property
    def stream(self) -> Stream:
        """(robot, epoch)."""
        return (self.robot, self.epoch)

    @property
    def key(self) -> Key:
        """Place in the canonical order: (end stamp, robot, epoch, sequence)."""
        return (self.end_ns, self.robot, self.epoch, self.sequence)

    @cached_property
    def information(self) -> Float[np.ndarray, "n n"]:
        """P⁻¹ of the submap. Raises NotACovarianceError that names the submap."""
        return information(self.local.covariance, f"submap {self.sequence} of {named(self.stream)}")


@dataclass(frozen=True, eq=False)
class Start:
    """Where a stream starts in the common frame: exactly (covariance None) or N(pose, covariance).

    The covariance is of (x [m], y [m], theta [rad]) in the common frame.
    """

    robot: str
    epoch: int
    pose: Float[np.ndarray, "3"]
    covariance: Float[np.ndarray, "3 3"] | None = None

    @property
    def stream(self) -> Stream:
        """(robot, epoch)."""
        return (self.robot, self.epoch)

    @cached_property
    def information(self) -> Float[np.ndarray, "3 3"] | None:
        """P⁻¹, None for an exact start."""
        if self.covariance is None:
            return None
        return information(self.covariance, f"the start of {named(self.stream)}")
