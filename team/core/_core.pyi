"""
The numerical core: the state of a window, and functions with defined bits.
"""

from collections.abc import Sequence
from typing import Final, overload

import numpy
from numpy.typing import NDArray


level: str

digest: str

width: int

POSE_JITTER: tuple[float, ...]

class NotFiniteError(ValueError):
    pass

class MotionError(ValueError):
    pass

def check_finite(data: bytes, what: str, count: int | None = None) -> None:
    """Raise ValueError unless there are `count` float64, all finite."""

def check_derivatives(data: bytes, count: int, what: str) -> None:
    """
    Raise ValueError unless there are `count` finite float32, or as many float64.
    """

def check_angles(data: bytes, what: str, count: int) -> None:
    """Raise ValueError unless there are `count` angles in [-pi, pi]."""

def check_ranges(data: bytes, what: str, count: int | None = None) -> None:
    """
    Raise ValueError unless there are `count` finite float64, none negative.
    """

def check_named(data: bytes, what: str) -> None:
    """
    Raise ValueError if an id is that of a landmark without identity, 2^31 or larger.

    A window assigns these numbers itself, so they would collide.
    """

def check_ascending(data: bytes, what: str) -> None:
    """Raise ValueError unless the ids are strictly ascending."""

def check_pose_covariance(data: bytes, what: str) -> None:
    """
    Raise ValueError unless nine float64 form a symmetric positive definite 3 x 3 matrix.

    Symmetry is judged by the standard deviations, |P_ij - P_ji| <= 1e-9 sigma_i sigma_j; a pivot by the
    rounding error of a matrix with a unit diagonal.
    """

def check_packed_covariance(data: bytes, n: int, what: str) -> None:
    """
    Raise ValueError unless a packed upper triangle is a positive definite n x n matrix.
    """

def check_blocks(data: bytes, count: int, what: str) -> None:
    """
    Raise ValueError unless there are `count` packed 2 x 2 covariances (3 float64 each).
    """

class Consensus:
    """
    The measurements of a window, and which of them agree: a measurement that no others confirm is an outlier.

    A measurement is accepted where it is likelier given the other accepted ones and the odometry than
    as an outlier, uniform over the sensor's range and field of view.
    """

    def __init__(self, noise: Sequence[float], max_range: float, field_of_view: float, outlier_share: float) -> None:
        """
        Begin a window. noise: as of `Window`; outlier_share: the share of measurements that are outliers.
        """

    def add(self, keyframe: Keyframe) -> None:
        """
        Add a keyframe: the motion since the last one, then its measurements, if any.
        """

    def agreeing(self) -> NDArray[numpy.bool_]:
        """
        Mark the measurements that agree with others of their landmark under the odometry alone.

        The measurement of a landmark that the others support best places it; it is accepted together with
        those that support it.
        """

    def confirmed(self) -> NDArray[numpy.bool_]:
        """
        Mark those of `agreeing`, then by a smoother over the whole window until the classification is stable.

        Where the normal equations have no solution in floating point, nothing more is rejected.
        """

def product(a: NDArray[numpy.float64], b: NDArray[numpy.float64]) -> NDArray[numpy.float64]:
    """
    Compute A B of matrices, vectors or stacks of them, as NumPy's `matmul`.

    Raises ValueError unless A has as many columns as B has rows.
    """

def solve(A: NDArray[numpy.float64], B: NDArray[numpy.float64]) -> NDArray[numpy.float64]:
    """
    Solve A^-1 B by elimination with partial pivoting; B is a vector, a matrix or a stack of these.

    Raises LinAlgError if A is singular.
    """

def inverse_matrix(A: NDArray[numpy.float64]) -> NDArray[numpy.float64]:
    """
    Invert a matrix or each of a stack. Raises LinAlgError if one is singular.
    """

def cholesky(A: NDArray[numpy.float64]) -> NDArray[numpy.float64]:
    """
    Compute the lower L with L L^T = A from the lower triangle of A.

    Raises LinAlgError unless A is positive definite.
    """

def inverse_of_factored(L: NDArray[numpy.float64]) -> NDArray[numpy.float64]:
    """Compute (L L^T)^-1 of a lower triangular L, exactly symmetric."""

def forward(L: NDArray[numpy.float64], B: NDArray[numpy.float64]) -> NDArray[numpy.float64]:
    """Compute L^-1 B of a lower triangular L; B is a vector or a matrix."""

def solve_factored(L: NDArray[numpy.float64], B: NDArray[numpy.float64]) -> NDArray[numpy.float64]:
    """
    Compute (L L^T)^-1 B of a lower triangular L; B is a vector or a matrix.
    """

def factor_or_fault(P: NDArray[numpy.float64]) -> tuple[NDArray[numpy.float64], int]:
    """
    Factor a covariance: lower L with L L^T = P, and 0; or an empty matrix, and the index in teamslam.team.estimation.gaussian.FAULTS of why there is none.
    """

def spread_of(P: NDArray[numpy.float64], headings: NDArray[numpy.bool_]) -> tuple[list[float], list[float], float] | None:
    """
    Find the (least, largest) standard deviation of coordinates and of headings, which `headings` marks, and the
    least share of a number's variance that the others leave: 0 where P is not positive definite.

    Returns None where a variance is not positive.
    """

def curved_covariance(heading: float, covariance: NDArray[numpy.float64]) -> NDArray[numpy.float64]:
    """
    Compute the covariance of (x, y, heading) about pose o Exp(xi) to second order; teamslam.team.estimation.gaussian.curved describes it.
    """

def packed(P: NDArray[numpy.float64]) -> NDArray[numpy.float64]:
    """Pack the upper triangle, row-major: n(n+1)/2 numbers."""

def unpacked(triangle: NDArray[numpy.float64], n: int) -> NDArray[numpy.float64]:
    """Expand a packed upper triangle to a symmetric n x n matrix."""

def largest(values: NDArray[numpy.float64]) -> float:
    """Find the largest absolute value: 0 of an empty array, NaN with a NaN."""

def chi2_quantiles(below: float, above: float, dof: NDArray[numpy.float64]) -> NDArray[numpy.float64]:
    """
    Compute the values that chi-squared exceeds with the probability above = 1 - below; NaN for less than one degree of freedom.
    """

def chi2_scale(squares: NDArray[numpy.float64], dof: NDArray[numpy.float64], medians: NDArray[numpy.float64]) -> tuple[float, float] | None:
    """
    Estimate the scale s of terms s chi2(dof): the median of squares / medians, weighted by dof, and the sum of dof.

    medians: of chi2(dof). Terms with dof < 1 are left out; None where none is left.
    """

@overload
def sin_and_cos(angle: float) -> tuple[float, float]:
    """
    Sine and cosine of an angle [rad], or of each of an array; NaN unless finite.
    """

@overload
def sin_and_cos(angle: NDArray[numpy.float64]) -> tuple[NDArray[numpy.float64], NDArray[numpy.float64]]: ...

@overload
def exp(x: float) -> float:
    """e^x, or of each of an array; 0 below -745.2, infinite above 709.8."""

@overload
def exp(x: NDArray[numpy.float64]) -> NDArray[numpy.float64]: ...

@overload
def sin(angle: float) -> float:
    """Sine of an angle [rad], or of each of an array."""

@overload
def sin(angle: NDArray[numpy.float64]) -> NDArray[numpy.float64]: ...

@overload
def cos(angle: float) -> float:
    """Cosine of an angle [rad], or of each of an array."""

@overload
def cos(angle: NDArray[numpy.float64]) -> NDArray[numpy.float64]: ...

@overload
def tan(angle: float) -> float:
    """Tangent of an angle [rad], or of each of an array."""

@overload
def tan(angle: NDArray[numpy.float64]) -> NDArray[numpy.float64]: ...

@overload
def log(x: float) -> float:
    """Natural logarithm of x, or of each of an array."""

@overload
def log(x: NDArray[numpy.float64]) -> NDArray[numpy.float64]: ...

@overload
def log1p(x: float) -> float:
    """ln(1 + x); x may be an array."""

@overload
def log1p(x: NDArray[numpy.float64]) -> NDArray[numpy.float64]: ...

@overload
def expm1(x: float) -> float:
    """e^x - 1; x may be an array."""

@overload
def expm1(x: NDArray[numpy.float64]) -> NDArray[numpy.float64]: ...

@overload
def squared(x: float) -> float:
    """x x; x may be an array. (Python's `x**2` is the C library's `pow`.)"""

@overload
def squared(x: NDArray[numpy.float64]) -> NDArray[numpy.float64]: ...

@overload
def normal_below(x: float) -> float:
    """
    Probability of a standard normal variable below x, to 1e-15; x may be an array.
    """

@overload
def normal_below(x: NDArray[numpy.float64]) -> NDArray[numpy.float64]: ...

@overload
def wrapped(angle: float) -> float:
    """Wrap an angle to (-pi, pi]; it may be an array."""

@overload
def wrapped(angle: NDArray[numpy.float64]) -> NDArray[numpy.float64]: ...

@overload
def atan2(y: float, x: float) -> float:
    """Direction of (x, y) in [-pi, pi]; both may be arrays."""

@overload
def atan2(y: NDArray[numpy.float64], x: NDArray[numpy.float64]) -> NDArray[numpy.float64]: ...

@overload
def atan2(y: NDArray[numpy.float64], x: float) -> NDArray[numpy.float64]: ...

@overload
def atan2(y: float, x: NDArray[numpy.float64]) -> NDArray[numpy.float64]: ...

@overload
def hypot(x: float, y: float) -> float:
    """Length of (x, y); both may be arrays."""

@overload
def hypot(x: NDArray[numpy.float64], y: NDArray[numpy.float64]) -> NDArray[numpy.float64]: ...

@overload
def hypot(x: NDArray[numpy.float64], y: float) -> NDArray[numpy.float64]: ...

@overload
def hypot(x: float, y: NDArray[numpy.float64]) -> NDArray[numpy.float64]: ...

class SubmapFactor:
    """
    A submap as a factor between its start pose, its other poses, its landmarks and its biases.

    mean: of (poses, landmarks); information: P⁻¹; landmarks: each one's own covariance (xx, xy, yy).
    sensitivity: ∂mean/∂b, a row per bias; range_power: of each, the power of a landmark's range with
    which the bias moves it, 0 or 1; -1 for none. curvature: ∂²mean/∂b², a row per bias.
    is_measured: False for a saved map, whose errors belong to no range. at: index in the state of the first
    number of each member.
    """

    def __init__(self, mean: NDArray[numpy.float64], information: NDArray[numpy.float64], landmarks: NDArray[numpy.float64], sensitivity: NDArray[numpy.float64], range_power: NDArray[numpy.int64], is_measured: bool = True, curvature: NDArray[numpy.float64] | None = None) -> None: ...

    def with_errors(self, sensitivity: NDArray[numpy.float64], range_power: NDArray[numpy.int64], curvature: NDArray[numpy.float64] | None = None) -> SubmapFactor:
        """Make the same submap with other biases."""

    def normal(self, state: NDArray[numpy.float64], at: NDArray[numpy.int64]) -> tuple[NDArray[numpy.float64], NDArray[numpy.float64], float]:
        """Compute JᵀP⁻¹J, JᵀP⁻¹r and χ² = rᵀP⁻¹r over the members."""

    def at_joined_ranges(self, state: NDArray[numpy.float64], at: NDArray[numpy.int64]) -> SubmapFactor:
        """
        Make the same submap with its noise at the ranges in a state, for errors proportional to the range.
        """

    def discounted(self, weights: NDArray[numpy.float64]) -> SubmapFactor:
        """
        Make the same submap with each landmark's own covariance enlarged by its weight: P + blkdiag(0, (1/w - 1) P_ll).
        """

    @property
    def information(self) -> NDArray[numpy.float64]:
        """P⁻¹."""

    @property
    def sensitivity(self) -> NDArray[numpy.float64]:
        """∂mean/∂b, a row per bias."""

    @property
    def landmarks(self) -> NDArray[numpy.float64]:
        """Each landmark's own covariance (xx, xy, yy)."""

LARGEST_RATIO: float

class Quadratic:
    """
    Old factors, linearised: cost + 2 slopeᵀ d + dᵀ information d, d = x - at with headings wrapped,
    over some nodes of a graph, none of them fixed; and the landmarks at rest given these nodes.
    """

    def __init__(self, nodes: NDArray[numpy.int64], at: NDArray[numpy.float64], headings: NDArray[numpy.bool_], information: NDArray[numpy.float64], slope: NDArray[numpy.float64], cost: float) -> None: ...

    @property
    def nodes(self) -> NDArray[numpy.int64]: ...

    @property
    def at(self) -> NDArray[numpy.float64]:
        """Linearisation point."""

    @property
    def headings(self) -> NDArray[numpy.bool_]:
        """Marks of the headings."""

    @property
    def information(self) -> NDArray[numpy.float64]: ...

    @property
    def slope(self) -> NDArray[numpy.float64]: ...

    @property
    def cost(self) -> float: ...

    def woken(self, places: NDArray[numpy.int64], nodes: NDArray[numpy.int64]) -> Quadratic:
        """
        Turn some landmarks at rest, by ascending place, into nodes; exact, since the others at rest are conditioned on
        them. Raises NotPositiveDefiniteError.
        """

def scatter_of_landmarks(points: NDArray[numpy.float64], spread: NDArray[numpy.float64], of: NDArray[numpy.int64], count: int, most: float) -> NDArray[numpy.float64]:
    """
    Sum chi2 of each landmark's observations N(points, spread (xx, xy, yy)) about their median, each at most `most`.
    """

def change_of(points: NDArray[numpy.float64], spread: NDArray[numpy.float64], least: int, most: float) -> tuple[int, float] | None:
    """
    Find where the place of a landmark changes most: the number of observations before, and by how much chi2 about
    two medians, each of at least `least`, is smaller than about one. None with too few.
    """

class SubmapGraph:
    """
    The factor graph of one frame, independent of the state.

    offset: of each node's first number in the state, and the state's length. fixed: nodes that are
    constants. submaps: (factor, nodes of its members). sightings: (observer's and teammate's node,
    measurement, information). priors: (nodes, mean, information, whether it is of one robot's bias).
    Raises ValueError for a factor that does not fit its nodes.
    """

    def __init__(self, offset: NDArray[numpy.int64], fixed: NDArray[numpy.bool_], submaps: Sequence[tuple[SubmapFactor, NDArray[numpy.int64]]], sightings: Sequence[tuple[int, int, NDArray[numpy.float64], NDArray[numpy.float64], NDArray[numpy.float64]]], priors: Sequence[tuple[NDArray[numpy.int64], NDArray[numpy.float64], NDArray[numpy.float64], bool]], condensed: Quadratic | None) -> None: ...

    @property
    def pattern(self) -> Pattern:
        """
        Blocks of the normal equations, a variable per node, and their places in the factor.
        """

    def landmark_chi2(self, state: NDArray[numpy.float64], covariance_factor: float) -> NDArray[numpy.float64]:
        """
        Compute r_lᵀ (covariance_factor · P_ll)⁻¹ r_l of each landmark of each submap.
        """

class Estimate:
    """
    A state of a graph, with the weights of the factors at it, and its Gauss-Newton step.

    scale, sighting_scale: widening of the gates of each submap and inter-robot measurement. submap_gate:
    factor on the gates of submaps; landmark_gate: χ² of a landmark's. Arrays are in the graph's order; results are cached.
    """

    def __init__(self, graph: SubmapGraph, state: NDArray[numpy.float64], scale: NDArray[numpy.float64], sighting_scale: NDArray[numpy.float64], robust: bool, submap_gate: float, landmark_gate: float, covariance_factor: float, joined_ranges: bool) -> None: ...

    @property
    def landmark_weights(self) -> NDArray[numpy.float64]:
        """
        Weight of each landmark of each submap: 1 up to its gate or without a robust loss.
        """

    @property
    def dimensions(self) -> NDArray[numpy.float64]:
        """
        Dimension of each submap, a discounted landmark counting by its weight.
        """

    @property
    def chi2(self) -> NDArray[numpy.float64]:
        """rᵀ(f P)⁻¹r of each submap, with discounted landmarks."""

    @property
    def whole_chi2(self) -> NDArray[numpy.float64]:
        """rᵀ(f P)⁻¹r of each submap, without discounting."""

    @property
    def counted_chi2(self) -> NDArray[numpy.float64]:
        """χ² of each submap in which each landmark's share w χ² counts w times."""

    @property
    def weights(self) -> NDArray[numpy.float64]:
        """Robust weight of each submap."""

    @property
    def sighting_chi2(self) -> NDArray[numpy.float64]:
        """rᵀR⁻¹r of each inter-robot measurement."""

    @property
    def sighting_weights(self) -> NDArray[numpy.float64]:
        """Robust weight of each inter-robot measurement."""

    @property
    def prior_chi2(self) -> NDArray[numpy.float64]:
        """χ² of each prior."""

    @property
    def prior_weights(self) -> NDArray[numpy.float64]:
        """Robust weight of each prior: below 1 only for a robot's own bias."""

    @property
    def cost(self) -> float:
        """Cost at these robust scales."""

    @property
    def normal_equations(self) -> tuple[NDArray[numpy.float64], NDArray[numpy.float64]]:
        """
        A = Σ w JᵀP⁻¹J in the layout of the graph's pattern, and half the gradient, Σ w JᵀP⁻¹r.
        """

    @property
    def gradient(self) -> NDArray[numpy.float64]:
        """Half the gradient, Σ w JᵀP⁻¹r."""

    @property
    def posterior(self) -> Cholesky:
        """Cholesky factor of A. Raises NotPositiveDefiniteError."""

    @property
    def step(self) -> NDArray[numpy.float64]:
        """Full step, -A⁻¹g."""

    @property
    def squared_length(self) -> float:
        """Squared length of the full step in standard deviations, gᵀA⁻¹g."""

    @property
    def selected_covariance(self) -> NDArray[numpy.float64]:
        """
        Entries of A⁻¹ in the layout of the graph's pattern; fixed nodes: identity.
        """

    def take_step(self, damping: float, halvings: int, most_damping: float) -> tuple[NDArray[numpy.float64] | None, float, float]:
        """
        Take the step -(A + damping · diag A)⁻¹g if it lowers the cost; else, if undamped, its half, and so on; else a
        more damped one, up to most_damping. Returns the next state, the next damping and the full step's largest
        change; if no damping helps, None, infinity and the change of the first step.
        """

    @property
    def explained(self) -> NDArray[numpy.float64]:
        """
        tr(JᵀP⁻¹J Σ) of each submap: the part of its dimension that the solution absorbs.
        """

    @property
    def explained_by_sightings(self) -> NDArray[numpy.float64]:
        """tr(JᵀR⁻¹J Σ) of each inter-robot measurement."""

    @property
    def explained_by_priors(self) -> NDArray[numpy.float64]:
        """tr(P⁻¹ Σ) of each prior."""

    @property
    def observations(self) -> tuple[NDArray[numpy.float64], NDArray[numpy.float64]]:
        """
        Points of the landmarks of each submap by its start pose, and their covariances (xx, xy, yy) from that of
        the start pose and their own.
        """

    def points(self, members: NDArray[numpy.int64]) -> NDArray[numpy.float64]:
        """
        Find the points of landmarks, by their nodes, or -1 - k for the k-th at rest.
        """

    def blocks(self, members: NDArray[numpy.int64]) -> NDArray[numpy.float64]:
        """
        Compute the covariance of each landmark; zero of a fixed node. members: as of `points`.
        """

    def joint(self, members: NDArray[numpy.int64]) -> tuple[NDArray[numpy.float64], NDArray[numpy.float64]]:
        """
        Compute mean and joint covariance of nodes and of landmarks at rest; zero of fixed nodes. members: as of `points`.
        """

    def condense(self, leaving: NDArray[numpy.bool_], resting: NDArray[numpy.int64], given_up: NDArray[numpy.int64], runs: Sequence[NDArray[numpy.int64]]) -> tuple[Quadratic, NDArray[numpy.bool_], int, NDArray[numpy.bool_], NDArray[numpy.bool_]]:
        """
        Condense some submaps: eliminate their poses but for the ends of the paths, and landmarks that come to rest or
        are given up. runs: the submaps in the order in which they are eliminated, if none has been before.

        Returns the factor over the renumbered nodes that stay, marks of the eliminated nodes and the number of their
        free unknowns, and marks of the inter-robot measurements and priors in it. Raises NotPositiveDefiniteError.
        """

class WholeMap:
    """
    N(mean, covariance) of (pose, landmarks by ascending id) in one frame; immutable.
    """

    def __init__(self, ids: NDArray[numpy.uint32], mean: NDArray[numpy.float64], covariance: NDArray[numpy.float64]) -> None: ...

    @property
    def ids(self) -> NDArray[numpy.uint32]:
        """The landmarks' ids (L,), ascending; read-only."""

    @property
    def mean(self) -> NDArray[numpy.float64]:
        """(x, y, theta, x1, y1, ...), n = 3 + 2 L numbers; read-only."""

    @property
    def covariance(self) -> NDArray[numpy.float64]:
        """(n, n); read-only."""

    def pose(self) -> tuple[NDArray[numpy.float64], NDArray[numpy.float64]]:
        """Copy mean (3,) and covariance (3, 3) of the pose."""

    @property
    def has_sound_landmarks(self) -> bool:
        """
        Whether the landmarks' covariance is finite, and that of each landmark alone positive definite.
        """

    def joined(self, ids: NDArray[numpy.uint32], mean: NDArray[numpy.float64], covariance: NDArray[numpy.float64]) -> tuple[WholeMap, int]:
        """
        Compose a submap, without pose nodes, onto the pose: known landmarks fused, new ones added.

        Returns the map and a fault: 0, 1 where the known landmarks' innovation has no covariance; then the map
        is as it was.
        """

    def pose_after(self, submap: WholeMap, gate: float) -> tuple[NDArray[numpy.float64], NDArray[numpy.float64], int, int, int]:
        """
        Compute the pose of `joined` alone, without landmarks that the others contradict by more than the gate.

        Returns pose (3,), covariance (3, 3), the numbers of known and of refused landmarks, and a fault: 0, 1 as
        of `joined`, 2 where a single landmark's innovation is singular.
        """

def corrected(mean: NDArray[numpy.float64], covariance: NDArray[numpy.float64], factor: float, sensitivity: NDArray[numpy.float64], curvature: NDArray[numpy.float64], errors: Sequence[tuple[float, float, int]]) -> tuple[NDArray[numpy.float64], NDArray[numpy.float64]]:
    """
    Correct N(mean, P) by errors (b, sigma, row) with the rows S of the sensitivity and D of the curvature, (k, n).

    Returns mean + sum(S b + D b^2 / 2) and f P + sum(sigma^2 (S + b D)' (S + b D)).
    """

class Chain:
    """
    A prior and the submaps after it, each beginning at the end of the one before.
    """

    def __init__(self, prior: WholeMap) -> None: ...

    def append(self, ids: NDArray[numpy.uint32], mean: NDArray[numpy.float64], covariance: NDArray[numpy.float64]) -> None:
        """Append the next submap, without pose nodes."""

    def solve(self, iterations: int, tolerance: float) -> ChainSolution:
        """
        Minimise the squares over all poses and landmarks by damped Gauss-Newton.

        tolerance: the largest change of a number, of an undamped step, at which the iterations stop.
        """

class ChainSolution:
    """Least-squares solution of a prior and the submaps after it."""

    @property
    def map(self) -> WholeMap:
        """The last end pose and all landmarks."""

    @property
    def cost(self) -> float:
        """Chi-squared of all maps, in `dof` degrees of freedom."""

    @property
    def dof(self) -> int: ...

    @property
    def known(self) -> NDArray[numpy.int64]:
        """
        For each submap, the number of its landmarks that another map has, too.
        """

    @property
    def landmark_chi2(self) -> NDArray[numpy.float64]:
        """Chi-squared of each landmark of the submaps by its own covariance."""

    @property
    def fault(self) -> int:
        """0; 1 if an unknown is undetermined, 2 if map `at` has no covariance."""

    @property
    def at(self) -> int:
        """The map without covariance; 0 is the prior."""

class Calibration:
    """Correction of a raw measurement of range and bearing, and its limits."""

    def __init__(self, range_offset: float, range_scale: float, bearing_offset: float, lens: Sequence[float] | None, optical_axis: float | None, ranges: Sequence[float], half_field: float) -> None:
        """
        lens: coefficients of the bearing's error b (l0 + l1 b + l2 b^2); optical_axis [rad]: of a camera whose
        range is a depth along it; ranges: (least, most) of raw ranges [m]; half_field: half of the field of view [rad].
        """

    def correct(self, ranges: NDArray[numpy.float64], bearings: NDArray[numpy.float64]) -> tuple[NDArray[numpy.bool_], NDArray[numpy.float64], NDArray[numpy.float64]]:
        """
        Return which raw measurements are accepted, and all of them corrected: ((r - range_offset)/range_scale,
        b - bearing_offset - lens(b)).

        A depth is divided by cos(b - optical_axis), too, and NaN where that is below 0.17. Accepted are those
        in the ranges and the field of view whose corrected range is positive.
        """

NEAREST_M: float

def predicted(pose: NDArray[numpy.float64], landmark: NDArray[numpy.float64]) -> tuple[float, float]:
    """
    Predict range [m] and bearing [rad] of a point landmark from a pose, both in the map frame.

    range = max(|landmark - (x, y)|, NEAREST_M), bearing = atan2(dy, dx) - heading in (-pi, pi].
    """

def predict(pose: NDArray[numpy.float64], landmarks: NDArray[numpy.float64]) -> tuple[NDArray[numpy.float64], NDArray[numpy.float64], NDArray[numpy.float64]]:
    """
    Predict the measurements h (L, 2) of landmarks (L, 2), with dh/dxi (L, 2, 3) of h(pose o Exp(xi), landmark) at
    xi = 0 and dh/dlandmark (L, 2, 2).
    """

def located(pose: NDArray[numpy.float64], range: float, bearing: float) -> NDArray[numpy.float64]:
    """
    Invert the model: the point at (range, bearing) from a pose, in the pose's map frame.
    """

def place(pose: NDArray[numpy.float64], measurements: NDArray[numpy.float64], noise: Sequence[float], own: NDArray[numpy.float64]) -> tuple[NDArray[numpy.float64], NDArray[numpy.float64]]:
    """
    Initialise landmarks: means (n, 2) and covariances (xx, xy, yy) (n, 3) of measurements (n, 2).

    noise: as of `Window`; own: (n, 4) covariances of the measurements, or (n, 0).
    """

class MotionModel:
    """
    Parameters of a motion model, as of `teamslam.team.config.MotionModel`.
    """

    def __init__(self, *, turns_first: bool, forward: Sequence[float], turn: Sequence[float], final_turn: Sequence[float], lateral: Sequence[float], forward_scale: float, yaw_scale: float, yaw_rate_limit: float, turn_drag: float, veer: float, slow_below: float, slow_scale: float, covariance_factor: float, calibrated_speed: Sequence[float] | None, alphas: Sequence[float] | None, alpha_interval_s: float, wheels: Sequence[float] | None, shares: Sequence[float] | None, shares_interval_s: float) -> None:
        """
        Noises are (per_s, per_m, per_rad); wheels: their distance, and the noise of the left and of the right one.
        """

    def increment(self, duration_s: float, forward: float, yaw_rate: float) -> tuple[NDArray[numpy.float64], NDArray[numpy.float64]]:
        """
        Compute the motion of one odometry interval: `forward` [m/s] and `yaw_rate` [rad/s] held for `duration_s`.

        With v = forward_scale forward (slow_scale forward where |forward| < slow_below),
        w = clip(yaw_scale yaw_rate, +-yaw_rate_limit), the path length d = sign(v) max(|v| - turn_drag |w|, 0) t,
        the turn p = w t + veer d and the noises a (forward, on d), b (turn, on p), c (final turn), l (lateral), the
        motion is

        - "turn-then-drive": turn p + b, drive d + a, then (0, l, c): the thesis, section 4.3.1;
        - all others: Exp(d + a, 0, p + b), then (0, l, c): the arc of Thrun et al. table 5.3 and Ma & Ma eq. 1-4.

        Returns mean and covariance.
        """

    def part(self, twist: NDArray[numpy.float64], covariance: NDArray[numpy.float64] | None, duration_s: float, share: float, rest: float) -> tuple[NDArray[numpy.float64], NDArray[numpy.float64]]:
        """
        Compute a share of a measured motion Exp(twist) at constant twist, followed by the share `rest`.

        covariance: the source's own of the whole interval, in the tangent space of its end; without it the noise is
        the model's. A share f of it is f Ad C Ad', with Ad of the motion that follows, so that parts compose to C.
        """

def compose_motions(mean: NDArray[numpy.float64], covariance: NDArray[numpy.float64], then: NDArray[numpy.float64], added: NDArray[numpy.float64]) -> tuple[NDArray[numpy.float64], NDArray[numpy.float64]]:
    """
    Compose two motions: mean o then, with Ad C Ad' + added, Ad = Ad(then^-1), to first order in the noise.
    """

def motion_of_sensor(mean: NDArray[numpy.float64], covariance: NDArray[numpy.float64], mount: NDArray[numpy.float64]) -> tuple[NDArray[numpy.float64], NDArray[numpy.float64]]:
    """
    Convert a motion T of the base to the sensor's at m: T Exp(xi) m = m (m^-1 T m) Exp(Ad(m^-1) xi).
    """

class OdometryInterval:
    """
    An odometry interval until end_ns: mean forward speed [m/s] and yaw rate [rad/s].

    twist: (forward [m], left [m], turn [rad]) of a reported motion Exp(twist), which has these speeds; covariance:
    reported, of the error in the tangent space of its end.
    """

    def __init__(self, end_ns: int, duration_ns: int, forward: float, yaw_rate: float, twist: NDArray[numpy.float64] | None = None, covariance: NDArray[numpy.float64] | None = None) -> None: ...

    @property
    def end_ns(self) -> int: ...

    @property
    def duration_ns(self) -> int: ...

    @property
    def forward(self) -> float: ...

    @property
    def yaw_rate(self) -> float: ...

    @property
    def twist(self) -> NDArray[numpy.float64] | None: ...

    @property
    def covariance(self) -> NDArray[numpy.float64] | None: ...

    @property
    def speed(self) -> float:
        """Magnitude of the velocity [m/s]; without a reported motion, signed."""

    def gone_on(self, end_ns: int, duration_ns: int) -> OdometryInterval:
        """Extrapolate to a later interval at the same speeds."""

    def part(self, model: MotionModel, duration_ns: int, rest_ns: int) -> tuple[NDArray[numpy.float64], NDArray[numpy.float64]]:
        """
        Compute the motion of a part of the interval, rest_ns before its end, as `MotionModel.part`.
        """

def compose(a_from_b: NDArray[numpy.float64], b_from_c: NDArray[numpy.float64]) -> NDArray[numpy.float64]:
    """a_from_c = a_from_b o b_from_c, or that of each row of b_from_c."""

def inverse(a_from_b: NDArray[numpy.float64]) -> NDArray[numpy.float64]:
    """b_from_a."""

def between(a_from_b: NDArray[numpy.float64], a_from_c: NDArray[numpy.float64]) -> NDArray[numpy.float64]:
    """b_from_c = a_from_b^-1 o a_from_c: the motion from b to c, seen in b."""

def transformed(a_from_b: NDArray[numpy.float64], point_in_b: NDArray[numpy.float64]) -> NDArray[numpy.float64]:
    """Return the point's coordinates in frame a."""

def exponential(xi: NDArray[numpy.float64]) -> NDArray[numpy.float64]:
    """
    Exp: R^3 -> SE(2), the motion at the constant twist xi = (forward, left, turn) for unit time.
    """

def logarithm(pose: NDArray[numpy.float64]) -> NDArray[numpy.float64]:
    """Log: SE(2) -> R^3, the inverse of `exponential` for |heading| < pi."""

def adjoint(a_from_b: NDArray[numpy.float64]) -> NDArray[numpy.float64]:
    """
    Ad with T o Exp(xi) = Exp(Ad_T xi) o T: carries a perturbation from the right to the left.
    """

def tangent(heading: float) -> NDArray[numpy.float64]:
    """d(x, y, heading)/d(xi) of pose o Exp(xi) for a pose of this heading."""

def pose_bytes(mean: NDArray[numpy.float64], covariance: NDArray[numpy.float64]) -> tuple[bytes, bytes]:
    """
    Encode a pose and its covariance, made exactly symmetric, as float64 for a message.
    """

class NotPositiveDefiniteError(ValueError):
    """
    A pivot of the factorisation is not positive: the block `variable` is undetermined.
    """

    variable: int = -1

class Pattern:
    """
    The stored blocks of the lower triangle of a symmetric matrix, and their places in its factor.

    sizes: unknowns of each block variable. Entry e with column_start[j] ≤ e < column_start[j + 1] is
    block (rows[e], j), rows[e] ≥ j; the first entry of each column is its diagonal block.
    The numbers of a matrix are one flat array: block e row by row from value_start[e] on, diagonal
    blocks as full squares. Each property makes a new array.
    """

    def __init__(self, sizes: NDArray[numpy.int64], column_start: NDArray[numpy.int64], rows: NDArray[numpy.int64]) -> None:
        """
        Analyse a pattern: order of elimination, structure of the factor. Raises ValueError for no pattern.
        """

    @property
    def sizes(self) -> NDArray[numpy.int64]:
        """Unknowns of each variable."""

    @property
    def offset(self) -> NDArray[numpy.int64]:
        """
        Index of each variable's first unknown; the last one is the number of unknowns.
        """

    @property
    def column_start(self) -> NDArray[numpy.int64]:
        """
        Index of each column's first entry; the last one is the number of entries.
        """

    @property
    def rows(self) -> NDArray[numpy.int64]:
        """Row of each entry."""

    @property
    def columns(self) -> NDArray[numpy.int64]:
        """Column of each entry."""

    @property
    def value_start(self) -> NDArray[numpy.int64]:
        """Index of each entry's first number; the last one is the total length."""

    @property
    def diagonal(self) -> NDArray[numpy.int64]:
        """Indices of the diagonal among the numbers of a matrix."""

    @property
    def panels(self) -> tuple[NDArray[numpy.int64], NDArray[numpy.int64]]:
        """Number of columns and of rows of each dense panel of the factor."""

    @property
    def has_big_panel(self) -> bool:
        """Whether a panel is factorised by blocks."""

    def block(self, values: NDArray[numpy.float64], row: int, column: int) -> NDArray[numpy.float64]:
        """
        Block (row, column) of a symmetric matrix on this pattern; zero where none is stored.
        """

    def quadratic(self, values: NDArray[numpy.float64], x: NDArray[numpy.float64]) -> float:
        """Compute xᵀ A x of a matrix on this pattern."""

class Cholesky:
    """
    The Cholesky factor L of a matrix on a pattern: L Lᵀ = A, permuted. Its numbers are finite.
    """

    def __init__(self, pattern: Pattern, values: NDArray[numpy.float64]) -> None:
        """
        Factorise A. Raises NotPositiveDefiniteError, which names the variable of the pivot; a pivot that is
        rounding noise of its diagonal entry counts as zero.
        """

    def solve(self, right: NDArray[numpy.float64]) -> NDArray[numpy.float64]:
        """Solve A X = right, (n,) or (n, k)."""

    def inverse_columns(self, unknowns: NDArray[numpy.int64]) -> NDArray[numpy.float64]:
        """
        Compute columns of A⁻¹, (n, k): the covariance of all unknowns with some.
        """

    def inverse_block(self, unknowns: NDArray[numpy.int64]) -> NDArray[numpy.float64]:
        """
        Compute A⁻¹ between some unknowns, (k, k): their joint covariance, exactly symmetric.
        """

    def selected_inverse(self) -> NDArray[numpy.float64]:
        """
        Compute the entries of A⁻¹ on the pattern of A, in the layout of A's numbers, by Takahashi's recursion.
        """

class Random:
    """
    Random numbers with defined bits: Philox 4x64-10 (Salmon et al. 2011), a function of its key and
    of the count of numbers drawn before.
    """

    def __init__(self, key: bytes) -> None:
        """Begin at the first number of a key of 16 bytes."""

    def uniform(self) -> float:
        """Draw a number in [0, 1)."""

    def normals(self, rows: int, columns: int) -> NDArray[numpy.float64]:
        """Draw standard normal numbers (rows, columns) (Box and Muller 1958)."""

class Blake2b:
    """An incremental BLAKE2b digest (RFC 7693) without a key."""

    def __init__(self, digest_size: int, person: bytes = ...) -> None:
        """person: at most 16 bytes, which separate uses."""

    def update(self, data: bytes) -> None:
        """Add bytes."""

    def copy(self) -> Blake2b:
        """Return an independent copy."""

    def digest(self) -> bytes:
        """Return the digest of all bytes so far."""

def blake2b(data: bytes, digest_size: int, person: bytes = ...) -> bytes:
    """Compute a BLAKE2b digest (RFC 7693); arguments as of `Blake2b`."""

def effective_sample_size(log_weights: NDArray[numpy.float64]) -> float:
    """Compute 1/sum(w^2) of normalised log weights."""

def normalise(log_weights: NDArray[numpy.float64]) -> tuple[NDArray[numpy.float64], float]:
    """
    Return (log w - log sum(w), log sum(w)), with the largest weight factored out of the sum.
    """

def systematic_parents(log_weights: NDArray[numpy.float64], uniform: float) -> NDArray[numpy.int64]:
    """
    Resample systematically: particle i is the parent of floor(M w_i) or ceil(M w_i) particles.

    The M points (k + uniform)/M fall into the intervals of the cumulated weights; 0 <= uniform < 1.
    Kitagawa 1996; Thrun et al. 2005, table 4.4.
    """

def mean_direction(angles: NDArray[numpy.float64], weights: NDArray[numpy.float64]) -> float:
    """Compute the direction of sum(w_i (cos a_i, sin a_i))."""

def sample_factor(weights: NDArray[numpy.float64]) -> float:
    """
    Compute the factor N/(N - 5) for the scatter of N = 1/sum(w^2) particles, N at least 10.

    With it the inverse of the scatter is right on average (Anderson 2003, section 7.7).
    """

def on_group(poses: NDArray[numpy.float64], weights: NDArray[numpy.float64]) -> tuple[NDArray[numpy.float64], NDArray[numpy.float64]]:
    """
    Compute the mean pose on SE(2), and each pose's deviation from it in (x, y, theta).
    """

def moments(poses: NDArray[numpy.float64], weights: NDArray[numpy.float64], means: NDArray[numpy.float64], covariances: NDArray[numpy.float64], between: float) -> tuple[NDArray[numpy.float64], NDArray[numpy.float64]]:
    """
    Compute mean and covariance of the mixture sum(w_i N(mu_i, blkdiag(0, S_1, ..., S_L))).

    poses: (M, 3 k), k poses (x, y, theta) of each particle; headings on the circle. The scatter between
    the particles is taken times `between`: 1 for the mixture itself.
    """

def landmarks_along_paths(ids: NDArray[numpy.uint32], means: NDArray[numpy.float64], covariances: NDArray[numpy.float64], paths: NDArray[numpy.float64], keyframes: NDArray[numpy.int64], seen: NDArray[numpy.uint32], measurements: NDArray[numpy.float64], own: NDArray[numpy.float64], noise: Sequence[float]) -> tuple[NDArray[numpy.float64], NDArray[numpy.float64]]:
    """
    Solve each landmark of each particle by Gauss-Newton over its measurements, given the particle's path.

    ids: of the L landmarks, whose means and covariances are the starts. Of each of N measurements
    keyframes is its place in the paths (K, M, 3), and seen its landmark. Returns means and covariances.
    """

def normalised_square(error: NDArray[numpy.float64], S: NDArray[numpy.float64]) -> float:
    """
    Compute e' inv(S) e by the Cholesky factor of S; NaN if a pivot is not above rounding.
    """

class Step:
    """Statistics of one keyframe."""

    @property
    def log_evidence(self) -> float:
        """log p(z | earlier z) by the particles."""

    @property
    def squared(self) -> float:
        """
        NIS of the measurements that were predicted; NaN where a pivot of S is not above rounding.
        """

    @property
    def dof(self) -> int:
        """Degrees of freedom of `squared`."""

class Window:
    """
    Particles since a window's start, their paths, and the measurements that they have used.

    Poses are the sensor's, in the frame of the window's start of the sensor; the Gaussians are of the
    base, in the frame of its start. Brooks and Bailey 2009, HybridSLAM.
    """

    def __init__(self, particles: int, noise: Sequence[float], improved: bool = True, mount: Sequence[float] = [0.0, 0.0, 0.0], resample_below: float = 0.0) -> None:
        """
        Open a window: every particle exactly at zero, without landmarks or measurements.

        noise: (range_variance, range_per_m2, range_white, bearing_variance, bearing_white), as of
        `models.Noise`. improved: the proposal of FastSLAM 2.0. mount: of the sensor on the base. resample_below: the
        share of effective particles below which they are resampled.
        """

    @staticmethod
    def of_particles(poses: NDArray[numpy.float64], log_weights: NDArray[numpy.float64], ids: NDArray[numpy.uint32], means: NDArray[numpy.float64], covariances: NDArray[numpy.float64], noise: Sequence[float], improved: bool = True) -> Window:
        """Make a window whose particles are these, without a keyframe."""

    def advance(self, keyframe: Keyframe, random: Random) -> Step:
        """
        Add a keyframe: the motion since the last one, then its measurements, if any.

        The particles are resampled first if too few are effective. random: draws a uniform number for that, then
        three normal ones for each particle. Raises MotionError, and leaves the window unchanged.
        """

    def step(self, keyframe: Keyframe, normals: NDArray[numpy.float64]) -> float:
        """
        Add a keyframe as `advance` does, without resampling and innovation; returns the log evidence.

        Raises MotionError, and leaves the window unchanged.
        """

    def move(self, rest: Keyframe, random: Random) -> None:
        """
        Move the particles by the motion after the last keyframe; the weights stay. Raises MotionError.
        """

    def mark(self, stamp_ns: int) -> None:
        """
        Make the particles' poses at the last keyframe a pose node at this team time [ns].
        """

    def innovation(self, keyframe: Keyframe) -> tuple[float, NDArray[numpy.float64], NDArray[numpy.float64]]:
        """
        Predict the measurements of known landmarks; returns (v' inv(S) v, v, S), v = z - h. Raises MotionError.
        """

    def close(self) -> tuple[NDArray[numpy.uint32], NDArray[numpy.float64], NDArray[numpy.float64], int]:
        """
        Match moments with the landmarks solved again along the paths: the submap of the window.

        Returns ids, mean and covariance of (end pose, pose nodes, landmarks by ascending id), and the index in
        `gaussian.FAULTS` of why they are no Gaussian.
        """

    def run(self) -> tuple[WholeMap, int]:
        """
        Match moments of (end pose, landmarks) so far, which are not fused; as `close` without pose nodes.

        Where all errors of the sensor are white the landmarks are those that the particles hold. Returns a map, and
        the index in `gaussian.FAULTS` of why it is no Gaussian.
        """

    def corrected(self, map: WholeMap, factor: float, errors: Sequence[tuple[float, float, int]]) -> tuple[WholeMap, int]:
        """
        Correct the map of `run` by errors (b, sigma, row of `sensitivity`), as the function `corrected` does.

        Returns it, and the index in `gaussian.FAULTS` of why it has no derivatives.
        """

    def replace(self, paths: NDArray[numpy.float64], log_weights: NDArray[numpy.float64], means: NDArray[numpy.float64], covariances: NDArray[numpy.float64]) -> None:
        """
        Replace the paths (K, M, 3), with the particles at their ends, the weights and the landmarks.
        """

    def sensitivity(self, mean: NDArray[numpy.float64], with_nodes: bool) -> tuple[NDArray[numpy.float64], NDArray[numpy.float64], int]:
        """
        Differentiate the mean of `close`, or of `run` without nodes, by errors that windows share.

        Returns a row for each of bearing, clock_offset, forward_scale, range_offset and range_scale, by the window's smoother
        about the particles' mean path; rows of second derivatives, that of clock_offset with nodes, else zero; and the index in `gaussian.FAULTS` of why there are none.
        Numbers are in single precision, as in a message.
        """

    @property
    def has_shifts(self) -> bool:
        """Whether an error of the scale of speed shifts one of the motions."""

    def of_base(self) -> Window:
        """
        Copy the window as one of the base: poses and landmarks in the frame of the base's start.
        """

    def particles(self) -> tuple[NDArray[numpy.float64], NDArray[numpy.float64], NDArray[numpy.uint32], NDArray[numpy.float64], NDArray[numpy.float64]]:
        """
        Copy (poses (M, 3), log_weights (M,), ids (L,), means (M, L, 2), covariances (M, L, 3)).
        """

    def paths(self) -> NDArray[numpy.float64]:
        """
        Copy the pose (K, M, 3) of each particle's line of descent at each of the K keyframes.
        """

    def mean_path(self) -> NDArray[numpy.float64]:
        """
        Compute the weighted mean (K, 3) of the poses at each keyframe, headings on the circle.
        """

    def measurements(self) -> tuple[NDArray[numpy.int64], NDArray[numpy.uint32], NDArray[numpy.float64], NDArray[numpy.float64]]:
        """
        Copy the measurements: keyframes (N,), ids (N,), (range, bearing) (N, 2), and their own covariances
        (N, 4), or (N, 0).
        """

    def ids(self) -> NDArray[numpy.uint32]:
        """Copy the landmarks' numbers in order of first observation."""

    def nodes(self) -> NDArray[numpy.int64]:
        """Copy the keyframe of each pose node."""

    def node_stamps(self) -> NDArray[numpy.int64]:
        """Copy the team time [ns] of each pose node."""

    @property
    def innovated(self) -> tuple[float, int]:
        """
        Sum of the innovations of all keyframes: NIS, and its degrees of freedom.
        """

    @property
    def landmarks(self) -> int:
        """Number of landmarks."""

    @property
    def keyframes(self) -> int:
        """Number of keyframes."""

class Scan:
    """
    Measurements of landmarks: ids, ranges [m] and bearings [rad], relative to the sensor.
    """

    def __init__(self, ids: NDArray[numpy.uint32], ranges: NDArray[numpy.float64], bearings: NDArray[numpy.float64], own: NDArray[numpy.float64] | None = None) -> None:
        """
        own: (n, 4) covariances of the measurements, as of `teamslam.team.estimation.models`; (n, 0) or None: none.
        """

    @staticmethod
    def polar(ids: bytes, ranges: bytes, bearings: bytes, covariances: bytes = ...) -> Scan:
        """
        Make a scan of a message's bytes; covariances: (rr, rb, bb) of each, or empty.
        """

    @staticmethod
    def points(ids: bytes, positions: bytes, covariances: bytes = ...) -> Scan:
        """
        Make a scan of points (x, y) in the sensor's frame; covariances: (xx, xy, yy) of each, or empty.

        (r, b) = (|p|, atan2(y, x)) and J S J' with J = d(r, b)/dp.
        """

    @staticmethod
    def unnamed(ranges: bytes, bearings: bytes, covariances: bytes = ...) -> Scan:
        """Make a scan of landmarks without identities, numbered from 2^31 on."""

    @property
    def ids(self) -> NDArray[numpy.uint32]: ...

    @property
    def ranges(self) -> NDArray[numpy.float64]: ...

    @property
    def bearings(self) -> NDArray[numpy.float64]: ...

    @property
    def own(self) -> NDArray[numpy.float64]:
        """Covariances (n, 4) of the measurements, or (n, 0)."""

    @property
    def is_unnamed(self) -> bool:
        """Whether the landmarks have no identities."""

    def __len__(self) -> int: ...

    def only(self, taken: NDArray[numpy.bool_]) -> Scan:
        """Select measurements."""

    def together(self, more: Scan) -> Scan:
        """
        Append further measurements; if only one part has covariances, the others have the sensor's noise.
        """

def reduce_scans(scans: Sequence[Scan], poses: NDArray[numpy.float64]) -> Scan:
    """
    Reduce scans to one measurement per landmark, by ascending id.

    poses: (m, 3), of each scan relative to the keyframe's end. A measurement is the median of range and bearing,
    moved to the keyframe's end; its covariance is the mean of those of its measurements.
    """

class TimedScan:
    """
    A scan without identities, at at_ns: its stamp, or the start of the odometry that covers it.
    """

    def __init__(self, stamp_ns: int, scan: Scan, at_ns: int, motion: tuple[NDArray[numpy.float64], NDArray[numpy.float64]] | None) -> None: ...

    @property
    def stamp_ns(self) -> int: ...

    @property
    def at_ns(self) -> int: ...

    @property
    def scan(self) -> Scan: ...

    @property
    def motion(self) -> tuple[NDArray[numpy.float64], NDArray[numpy.float64]] | None:
        """Motion since the scan or keyframe before."""

    @property
    def back(self) -> NDArray[numpy.float64] | None:
        """Pose relative to the keyframe's end, if that is another."""

class Keyframe:
    """
    The sensor's motion since the last keyframe, and the measurements at its end, accepted and calibrated.

    looks: the scans without identities since the last keyframe; rest: the motion since the last of them. is_node:
    the pose is a pose node of the submap. shift: of the motion, (forward, left, turn), by an error of the scale of
    speed, and the motion's duration [s]. A motion is (mean, covariance).
    """

    def __init__(self, stamp_ns: int, motion: tuple[NDArray[numpy.float64], NDArray[numpy.float64]], scan: Scan | None = None, looks: Sequence[TimedScan] = [], rest: tuple[NDArray[numpy.float64], NDArray[numpy.float64]] | None = None, is_node: bool = False, shift: Sequence[float] = [0.0, 0.0, 0.0, 0.0]) -> None: ...

    @property
    def stamp_ns(self) -> int: ...

    @property
    def motion(self) -> tuple[NDArray[numpy.float64], NDArray[numpy.float64]]: ...

    @property
    def scan(self) -> Scan: ...

    @property
    def looks(self) -> list[TimedScan]: ...

    @property
    def rest(self) -> tuple[NDArray[numpy.float64], NDArray[numpy.float64]] | None: ...

    @property
    def is_node(self) -> bool: ...

    @property
    def shift(self) -> list[float]: ...

class StreamBounds:
    """Bounds of a sensor stream, as of `teamslam.team.config.Bounds`."""

    def __init__(self, jump_ns: int, interval_s: float, speed_m_s: float, yaw_rate_rad_s: float, extent_m: float, sigma_m: Sequence[float], sigma_rad: Sequence[float]) -> None: ...

class StreamJudge:
    """
    Checks one incarnation of a sensor stream against the time of its last odometry.

    A stamp `jump_ns` ahead of the odometry is refused, even of odometry, until the next interval confirms that the
    clock has jumped. A verdict is an index of `teamslam.team.rejection.BY_CORE`.
    """

    def __init__(self, bounds: StreamBounds) -> None: ...

    def judge(self, interval: OdometryInterval) -> int:
        """Judge an interval; for SPEED and STEERING only its motion is refused."""

    def is_ahead(self, stamp_ns: int) -> bool:
        """Whether a measurement is too far ahead of the odometry."""

    def judge_scan(self, stamp_ns: int, scan: Scan) -> int:
        """Judge a scan, and drop its measurements beyond the bounds."""

class Segmenter:
    """
    Integrates odometry between keyframes; an observation splits an interval.

    With keyframe_ns = 0 every scan is a keyframe. Otherwise the scans within keyframe_ns are reduced to the
    median range and bearing per landmark, moved by the odometry to the end of the interval that closes the
    keyframe. Each pose node is a keyframe without measurements. Scans without identities are stored until the
    window's end. Motions are the sensor's; those since a pose node and an inter-robot measurement are the base's.
    A verdict is an index of `teamslam.team.rejection.BY_CORE`.
    """

    def __init__(self, model: MotionModel, mount: NDArray[numpy.float64] | None, calibration: Calibration, covariance_factor: float, keyframe_ns: int, window_ns: int, bounds: StreamBounds) -> None:
        """
        mount: the sensor's pose on the base; None at the base's origin. covariance_factor: on the
        measurements' own covariances. window_ns: planned length of a window.
        """

    def begin(self, stamp_ns: int) -> None:
        """Begin a stream or a window at this team time."""

    def resume(self, stamp_ns: int) -> None:
        """Begin after a window whose odometry ended at this team time."""

    def observe(self, stamp_ns: int, scan: Scan) -> int:
        """Store a scan until the odometry covers its time; return the verdict."""

    @overload
    def drive(self, end_ns: int, duration_ns: int, forward: float, yaw_rate: float) -> int: ...

    @overload
    def drive(self, interval: OdometryInterval) -> int:
        """
        Judge and integrate an odometry interval.

        Returns the verdict, plus DUE where keyframes are made, the window has lasted for window_ns, or the odometry
        stops at `stop_at`.
        """

    def integrate(self, interval: OdometryInterval, is_measured: bool) -> int:
        """
        Integrate an interval past the judge; returns DUE or 0.

        An unmeasured motion has the last speeds, with standard deviations as large as the motion, at least 1 m/s and
        0.5 rad/s, and below a full rotation in heading.
        """

    def stop_at(self, stop_ns: int) -> None:
        """
        Stop the odometry at this team time, before the scans there, until `go_on`; 2^62: never.
        """

    def go_on(self) -> int:
        """Integrate the rest of the interval; returns DUE or 0."""

    def take_keyframes(self) -> list[Keyframe]:
        """Remove and return the keyframes made."""

    def cut(self, stamp_ns: int) -> Keyframe:
        """
        Close the window: make its last keyframe; return the later motion, as a keyframe without measurements.
        """

    def leave(self) -> int:
        """
        Drop the scans stamped after the window; return their number.

        Their counters lie in the window's interval of measurements: a robot restarted behind it would lack them.
        """

    def mark_sighting(self) -> None:
        """Mark an inter-robot measurement here, for the next pose node."""

    def since_node(self) -> tuple[NDArray[numpy.float64], NDArray[numpy.float64]]:
        """Return the motion since the last pose node."""

    def reach_node(self) -> list[tuple[NDArray[numpy.float64], NDArray[numpy.float64]]]:
        """
        Make the stop a pose node; return the motions since the marked sightings, and clear these.
        """

    @property
    def is_stopped(self) -> bool:
        """Whether the odometry has stopped within the interval."""

    @property
    def interval(self) -> OdometryInterval:
        """The present interval; of an unmeasured motion, with the last speeds."""

    @property
    def judge(self) -> StreamJudge: ...

    @property
    def uncovered(self) -> int:
        """Number of scans whose time odometry has not covered."""

    @property
    def start_ns(self) -> int | None:
        """Begin of the window; None before the stream's."""

    @property
    def now_ns(self) -> int | None:
        """End of the odometry; None before the stream's begin."""

    @property
    def driven_m(self) -> float:
        """Path length [m] since the window's start."""

    DUE: Final[int] = ...
    """(arg: object, /) -> int"""

class OpenWindow:
    """
    A window while it is open: its keyframes, and its particles behind a gate against outliers, with their random
    numbers. A motion or measurement that is not finite leaves it without a solution.
    """

    def __init__(self, particles: int, noise: Sequence[float], improved: bool, mount: Sequence[float], resample_below: float, max_range: float, field_of_view: float, outlier_share: float, random: Random, most_landmarks: int) -> None:
        """
        Open a window: arguments as of `Window` and `Consensus`. random: copied, where it is. most_landmarks: beyond them
        the farthest new landmarks of a keyframe are dropped.
        """

    def advance(self, keyframe: Keyframe) -> None:
        """
        Add a keyframe with those of its measurements that agree with others of the window so far.

        If a measurement that was accepted before no longer agrees, the window is computed again.
        """

    def advance_by(self, segmenter: Segmenter) -> None:
        """Add the keyframes that a segmenter has made."""

    def move(self, rest: Keyframe) -> None:
        """Move the particles by the motion after the last keyframe."""

    def confirm(self) -> bool:
        """
        Compare all measurements of the window; return whether others are accepted now.
        """

    def accepted(self) -> list[Keyframe]:
        """Copy the keyframes with their accepted measurements."""

    def restart(self, keyframes: Sequence[Keyframe], particles: int) -> None:
        """
        Compute the window again with these keyframes, so many particles and the first random numbers; the gate stays.

        Raises MotionError.
        """

    def give_up(self) -> None:
        """Leave the window without a solution."""

    def base_motion(self) -> tuple[NDArray[numpy.float64], NDArray[numpy.float64]]:
        """Compute the base's motion by odometry alone."""

    @property
    def is_solvable(self) -> bool:
        """Whether no motion and no measurement was refused."""

    @property
    def keyframes_ns(self) -> NDArray[numpy.int64]:
        """Team time [ns] of each keyframe."""

    @property
    def last_keyframe_ns(self) -> int | None:
        """Team time [ns] of the last keyframe; None without any."""

    @property
    def has_unnamed(self) -> bool:
        """Whether a keyframe has scans without identities."""

    @property
    def window(self) -> Window:
        """The particles."""

    @property
    def random(self) -> Random:
        """The random numbers."""

    @property
    def rejected(self) -> int:
        """Number of measurements that are not accepted."""

    @property
    def restarts(self) -> int:
        """Number of times that the window was computed again."""

    @property
    def least_effective(self) -> float:
        """
        Least number of effective particles after a keyframe since the beginning.
        """
