"""The configuration of a robot: its models, its estimator and its fusion rule.

The fields are SI; angles in radians unless the name says `_deg`. Noise of motion is a density, so
it does not depend on the rate of the odometry: a standard deviation per square root of a second, of
a metre driven and of a radian turned; the three add in variance.
"""

import math
from typing import TYPE_CHECKING, Annotated, Literal

import msgspec
from msgspec import Meta

from team.pairs import ESTIMATORS, RULES

Positive = Annotated[float, Meta(gt=0.0)]
NonNegative = Annotated[float, Meta(ge=0.0)]
Fraction = Annotated[float, Meta(ge=0.0, le=1.0)]
Share = Annotated[float, Meta(gt=0.0, le=1.0)]
Angle = Annotated[float, Meta(gt=0.0, le=math.pi)]
"""[rad]; more than half a turn is a number of degrees."""

UNNAMED = 2**31
"""Landmark numbers below this are identities, as of a barcode. From here on they are assigned by
data association: in a submap 2³¹ + a local index, in the team's map 2³¹ | a number of its first
member."""
Bias = Literal["bearing", "forward_scale", "range_offset", "range_scale"]
Exchange = Literal["continuous", "rendezvous"]
"""When robots send: each submap as it is closed, or all buffered ones at an encounter."""
if TYPE_CHECKING:
    Estimator = str
    FusionRule = str
else:  # the names of the tables: a row there is a value here
    Estimator = Literal[tuple(ESTIMATORS)]
    FusionRule = Literal[tuple(RULES)]


class MotionNoise(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Densities of one noise: variance = per_s² t + per_m² |distance| + per_rad² |turn|."""

    per_s: NonNegative = 0.0
    per_m: NonNegative = 0.0
    per_rad: NonNegative = 0.0


Alphas = tuple[NonNegative, NonNegative, NonNegative, NonNegative, NonNegative, NonNegative]


class MotionModel(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How a robot moves in one odometry interval, and how far the odometry may be wrong.

    kind: "turn-then-drive" (thesis, section 4.3.1) turns by yaw_rate·t, then drives forward·t;
    "velocity" (Ma & Ma eq. 1-4) drives the arc of constant (forward, yaw_rate);
    "differential-drive" (Downs eq. 2.3-2.4) drives that arc on two wheels wheel_base apart;
    "ackermann" drives it as a car, whose axles are wheel_base apart and whose base is the middle of
    the rear one: of a wheel's speed u and the steering angle s + steering_offset it makes forward =
    u/(1 - tan(s)·wheel_offset/wheel_base) and yaw_rate = forward·tan(s)/wheel_base, where the wheel
    whose speed is logged lies wheel_offset [m] left of the middle. Odometry that gives a motion on
    SE(2) instead is an arc with a part to the left, of any kind; a covariance that comes with it is
    taken times covariance_factor and replaces the noises below. forward [m], turn [rad], final_turn
    [rad] (a rotation after the motion) and lateral [m] are the independent noises. forward_scale
    and yaw_scale multiply the logged values first. alphas: Ma & Ma's α₁ … α₆, in addition: at speed
    v and yaw rate ω, forward has the variance (α₁v² + α₂ω²)·alpha_interval_s·t, turn that with α₃
    and α₄, final_turn that with α₅ and α₆: theirs for t = alpha_interval_s, and a density like all
    noise of motion. left_wheel, right_wheel [m/√m], in addition: the variance of a wheel's way is
    noise² |way|, and the two make one error of (forward, turn), correlated where the wheels differ.
    turn_drag [m]: a base whose outer wheel is no faster than the logged speed loses turn_drag·|yaw
    rate| of it in a turn, at most all. veer [rad/m]: rotation of the base on each metre driven.
    shares: forward and lateral [m/m] and heading [rad/m], in addition: errors that are a share of
    the way and stay so for shares_interval_s: the variance is (share·v)²·shares_interval_s·t.
    slow_scale: at low speed, where the logged speed is below slow_below [m/s], this scale replaces
    forward_scale. calibrated_speed: the logged speeds [m/s] from which forward_scale was learnt;
    where the robot is slower or faster the scale has an error of its own (the bias
    "forward_scale").
    """

    kind: Literal["turn-then-drive", "velocity", "differential-drive", "ackermann"] = "velocity"
    forward: MotionNoise = MotionNoise()
    turn: MotionNoise = MotionNoise()
    final_turn: MotionNoise = MotionNoise()
    lateral: MotionNoise = MotionNoise()
    forward_scale: Positive = 1.0
    yaw_scale: Positive = 1.0
    yaw_rate_limit: Positive | None = None
    turn_drag: NonNegative = 0.0
    veer: float = 0.0
    slow_below: NonNegative = 0.0
    slow_scale: Positive = 1.0
    calibrated_speed: tuple[NonNegative, NonNegative] | None = None
    alphas: Alphas | None = None
    alpha_interval_s: Positive = 1.0
    wheel_base: Positive | None = None
    left_wheel: NonNegative = 0.0
    right_wheel: NonNegative = 0.0
    wheel_offset: float = 0.0
    steering_offset: float = 0.0
    shares: tuple[NonNegative, NonNegative, NonNegative] | None = None
    shares_interval_s: Positive = 0.2
    covariance_factor: Positive = 1.0

    def __post_init__(self) -> None:
        speeds = self.calibrated_speed
        if speeds is not None and speeds[0] > speeds[1]:
            raise ValueError("calibrated_speed is [least, most]: the least comes first")
        on_wheels = self.kind == "differential-drive"
        if on_wheels and self.wheel_base is None:
            raise ValueError(
                "differential-drive needs wheel_base, the distance of its wheels in metres"
            )
        if self.kind == "ackermann" and self.wheel_base is None:
            raise ValueError("ackermann needs wheel_base, the distance of its axles in metres")
        if self.kind != "ackermann" and (self.wheel_offset or self.steering_offset):
            raise ValueError(f"wheel_offset and steering_offset are a car's, not of {self.kind}")
        if not on_wheels and (self.left_wheel or self.right_wheel):
            raise ValueError(
                f"left_wheel and right_wheel are noises of differential-drive, not of {self.kind}"
            )

    @property
    def is_exact(self) -> bool:
        """Whether it has no noise at all."""
        none = MotionNoise()
        return (
            self.forward == self.turn == self.final_turn == self.lateral == none
            and not any(self.alphas or ())
            and not any(self.shares or ())
            and not (self.left_wheel or self.right_wheel)
        )

    @property
    def slips(self) -> bool:
        """Whether it has noise beside the motion that odometry measures."""
        final = any((self.alphas or ())[4:]) or any((self.shares or ())[1:2])
        return final or self.final_turn != MotionNoise() or self.lateral != MotionNoise()


class Lens(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The error of a raw bearing b [rad]: linear·b + square·b² + cubic·b³ [rad]."""

    linear: float = 0.0
    square: float = 0.0
    cubic: float = 0.0

    @property
    def is_ideal(self) -> bool:
        """Whether raw bearings have no such error."""
        return self == Lens()


class Sensor(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A range-bearing sensor: true range = (measurement − range_offset)/range_scale.

    range_is_depth: the measured range is the distance along the optical axis, as of a camera that
    infers it from an object's height in the image: true range = (measured −
    range_offset)/(range_scale · cos β), where the raw bearing is optical_axis + β. Measurements
    with |β| above 80° are rejected. bearing_lens: error of bearings beside bearing_offset, as by a
    camera's lens. Range sigma at a predicted range r is hypot(range_sigma, range_sigma_per_m · r);
    the predicted range is used, not the measured one (else maps shrink: Peelle's puzzle).
    Measurements outside [min_range, max_range] or more than field_of_view/2 from the axis are
    rejected. range_white and bearing_white are the shares of the two variances that are independent
    from measurement to measurement; the rest is one error per landmark, constant within a window (a
    camera that mismeasures a marker does so again a moment later). In a simulated world the rest is
    a first-order Gauss-Markov process for each landmark (and each teammate), whose correlation
    falls to 1/e in range_correlation_s or bearing_correlation_s. mount: the sensor's pose (x [m], y
    [m], theta [rad]) on the robot's base; what it measures is relative to it. covariance_factor:
    factor on covariances that come with measurements. The range to a teammate's marker is
    marker_range_offset [m] too long after this calibration, and the marker lies marker_sigma [m]
    from the pose that its robot tracks.
    """

    range_sigma: Positive = 0.1
    range_sigma_per_m: NonNegative = 0.0
    bearing_sigma: Angle = 0.02
    min_range: NonNegative = 0.0
    max_range: Positive = 1e6
    field_of_view: Positive = 6.283185307179586
    range_offset: float = 0.0
    range_scale: Positive = 1.0
    range_is_depth: bool = False
    optical_axis: float = 0.0
    bearing_offset: float = 0.0
    bearing_lens: Lens = Lens()
    range_white: Share = 1.0
    bearing_white: Share = 1.0
    range_correlation_s: NonNegative = 10.0
    bearing_correlation_s: NonNegative = 10.0
    marker_range_offset: float = 0.0
    marker_sigma: NonNegative = 0.0
    mount: tuple[float, float, float] = (0.0, 0.0, 0.0)
    covariance_factor: Positive = 1.0

    @property
    def is_mounted(self) -> bool:
        """Whether the sensor has a pose of its own on the base."""
        return self.mount != (0.0, 0.0, 0.0)


GATE = 13.8
"""χ² of two degrees of freedom that one in a thousand correct pairs exceeds: −2 ln 10⁻³."""


class AssociationSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Data association of detections without identities inside a window."""

    gate: Positive = GATE
    """Largest squared Mahalanobis distance of a detection from its landmark: χ² of two degrees of
    freedom, exceeded by 1 in 1000 true ones."""
    variance_factor: Positive = 1.0
    """Factor on the detections' covariances. Below 1 where the noise for estimation includes
    systematic errors, which would merge neighbours."""
    least_seen: Annotated[int, Meta(ge=1, le=1000)] = 2
    """Fewest detections of a landmark of the submap."""
    slack_m: NonNegative = 0.03
    """Two landmarks that no scan has seen together are one if they are within the gate with this
    slack."""
    slip_m: NonNegative = 0.0
    """Largest jump of the odometry to search for; 0: none."""
    detection_probability: Annotated[float, Meta(gt=0.0, lt=1.0)] = 0.9
    """Probability of detecting a landmark in view; one seen too rarely for it is clutter."""
    certain: Fraction = 0.9
    """Least probability of an association; a less certain detection is not used."""


class FrontEnd(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The particle front end of one window and the rule that closes the window.

    window_s: a window closes with the first odometry interval that ends this long after its start.
    window_m: a window in which the odometry drove less than this stays open, up to standing_s:
    measurements from one place share one error, which is counted once for each window. keyframe_s:
    measurements within this time are reduced to one per landmark (median, moved with the odometry
    to the keyframe's end); 0 takes every observation message as a keyframe of its own. node_s: each
    submap carries the robot's poses at the multiples of this team time that lie in its window, so
    that inter-robot measurements are factors between poses; 0: there are none, and inter-robot
    measurements are not used. sighting_s: an inter-robot measurement is used if such a time is no
    farther from it than this. teammate_speed: how fast a teammate may move in between [m/s].
    outlier_share: the share of measurements that may have nothing to do with their landmark; above
    0 a window takes only measurements that others of it confirm
    (`team.estimation.hybrid_slam.consensus`). biases: the errors shared by all of the robot's
    windows that the centre estimates; each submap carries its derivative by each of them.
    """

    particles: Annotated[int, Meta(ge=4, le=100_000)] = 100
    proposal: Literal["fastslam2", "fastslam1"] = "fastslam2"
    resample_below: Fraction = 0.5
    window_s: Positive = 12.0
    window_m: NonNegative = 0.0
    standing_s: NonNegative = 60.0
    keyframe_s: NonNegative = 0.0
    node_s: NonNegative = 0.0
    sighting_s: NonNegative = 0.5
    teammate_speed: NonNegative = 0.2
    outlier_share: Annotated[float, Meta(ge=0.0, lt=1.0)] = 0.0
    biases: tuple[Bias, ...] = ()
    association: AssociationSettings = AssociationSettings()

    def __post_init__(self) -> None:
        if tuple(sorted(set(self.biases))) != self.biases:
            raise ValueError("biases are named once each, in alphabetical order")


class Bounds(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Bounds of what is physically sensible; values beyond them are refused with the reason.

    coordinate_m: of a pose or a landmark in the team's frame. extent_m: of what one submap holds,
    from its start, and of one range. speed_m_s, yaw_rate_rad_s, interval_s: of one odometry
    interval. jump_s: between two measurements of one stream; what jumps by more is refused until
    the next one confirms it. sigma_m, sigma_rad: least and largest standard deviation.
    independent: the least share of a variance that the numbers before it leave unexplained, 1 − R²:
    the conditioning of a covariance, whatever its units. sensitivity: of a submap's mean by a bias.
    submap_landmarks: of one submap; a window closes early once it has half as many.
    """

    coordinate_m: Positive = 1e7
    extent_m: Positive = 1e6
    speed_m_s: Positive = 300.0
    yaw_rate_rad_s: Positive = 100.0
    interval_s: Positive = 1e3
    jump_s: Positive = 1e6
    sigma_m: tuple[Positive, Positive] = (1e-8, 1e7)
    sigma_rad: tuple[Positive, Positive] = (1e-8, 100.0)
    independent: Share = 1e-13
    sensitivity: Positive = 1e9
    submap_landmarks: Annotated[int, Meta(ge=2, le=1000)] = 500


class RobotConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Everything that a robot's estimate depends on beside its measurements.

    exchange_s: under a rule with feedback, the least team time between two exchanges of maps (at
    window ends; for `hybrid-thesis` at keyframes). pose_s: the least team time between two running
    poses; a running map and particles go out for each window in which a multiple of it lies.
    clock_offset_s: odometry stamped t belongs to t + clock_offset_s of team time, the sensor's
    clock; the robot corrects the stamp before it uses it. bounds: measurements beyond them are
    rejected.
    """

    id: Annotated[str, Meta(pattern="^[a-z][a-z0-9_]{0,31}$")]
    motion: MotionModel = MotionModel()
    sensor: Sensor = Sensor()
    front_end: FrontEnd = FrontEnd()
    estimator: Estimator = "hybrid"
    fusion: FusionRule = "join"
    exchange_s: NonNegative = 0.0
    pose_s: NonNegative = 0.0
    clock_offset_s: Annotated[float, Meta(ge=-1e6, le=1e6)] = 0.0
    bounds: Bounds = Bounds()
    seed: Annotated[int, Meta(ge=0, le=2**63 - 1)] = 1
