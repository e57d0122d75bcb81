"""One window of Hybrid-SLAM: particles that start at zero, and the Gaussian that they become.

FastSLAM runs in the frame of the window's start. Before moment matching makes a submap, each
landmark of each particle is solved again along its path: an EKF is linearised at the first,
noisiest measurement, a bias common to many submaps (Brooks and Bailey 2009, HybridSLAM).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import msgspec
import numpy as np

from teamslam.team import core
from teamslam.team.config import BIASES, Bias, FrontEnd, Sensor
from teamslam.team.estimation import dense
from teamslam.team.estimation.gaussian import FAULTS, CoreErrors, NotACovarianceError
from teamslam.team.estimation.hybrid_slam.fastslam import Particles
from teamslam.team.estimation.hybrid_slam.pose_grid import NodeSighting
from teamslam.team.estimation.models import UNSHIFTED, Increment, Own, noise_of
from teamslam.team.estimation.se2 import tangent
from teamslam.team.estimation.submap import Became, LocalMap, Slipped
from teamslam.team.shapes import Float, Int64, UInt32


class Innovation(NamedTuple):
    """Σ νᵀ S⁻¹ ν (NIS) of predicted measurements, χ² of `dof` degrees of freedom, two for each.

    A consistency check without ground truth (Bar-Shalom, Li and Kirubarajan 2001, section 5.4.2);
    both add up over keyframes, independent if the models are right.
    """

    squared: float
    dof: int

    def plus(self, other: "Innovation") -> "Innovation":
        """Add both terms."""
        return Innovation(self.squared + other.squared, self.dof + other.dof)

    @property
    def per_dof(self) -> float | None:
        """NIS per degree of freedom; about 1 if the models are right."""
        return self.squared / self.dof if self.dof else None


NOTHING = Innovation(0.0, 0)


class Window(msgspec.Struct, gc=False):
    """Particles since the window's start, and their paths, as copies of the core's state.

    K keyframes, M particles. Poses are the sensor's, in the frame of its start.
    """

    front_end: FrontEnd
    sensor: Sensor
    core: core.Window

    @property
    def innovation(self) -> Innovation:
        """NIS of all measurements predicted so far."""
        return Innovation(*self.core.innovated)

    @property
    def node_stamps(self) -> Int64[np.ndarray, " nodes"]:
        """Team time [ns] of the pose nodes."""
        return self.core.node_stamps()

    @property
    def biases(self) -> tuple[Bias, ...]:
        """Biases with derivatives; without `forward_scale` if all motion is calibrated."""
        biases = self.front_end.biases
        if "forward_scale" in biases and not self.core.has_shifts:
            return tuple(each for each in biases if each != "forward_scale")
        return biases

    @property
    def particles(self) -> Particles:
        """Particles after the last keyframe or motion."""
        return Particles(*self.core.particles())

    @property
    def paths(self) -> Float[np.ndarray, "K M 3"]:
        """Pose of each particle's line of descent at each keyframe."""
        return self.core.paths()


@dataclass(frozen=True, kw_only=True)
class ClosedWindow:
    """A submap with the names of its inputs, and the inter-robot measurements from its pose nodes.

    window, keyframes_ns: particles with their paths, and the keyframes' team times, if solved.
    gated: measurements that no others confirmed. late: rejected scans stamped after the window's
    end. became: outcomes of detections without identity. slips: motions that the odometry missed.
    unsolved: scans of a submap of motion alone.
    """

    sequence: int
    first_measurement: int
    last_measurement: int
    start_ns: int
    end_ns: int
    local: LocalMap
    sightings: tuple[NodeSighting, ...] = ()
    window: Window | None = None
    keyframes_ns: tuple[int, ...] = ()
    innovation: Innovation = NOTHING
    gated: int = 0
    late: int = 0
    unsolved: int = 0
    became: Became | None = None
    slips: tuple[Slipped, ...] = ()


def random_numbers(seed: int, robot: str, incarnation: int, sequence: int) -> core.Random:
    """Make the counter-based random numbers (Philox 4x64) of one window.

    The key is the BLAKE2b digest of (seed, robot, incarnation, sequence).
    """
    return core.Random(_key(seed, robot, incarnation, sequence))


def generator(seed: int, robot: str, incarnation: int, sequence: int) -> "np.random.Generator":
    """Make NumPy's generator of the key of `random_numbers`."""
    key = int.from_bytes(_key(seed, robot, incarnation, sequence), "little")
    return np.random.Generator(np.random.Philox(key=key))


def _key(seed: int, robot: str, incarnation: int, sequence: int) -> bytes:
    named = f"{seed}/{robot}/{incarnation}/{sequence}".encode()
    return core.blake2b(named, 16, b"teamslam window")


def open_window(front_end: FrontEnd, sensor: Sensor) -> Window:
    """Open a window: every particle exactly at zero, without landmarks or measurements."""
    improved = front_end.proposal == "fastslam2"
    return Window(
        front_end,
        sensor,
        core.Window(
            front_end.particles, noise_of(sensor), improved, sensor.mount, front_end.resample_below
        ),
    )


def advance(
    window: Window,
    increment: Increment,
    ids: UInt32[np.ndarray, " n"],
    ranges: Float[np.ndarray, " n"],
    bearings: Float[np.ndarray, " n"],
    random: core.Random,
    forward: Sequence[float] = UNSHIFTED,
    *,
    own: Own | None = None,
) -> None:
    """Process a keyframe: the motion since the last one, then its measurements.

    The measurements are accepted and corrected (`models.scanned`). The innovation omits those of
    singular predictive covariance. forward: the motion's shift by an error of the scale of speed,
    and its duration [s] (`core.Keyframe`). own: claimed noises (`teamslam.team.estimation.models`).
    Raises NotACovarianceError, and leaves the window unchanged.
    """
    with CoreErrors():
        window.core.advance(
            increment.keyframe(core.Scan(ids, ranges, bearings, own), forward), random
        )


def gaussian(window: Window) -> LocalMap:
    """Make one Gaussian of the window so far: (end pose, pose nodes, landmarks by ascending id).

    With w and (poses, landmarks) of each particle, the latter solved again given the path, μ = Σ wᵢ
    μᵢ and P = Σ wᵢ (Pᵢ + dᵢ dᵢᵀ), where Pᵢ = blkdiag(0, Σ₁, …, Σ_L), dᵢ = μᵢ − μ (Xu, eq. 4.5-4.6),
    the means and deviations of poses on SE(2), plus POSE_JITTER. Poses and landmarks are the
    base's, in the frame of its start. The window's smoother gives derivatives by the biases, with
    the precision of a message. Raises NotACovarianceError.
    """
    ids, mean, covariance, fault = window.core.close()
    _raise_fault(fault, "the submap of a window")
    biases = window.biases
    if not biases:
        return LocalMap(ids, mean, covariance, window.node_stamps)
    rows, curvature, fault = window.core.sensitivity(mean, True)
    _raise_fault(fault, "the smoother of a window")
    if len(biases) < len(BIASES):
        chosen = [BIASES.index(each) for each in biases]
        rows, curvature = rows[chosen], curvature[chosen]
    return LocalMap(ids, mean, covariance, window.node_stamps, biases, rows, curvature=curvature)


def _raise_fault(fault: int, what: str) -> None:
    if fault:
        raise NotACovarianceError(what, FAULTS[fault])


class RunningWindow(NamedTuple):
    """The Gaussian (end pose, landmarks) of an open window, which is not fused.

    As `gaussian` without pose nodes and, if all errors are white, with the particles' own
    landmarks. window: None for the odometry's motion alone.
    """

    map: core.WholeMap
    window: Window | None = None

    @property
    def motion(self) -> core.WholeMap:
        """Marginal over the end pose."""
        return core.WholeMap(self.map.ids[:0], *self.map.pose())

    def corrected(
        self, covariance_factor: float, biases: Sequence[tuple[Bias, float, float]]
    ) -> core.WholeMap:
        """Correct the map as `SubmapCorrection` does a submap. Raises NotACovarianceError."""
        known: tuple[Bias, ...] = () if self.window is None else self.window.biases
        errors = [(b, sigma, BIASES.index(name)) for name, b, sigma in biases if name in known]
        if covariance_factor == 1.0 and not errors:
            return self.map
        if self.window is None:
            mean, covariance = self.map.mean, covariance_factor * self.map.covariance
            return core.WholeMap(self.map.ids, mean, covariance)
        corrected, fault = self.window.core.corrected(self.map, covariance_factor, errors)
        _raise_fault(fault, "the smoother of a window")
        return corrected


def running(window: Window) -> RunningWindow:
    """Make the Gaussian of the window so far, for a pose within it. Raises NotACovarianceError."""
    found, fault = window.core.run()
    _raise_fault(fault, "the submap of a window")
    return RunningWindow(found, window)


def of_base(window: Window) -> Window:
    """Convert particles and paths to the base, in the frame of its start pose.

    Returns the window itself if the sensor is at the base's origin.
    """
    if not window.sensor.is_mounted:
        return window
    return msgspec.structs.replace(window, core=window.core.of_base())


def motion_alone(motion: Increment) -> LocalMap:
    """Make the Gaussian of a window's odometry alone."""
    G = tangent(motion.mean[2])
    covariance = dense.congruent(G, motion.covariance) + np.diag(core.POSE_JITTER)
    return LocalMap(np.empty(0, np.uint32), motion.mean, 0.5 * (covariance + covariance.T))
