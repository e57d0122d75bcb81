"""One window of Hybrid-SLAM: particles that start at zero, and the one Gaussian they become.

The front end runs FastSLAM in the frame of the window's start. Its particles at any time are one
submap by moment matching, after each landmark of each particle is solved again over the window's
measurements along that particle's path: an EKF is linearised at the first, noisiest measurement,
and that bias is common to many submaps. Brooks and Bailey 2009, HybridSLAM.
"""

import math
from typing import NamedTuple

import msgspec
import numpy as np

from teamslam.team import core
from teamslam.team.config import BIASES, Bias, FrontEnd, Sensor
from teamslam.team.estimation import dense
from teamslam.team.estimation.gaussian import FAULTS, CoreErrors, NotACovarianceError
from teamslam.team.estimation.hybrid_slam.fastslam import Particles
from teamslam.team.estimation.models import Increment, noise_of
from teamslam.team.estimation.scans import Own, unclaimed
from teamslam.team.estimation.se2 import tangent
from teamslam.team.estimation.submap import NO_NODES, LocalMap
from teamslam.team.shapes import Float, Int64, UInt32

STILL = np.zeros(4)


class Innovation(NamedTuple):
    """The innovations of measurements: Σ νᵀ S⁻¹ ν (NIS), χ² of `dof` degrees of freedom, two for
    each measurement that was predicted.

    Predictions are compared with later measurements, so this consistency check needs no ground
    truth (Bar-Shalom, Li and Kirubarajan 2001, section 5.4.2).
    Innovations of different keyframes are independent where the models are right, so both add up.
    """

    squared: float
    dof: int

    def plus(self, other: "Innovation") -> "Innovation":
        """The sum of both."""
        return Innovation(self.squared + other.squared, self.dof + other.dof)

    @property
    def per_dof(self) -> float | None:
        """About 1 where the models are right, larger where the noise is larger; None without
        measurements.
        """
        return self.squared / self.dof if self.dof else None


NOTHING = Innovation(0.0, 0)


class Window(msgspec.Struct, gc=False):
    """Particles since the window's start, their paths, and the measurements that they have used.

    `advance`, `move` and `mark_node` change it.

    The core holds them; the properties are copies, K keyframes, N measurements and M particles.
    Poses are the sensor's, in the frame of the window's start of the sensor.
    node_stamps: team time [ns] of the pose nodes.
    innovation: of all measurements so far that were predicted.
    """

    front_end: FrontEnd
    sensor: Sensor
    core: core.Window
    node_stamps: Int64[np.ndarray, " nodes"] = NO_NODES
    innovation: Innovation = NOTHING

    @property
    def particles(self) -> Particles:
        """The particles after the last keyframe or motion."""
        return Particles(*self.core.particles())

    @property
    def paths(self) -> Float[np.ndarray, "K M 3"]:
        """The pose of each particle's line of descent at each of the keyframes."""
        return self.core.paths()

    @property
    def keyframes(self) -> Int64[np.ndarray, " N"]:
        """The keyframe of each measurement, in [0, K)."""
        return self.core.measurements()[0]

    @property
    def ids(self) -> UInt32[np.ndarray, " N"]:
        """The landmark of each measurement."""
        return self.core.measurements()[1]

    @property
    def measurements(self) -> Float[np.ndarray, "N 2"]:
        """(range [m], bearing [rad]) with the sensor's calibration applied."""
        return self.core.measurements()[2]

    @property
    def own(self) -> Own:
        """The noises that the measurements claim (`teamslam.team.estimation.scans`)."""
        return self.core.measurements()[3]

    @property
    def node_keyframes(self) -> Int64[np.ndarray, " nodes"]:
        """The keyframe that each pose node is."""
        return self.core.nodes()

    @property
    def landmarks(self) -> UInt32[np.ndarray, " L"]:
        """The landmarks in order of first sight."""
        return self.core.ids()

    @property
    def effective(self) -> float:
        """Number of effective particles after the last keyframe."""
        return self.core.effective


def open_window(front_end: FrontEnd, sensor: Sensor) -> Window:
    """Open a window: every particle exactly at zero, without landmarks or measurements."""
    improved = front_end.proposal == "fastslam2"
    particles = core.Window(front_end.particles, noise_of(sensor), improved, sensor.mount)
    return Window(front_end, sensor, particles)


def advance(
    window: Window,
    increment: Increment,
    ids: UInt32[np.ndarray, " n"],
    ranges: Float[np.ndarray, " n"],
    bearings: Float[np.ndarray, " n"],
    random: core.Random,
    forward: Float[np.ndarray, "4"] = STILL,
    *,
    own: Own | None = None,
) -> None:
    """Take a keyframe: the motion since the last one, then its measurements (there may be none).

    The measurements are accepted and corrected already (`models.scanned`). The innovation does not
    count them where their predictive covariance is singular.
    forward: the motion's shift by an error of the scale of speed, and its duration
    (`core.Odometry`).
    own: the noises that the measurements claim (`teamslam.team.estimation.scans`).
    Raises NotACovarianceError, and leaves the window as it was.
    """
    noises = unclaimed(len(ids)) if own is None else own
    seen, count = (ids, ranges, bearings, noises), window.front_end.particles
    is_thin = window.effective < window.front_end.resample_below * count
    uniform = random.uniform() if is_thin else None
    normals = random.normals(count, 3)
    with CoreErrors():
        step = window.core.advance(
            increment.mean, increment.covariance, *seen, uniform, normals, forward
        )
    if math.isfinite(step.squared):
        window.innovation = window.innovation.plus(Innovation(step.squared, step.dof))


def mark_node(window: Window, stamp_ns: int) -> None:
    """Make the particles' poses at the last keyframe a pose node at this team time."""
    window.core.mark()
    window.node_stamps = np.append(window.node_stamps, stamp_ns)


def move(
    window: Window,
    increment: Increment,
    random: core.Random,
    forward: Float[np.ndarray, "4"] = STILL,
) -> None:
    """Move the particles without a keyframe, as from the last one to the window's end.

    It never resamples: the weights of the last measurements stay as they are.
    """
    normals = random.normals(window.front_end.particles, 3)
    with CoreErrors():
        window.core.move(increment.mean, increment.covariance, normals, forward)


def gaussian(window: Window, *, running: bool = False) -> LocalMap:
    """Make one Gaussian of the window so far: (end pose, pose nodes, landmarks by ascending id).

    Each landmark of each particle is solved again over the window's measurements, given the path.
    With w and (poses, landmarks) of each particle, μ = Σ wᵢ μᵢ and P = Σ wᵢ (Pᵢ + dᵢ dᵢᵀ), where
    Pᵢ = blkdiag(0, Σ₁, …, Σ_L), dᵢ = μᵢ − μ (Xu, eq. 4.5-4.6), the means and deviations of poses on
    SE(2), plus POSE_JITTER. Poses and landmarks are those of the base, in the frame of its start.
    Its derivatives by the biases are those of the window's smoother.
    running: for a pose within the window, which is not fused: without pose nodes, and, where all of
    the sensor's errors are white, with the landmarks that the particles hold.
    Raises NotACovarianceError if P is not finite or not positive definite.
    """
    ids, mean, covariance, fault = window.core.run() if running else window.core.close()
    if fault:
        raise NotACovarianceError("the submap of a window", FAULTS[fault])
    nodes = NO_NODES if running else window.node_keyframes
    stamps = window.node_stamps[: len(nodes)]
    if not window.front_end.biases:
        return LocalMap(ids, mean, covariance, stamps)
    biases, sensitivity, curvature = _sensitivity(window, mean, running)
    return LocalMap(ids, mean, covariance, stamps, biases, sensitivity, curvature=curvature)


def of_base(window: Window) -> Window:
    """The window's particles and paths as those of the base, in the frame of the base's start
    pose.
    """
    return msgspec.structs.replace(window, core=window.core.of_base())


def motion_alone(motion: Increment) -> LocalMap:
    """The Gaussian of a window's odometry alone, in the window's frame."""
    G = tangent(motion.mean[2])
    covariance = dense.product(dense.product(G, motion.covariance), G.T) + np.diag(core.POSE_JITTER)
    return LocalMap(np.empty(0, np.uint32), motion.mean, 0.5 * (covariance + covariance.T))


def _sensitivity(
    window: Window, mean: Float[np.ndarray, " n"], running: bool
) -> tuple[tuple[Bias, ...], Float[np.ndarray, "b n"], Float[np.ndarray, "b n"]]:
    """The biases, and the first and second derivatives of the window's mean by them, as precise as
    in a message.

    That by `forward_scale` is left out where all of the window's motion is calibrated.
    """
    biases = window.front_end.biases
    if "forward_scale" in biases and not window.core.has_shifts:
        biases = tuple(each for each in biases if each != "forward_scale")
    rows, curvature, fault = window.core.sensitivity(mean, not running)
    if fault:
        raise NotACovarianceError("the smoother of a window", FAULTS[fault])
    if len(biases) < len(BIASES):
        chosen = [BIASES.index(each) for each in biases]
        rows, curvature = rows[chosen], curvature[chosen]
    return biases, rows, curvature
