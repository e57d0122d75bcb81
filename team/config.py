"""Configuration of a robot: motion model, sensor, front end, bounds.

SI units; angles in radians unless the name ends in `_deg`. Motion noise is a density, added in
variance: a standard deviation per square root of a second, of a metre driven and of a radian
turned.
"""

import math
from typing import TYPE_CHECKING, Annotated, Literal, get_args

import msgspec
from msgspec import Meta

from teamslam.team.pairs import ESTIMATORS, RULES

Positive = Annotated[float, Meta(gt=0.0)]
NonNegative = Annotated[float, Meta(ge=0.0)]
Fraction = Annotated[float, Meta(ge=0.0, le=1.0)]
Share = Annotated[float, Meta(gt=0.0, le=1.0)]
Angle = Annotated[float, Meta(gt=0.0, le=math.pi)]
"""[rad]; more than half a turn is a number of degrees."""

UNNAMED = 2**31
"""Landmark ids below this are identities. Those from here on come from data association: 2³¹ + a
local index in a submap, 2³¹ | a number of the first member in the team's map."""
Bias = Literal["bearing", "clock_offset", "forward_scale", "range_offset", "range_scale"]
MAP = "map-"
"""Before the name of a saved map, where members of the set have that of a robot."""
SURVEY = MAP + "survey"
"""The member of the set that has the surveyed landmarks."""
SURVEY_FRAME = SURVEY + "/0"
"""The frame that its start fixes."""
GNSS = MAP + "gnss"
"""The member of the set that is the station of the fixes."""
BIASES: tuple[Bias, ...] = get_args(Bias)
CALIBRATED: tuple[Bias, ...] = ("bearing", "clock_offset", "forward_scale", "range_offset")
"""The biases of a team whose ranges are its measure of length: with `range_scale` as well, odometry
and ranges could shrink together, and with them every residual."""
Exchange = Literal["continuous", "rendezvous"]
"""A robot sends each submap when it is closed, or all buffered submaps at an encounter."""
if TYPE_CHECKING:
    Estimator = str
    FusionRule = str
else:  # the names of the tables: a row there is a value here
    Estimator = Literal[tuple(ESTIMATORS)]
    FusionRule = Literal[tuple(RULES)]


class MotionNoise(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Noise densities: variance = per_s² t + per_m² |distance| + per_rad² |turn|."""

    per_s: NonNegative = 0.0
    per_m: NonNegative = 0.0
    per_rad: NonNegative = 0.0


Alphas = tuple[NonNegative, NonNegative, NonNegative, NonNegative, NonNegative, NonNegative]


class MotionModel(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Motion in one odometry interval, and its noise.

    A motion on SE(2) reported by odometry is an arc with a lateral part, for every kind; its
    covariance replaces the noise below.
    """

    kind: Literal["turn-then-drive", "velocity", "differential-drive", "ackermann"] = "velocity"
    """turn-then-drive: turn by yaw_rate·t, then drive forward·t (thesis, section 4.3.1).
    velocity: arc of constant (forward, yaw_rate) (Ma & Ma, eq. 1-4). differential-drive: that arc
    on two wheels, wheel_base apart (Downs, eq. 2.3-2.4). ackermann: that arc of a car's rear axle;
    from wheel speed u and steering angle s' = s + steering_offset follow
    forward = u/(1 − tan(s')·wheel_offset/wheel_base), yaw_rate = forward·tan(s')/wheel_base."""
    forward: MotionNoise = MotionNoise()
    """Noise of the distance driven [m]."""
    turn: MotionNoise = MotionNoise()
    """Noise of the heading change [rad]."""
    final_turn: MotionNoise = MotionNoise()
    """Noise of a rotation after the motion [rad]."""
    lateral: MotionNoise = MotionNoise()
    """Noise of the lateral motion [m]."""
    forward_scale: Positive = 1.0
    """Factor on logged speeds, applied first."""
    yaw_scale: Positive = 1.0
    """Factor on logged yaw rates, applied first."""
    yaw_rate_limit: Positive | None = None
    turn_drag: NonNegative = 0.0
    """Speed lost in a turn per yaw rate [m], for a base whose outer wheel is no faster than the
    logged speed."""
    veer: float = 0.0
    """Rotation of the base per metre driven [rad/m]."""
    slow_below: NonNegative = 0.0
    """Below this logged speed [m/s], slow_scale replaces forward_scale."""
    slow_scale: Positive = 1.0
    calibrated_speed: tuple[NonNegative, NonNegative] | None = None
    """Range of logged speeds [m/s] from which forward_scale was learnt. Outside, or everywhere
    without it, the scale has an error of its own (the bias "forward_scale")."""
    alphas: Alphas | None = None
    """Ma & Ma's α₁ … α₆, in addition: at speed v and yaw rate ω the variance of forward is
    (α₁v² + α₂ω²)·alpha_interval_s·t; of turn with α₃, α₄; of final_turn with α₅, α₆."""
    alpha_interval_s: Positive = 1.0
    wheel_base: Positive | None = None
    """Distance of the two wheels, or of a car's axles [m]."""
    left_wheel: NonNegative = 0.0
    """Noise of the left wheel's way, in addition [m/√m]: variance noise² |way|; correlates forward
    and turn where the wheels differ."""
    right_wheel: NonNegative = 0.0
    """Noise of the right wheel's way, in addition [m/√m]."""
    wheel_offset: float = 0.0
    """Position of the wheel whose speed is logged, left of the car's middle [m]."""
    steering_offset: float = 0.0
    shares: tuple[NonNegative, NonNegative, NonNegative] | None = None
    """Errors of forward [m/m], lateral [m/m] and heading [rad/m], in addition, that are a constant
    share of the way for shares_interval_s: variance (share·v)²·shares_interval_s·t."""
    shares_interval_s: Positive = 0.2
    covariance_factor: Positive = 1.0
    """Factor on covariances that come with odometry."""

    def __post_init__(self) -> None:
        speeds = self.calibrated_speed
        if speeds is not None and speeds[0] > speeds[1]:
            raise ValueError("calibrated_speed is [least, most]: the least comes first")
        distances = {"differential-drive": "wheels", "ackermann": "axles"}
        if self.kind in distances and self.wheel_base is None:
            of = distances[self.kind]
            raise ValueError(f"{self.kind} needs wheel_base, the distance of its {of} in metres")
        if self.kind != "ackermann" and (self.wheel_offset or self.steering_offset):
            raise ValueError(f"wheel_offset and steering_offset are a car's, not of {self.kind}")
        if self.kind != "differential-drive" and (self.left_wheel or self.right_wheel):
            raise ValueError(
                f"left_wheel and right_wheel are noises of differential-drive, not of {self.kind}"
            )

    @property
    def is_exact(self) -> bool:
        """Whether the motion has no noise."""
        none = MotionNoise()
        return (
            self.forward == self.turn == self.final_turn == self.lateral == none
            and not any(self.alphas or ())
            and not any(self.shares or ())
            and not (self.left_wheel or self.right_wheel)
        )

    @property
    def slips(self) -> bool:
        """Whether there is noise beside forward and turn, which odometry measures."""
        final = any((self.alphas or ())[4:]) or any((self.shares or ())[1:2])
        return final or self.final_turn != MotionNoise() or self.lateral != MotionNoise()


class Lens(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The error of a raw bearing b [rad]: linear·b + square·b² + cubic·b³ [rad]."""

    linear: float = 0.0
    square: float = 0.0
    cubic: float = 0.0

    @property
    def is_ideal(self) -> bool:
        """Whether there is no such error."""
        return self == Lens()


class Sensor(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A range-bearing sensor: true range = (measurement − range_offset)/range_scale."""

    range_sigma: Positive = 0.1
    range_sigma_per_m: NonNegative = 0.0
    """Range sigma at the predicted range r is hypot(range_sigma, range_sigma_per_m·r). The measured
    range would shrink maps (Peelle's puzzle)."""
    bearing_sigma: Angle = 0.02
    min_range: NonNegative = 0.0
    """Measurements outside [min_range, max_range] are rejected."""
    max_range: Positive = 1e6
    field_of_view: Positive = 6.283185307179586
    """Measurements more than half of this from the axis are rejected."""
    range_offset: float = 0.0
    range_scale: Positive = 1.0
    range_is_depth: bool = False
    """The measured range is the distance along the optical axis, as for a camera that infers it
    from an object's height: true range = (measured − range_offset)/(range_scale·cos β), with raw
    bearing optical_axis + β; |β| above 80° is rejected."""
    optical_axis: float = 0.0
    bearing_offset: float = 0.0
    bearing_lens: Lens = Lens()
    """Error of bearings beside bearing_offset, as by a camera's lens."""
    range_white: Share = 1.0
    """Share of the range variance that is independent between measurements. The rest is one error
    per landmark, constant within a window: a camera that misjudges a marker does so again a moment
    later. In a simulated world the rest is a first-order Gauss-Markov process per landmark and
    teammate."""
    bearing_white: Share = 1.0
    """The same for bearings."""
    range_correlation_s: NonNegative = 10.0
    """Simulated worlds: time in which the process's correlation falls to 1/e."""
    bearing_correlation_s: NonNegative = 10.0
    marker_range_offset: float = 0.0
    """Error of the range to a teammate's marker after this calibration [m]."""
    marker_sigma: NonNegative = 0.0
    """Distance of a robot's marker from the pose that the robot tracks [m]."""
    mount: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """The sensor's pose (x [m], y [m], theta [rad]) on the robot's base."""
    covariance_factor: Positive = 1.0
    """Factor on covariances that come with measurements."""

    @property
    def is_mounted(self) -> bool:
        """Whether the sensor is not at the base's origin."""
        return self.mount != (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if self.max_range <= self.min_range:
            raise ValueError(
                f"max_range = {self.max_range:g} is not above min_range = {self.min_range:g}: each "
                "measurement would be rejected"
            )


RESET_M, RESET_TIMES, USUAL_M_S, LEAST_STEPS = 0.5, 20.0, 0.25, 10
"""A reset of odometry poses: least length [m], speed beside the usual one, which is taken to be as
large at least [m/s], and the least number of steps of which the usual one is known."""
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
    """The particle front end of one window, and the rule that closes the window."""

    particles: Annotated[int, Meta(ge=4, le=100_000)] = 100
    proposal: Literal["fastslam2", "fastslam1"] = "fastslam2"
    resample_below: Fraction = 0.5
    """Share of the particles; below this effective number they are resampled."""
    window_s: Positive = 12.0
    """A window closes with the first odometry interval that ends this long after its start."""
    window_m: NonNegative = 0.0
    """A window with less motion stays open, up to standing_s: measurements from one place share one
    error, which is counted once per window."""
    standing_s: NonNegative = 60.0
    keyframe_s: NonNegative = 0.0
    """Measurements within this time are reduced to one per landmark (median, moved with the
    odometry to the keyframe's end). 0: each observation message is a keyframe."""
    node_s: NonNegative = 0.0
    """A submap carries the robot's poses at the multiples of this team time in its window, and
    inter-robot measurements are factors between such poses. 0: no nodes; inter-robot measurements
    are not used."""
    sighting_s: NonNegative = 0.5
    """Largest distance in time of an inter-robot measurement from its node."""
    teammate_speed: NonNegative = 0.2
    """Speed of a teammate in between [m/s]."""
    biases: tuple[Bias, ...] = CALIBRATED
    """Errors shared by all of the robot's windows, estimated by the centre; each submap carries its
    derivative by each of them. clock_offset: by so much the detections are stamped late against the
    odometry."""
    association: AssociationSettings = AssociationSettings()

    def __post_init__(self) -> None:
        if tuple(sorted(set(self.biases))) != self.biases:
            raise ValueError("biases are named once each, in alphabetical order")


class BiasSigmas(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Prior scales of the errors shared by all submaps of a robot: Student's t of one degree of
    freedom.

    bearing [rad]; clock_offset [s]; range_offset [m]; range_scale, forward_scale: shares of the
    range and of the distance driven.
    """

    bearing: Positive = 0.002
    clock_offset: Positive = 0.005
    range_offset: Positive = 0.005
    range_scale: Positive = 0.005
    forward_scale: Positive = 0.0015


class Bounds(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Physical bounds; values beyond them are refused with the reason."""

    coordinate_m: Positive = 1e7
    """Largest coordinate of a pose or a landmark in the team's frame."""
    extent_m: Positive = 1e6
    """Largest extent of one submap from its start, and largest range."""
    speed_m_s: Positive = 300.0
    yaw_rate_rad_s: Positive = 100.0
    interval_s: Positive = 1e3
    """Longest odometry interval."""
    jump_s: Positive = 1e6
    """Largest jump between two measurements of a stream, unless the next one confirms it."""
    sigma_m: tuple[Positive, Positive] = (1e-8, 1e7)
    """Least and largest standard deviation."""
    sigma_rad: tuple[Positive, Positive] = (1e-8, 100.0)
    independent: Share = 1e-13
    """Least share 1 − R² of a variance that the numbers before it leave unexplained: the
    conditioning of a covariance, whatever its units."""
    sensitivity: Positive = 1e9
    """Largest derivative of a submap's mean by a bias."""
    submap_landmarks: Annotated[int, Meta(ge=2, le=1000)] = 500
    """Most landmarks of a submap; a window closes early with half as many."""


class Gnss(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A receiver of absolute positions (fixes), in the frame of the survey.

    antenna: (ahead [m], left [m]) on the robot. delay_s: a fix stamped t is the antenna's position
    at t − delay_s. sigma_m: standard deviation of a fix without a covariance, independent from one
    pose node to the next.
    """

    antenna: tuple[float, float] = (0.0, 0.0)
    delay_s: Annotated[float, Meta(ge=-10.0, le=10.0)] = 0.0
    sigma_m: Annotated[float, Meta(gt=0.0, le=1e6)] = 3.0


class RobotConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Everything that a robot's estimate depends on beside its measurements."""

    id: Annotated[str, Meta(pattern="^[a-z][a-z0-9_]{0,31}$")]
    motion: MotionModel = MotionModel()
    sensor: Sensor = Sensor()
    front_end: FrontEnd = FrontEnd()
    gnss: Gnss = Gnss()
    estimator: Estimator = "hybrid"
    fusion: FusionRule = "join"
    exchange_s: NonNegative = 0.0
    """Rules with feedback: least team time between two exchanges of maps (at window ends; for
    `hybrid-thesis` at keyframes)."""
    pose_s: NonNegative = 0.0
    """Least team time between two running poses. A running map and particles are published for each
    window that contains a multiple of it."""
    clock_offset_s: Annotated[float, Meta(ge=-1e6, le=1e6)] = 0.0
    """Odometry stamped t belongs to team time t + clock_offset_s, the sensor's clock."""
    bounds: Bounds = Bounds()
    seed: Annotated[int, Meta(ge=0, le=2**63 - 1)] = 1
