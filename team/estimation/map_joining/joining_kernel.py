"""Compiled kernels of map joining: the sparse normal equations of all submaps, and their costs."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int64

from team.estimation import elementary
from team.estimation.compiled import compiled
from team.estimation.geometry import wrapped
from team.estimation.map_joining.submap_factor import (
    biased_normal,
    poses_of,
    shifted_mean,
    submap_residual,
)

Indices = Int64[np.ndarray, " _"]
Values = Float[np.ndarray, " _"]
LARGEST_RATIO = 1.25
"""Largest ratio of a landmark's distance in the joined map to the measured one, and of its inverse.
A landmark beyond it is an outlier, whose covariance must not grow with the distance.
"""
LARGEST_TURN_RAD = 0.2
"""Largest angle between a landmark's direction in the joined map and the measured one, else it is
an outlier.
"""
NO_POWER = -1


class SubmapFactors(NamedTuple):
    """All submaps of a graph in flat arrays, in the order of their addition.

    member[member_start[f] : member_start[f + 1]] are the nodes of submap f: start pose, end pose,
    pose nodes by stamp, landmarks by id, biases. mean, information (P⁻¹, row-major) and sensitivity
    (a row per bias) begin likewise at mean_start, information_start and sensitivity_start. block:
    each landmark's own covariance (xx, xy, yy); those of submap f begin at block_start[f].
    range_power: for each row of the sensitivities, beginning at row_start[f], the power of a
    landmark's range with which the bias moves that landmark, along or across; NO_POWER: neither.
    """

    member: Indices
    member_start: Indices
    mean: Values
    mean_start: Indices
    information: Values
    information_start: Indices
    sensitivity: Values
    sensitivity_start: Indices
    block: Float[np.ndarray, "B 3"]
    block_start: Indices
    range_power: Indices
    row_start: Indices


@compiled
def _pairs(
    fixed: Bool[np.ndarray, " _"], member: Indices, member_start: Indices
) -> tuple[Indices, Indices]:
    """Row and column block of each pair of members, factor by factor; −1 for none."""
    pairs = 0
    for f in range(len(member_start) - 1):
        pairs += (member_start[f + 1] - member_start[f]) ** 2
    pair_row = np.full(pairs, -1, dtype=np.int64)
    pair_column = np.full(pairs, -1, dtype=np.int64)
    pair = 0
    for f in range(len(member_start) - 1):
        nodes = member[member_start[f] : member_start[f + 1]]
        for i in nodes:
            for j in nodes:
                if i >= j and not (fixed[i] or fixed[j]):
                    pair_row[pair], pair_column[pair] = i, j
                pair += 1
    return pair_row, pair_column


@compiled
def block_pattern(
    fixed: Bool[np.ndarray, " _"], member: Indices, member_start: Indices
) -> tuple[Indices, Indices, Indices]:
    """Build the pattern of Σ JᵀP⁻¹J, and its entry for each pair of members of each factor.

    Returns column_start and rows (as in `sparse.Pattern`) and, factor by factor, a k × k table over
    the members: the entry for (a, b) if node a ≥ node b, else −1; also −1 if one of them is fixed.
    """
    n = len(fixed)
    pair_row, pair_column = _pairs(fixed, member, member_start)
    entry = np.full(len(pair_row), -1, dtype=np.int64)
    bucket_start = np.zeros(n + 1, dtype=np.int64)
    for j in pair_column:
        bucket_start[j + 1] += j >= 0
    bucket_start = np.cumsum(bucket_start)
    bucket_pair = np.empty(bucket_start[n], dtype=np.int64)
    filled = bucket_start.copy()
    for pair, j in enumerate(pair_column):
        if j >= 0:
            bucket_pair[filled[j]] = pair
            filled[j] += 1
    column_start = np.zeros(n + 1, dtype=np.int64)
    rows = np.empty(n + bucket_start[n], dtype=np.int64)
    latest = np.full(n, -1, dtype=np.int64)
    count = 0
    for j in range(n):
        rows[count] = j
        latest[j] = count
        count += 1
        for pair in bucket_pair[bucket_start[j] : bucket_start[j + 1]]:
            i = pair_row[pair]
            if latest[i] < column_start[j]:
                rows[count] = i
                latest[i] = count
                count += 1
            entry[pair] = latest[i]
        column_start[j + 1] = count
    return column_start, rows[:count].copy(), entry


@compiled
def robust_weight(chi2: float, dimension: int, scale: float) -> float:
    """Cauchy's weight on √(χ²/dim): 1/(1 + χ²/(dim c²)); 1 for c = ∞."""
    return 1.0 / (1.0 + chi2 / (dimension * scale * scale))


@compiled
def _places(offset: Indices, nodes: Indices) -> Indices:
    at = np.empty(len(nodes), dtype=np.int64)
    for k in range(len(nodes)):
        at[k] = offset[nodes[k]]
    return at


@compiled
def _turn_and_stretch(values: Values, i: int, j: int, c: float, s: float, stretch: float) -> None:
    x, y = values[i], values[j]
    values[i], values[j] = stretch * (c * x - s * y), stretch * (s * x + c * y)


@compiled
def with_joined_ranges(state: Values, offset: Indices, factors: SubmapFactors) -> SubmapFactors:
    """Recompute the submaps' noise at the ranges of the joined map.

    For errors proportional to the range: q is the distance of a landmark, in the state, from its
    submap's viewpoint (the middle of the submap's poses), over the measured distance, and φ the
    angle between the two. The landmark's errors are rotated by φ and multiplied by q, P' = T P Tᵀ
    with T = blkdiag(1, …, q R(φ), …), and its derivatives by the sensor's errors are those at its
    place in the map: S' = qᵏ R(φ) S with k = 0 for an offset of ranges and 1 for their scale.

    With the noise of the measured distance d(1 + e) instead, a measurement that came out short
    weighs more, by (1 + e)⁻² (Peelle's puzzle); and where the scale b of the ranges is a state, the
    noise (e along, ε across) couples to itself: a map and all ranges that are smaller by s have a
    χ² that is smaller by 2 s for each measured number. Both make maps smaller, the second by more
    the more submaps there are.
    """
    information, block = factors.information.copy(), factors.block.copy()
    columns = factors.sensitivity.copy()
    for f in range(len(factors.member_start) - 1):
        at = _places(offset, factors.member[factors.member_start[f] : factors.member_start[f + 1]])
        begin, n = factors.mean_start[f], factors.mean_start[f + 1] - factors.mean_start[f]
        mean = factors.mean[begin : begin + n]
        landmarks = factors.block_start[f + 1] - factors.block_start[f]
        poses = (n - 2 * landmarks) // 3
        x, y = 0.0, 0.0
        for k in range(poses):
            x, y = x + mean[3 * k] / (poses + 1), y + mean[3 * k + 1] / (poses + 1)
        s, c = elementary.sin_and_cos(state[at[0] + 2])
        x_map, y_map = state[at[0]] + c * x - s * y, state[at[0] + 1] + s * x + c * y
        metric = information[factors.information_start[f] : factors.information_start[f] + n * n]
        first = factors.row_start[f]
        for landmark in range(landmarks):
            row, node = 3 * poses + 2 * landmark, at[1 + poses + landmark]
            own_x, own_y = mean[row] - x, mean[row + 1] - y
            dx, dy = state[node] - x_map, state[node + 1] - y_map
            own, joined = elementary.hypot(own_x, own_y), elementary.hypot(dx, dy)
            if not (own > 0.0 and joined > 0.0):
                continue
            q = min(max(joined / own, 1.0 / LARGEST_RATIO), LARGEST_RATIO)
            turn = wrapped(
                elementary.atan2(dy, dx) - elementary.atan2(own_y, own_x) - state[at[0] + 2]
            )
            turn = min(max(turn, -LARGEST_TURN_RAD), LARGEST_TURN_RAD)
            s, c = elementary.sin_and_cos(turn)
            xx, xy, yy = block[factors.block_start[f] + landmark]
            across = 2.0 * c * s * xy
            block[factors.block_start[f] + landmark, 0] = q * q * (c * c * xx + s * s * yy - across)
            block[factors.block_start[f] + landmark, 1] = (
                q * q * (c * s * (xx - yy) + (c * c - s * s) * xy)
            )
            block[factors.block_start[f] + landmark, 2] = q * q * (s * s * xx + c * c * yy + across)
            i, j = row * n, (row + 1) * n
            for k in range(n):
                _turn_and_stretch(metric, i + k, j + k, c, s, 1.0 / q)
            for k in range(n):
                _turn_and_stretch(metric, k * n + row, k * n + row + 1, c, s, 1.0 / q)
            for b in range(factors.row_start[f + 1] - first):
                if factors.range_power[first + b] == NO_POWER:
                    continue
                i = factors.sensitivity_start[f] + b * n + row
                _turn_and_stretch(columns, i, i + 1, c, s, q ** factors.range_power[first + b])
    return SubmapFactors(
        factors.member,
        factors.member_start,
        factors.mean,
        factors.mean_start,
        information,
        factors.information_start,
        columns,
        factors.sensitivity_start,
        block,
        factors.block_start,
        factors.range_power,
        factors.row_start,
    )


@compiled
def landmark_chi2(
    state: Values, offset: Indices, factors: SubmapFactors, covariance_factor: float
) -> Values:
    """Compute r_lᵀ (covariance_factor · P_ll)⁻¹ r_l of each landmark of each submap."""
    result = np.empty(len(factors.block))
    for f in range(len(factors.member_start) - 1):
        at = _places(offset, factors.member[factors.member_start[f] : factors.member_start[f + 1]])
        mean = factors.mean[factors.mean_start[f] : factors.mean_start[f + 1]]
        sensitivity = _sensitivity(factors, f, len(mean))
        members = at[: len(at) - len(sensitivity)]
        residual, _ = submap_residual(state, members, shifted_mean(state, at, mean, sensitivity))
        s, c = elementary.sin_and_cos(state[at[0] + 2])
        begin, end = factors.block_start[f], factors.block_start[f + 1]
        row = len(mean) - 2 * (end - begin)
        for block in range(begin, end):
            x = c * residual[row] + s * residual[row + 1]
            y = -s * residual[row] + c * residual[row + 1]
            xx, xy, yy = factors.block[block]
            determinant = (xx * yy - xy * xy) * covariance_factor
            result[block] = (yy * x * x - 2.0 * xy * x * y + xx * y * y) / determinant
            row += 2
    return result


@compiled
def discounted_information(factors: SubmapFactors, weight: Values) -> Values:
    """Compute (P + blkdiag(0, (1/w_l − 1) P_ll))⁻¹ of each submap, in the layout of `information`.

    A landmark with weight w_l counts as if its own covariance were that much larger; the rest of
    the submap keeps its information. By Woodbury's identity, one landmark after the other.
    """
    result = factors.information.copy()
    for f in range(len(factors.member_start) - 1):
        first = factors.block_start[f]
        n = factors.mean_start[f + 1] - factors.mean_start[f]
        row = n - 2 * (factors.block_start[f + 1] - first)
        begin = factors.information_start[f]
        metric = result[begin : begin + n * n].reshape(n, n)
        for block in range(first, factors.block_start[f + 1]):
            if weight[block] < 1.0:
                _discount(metric, row + 2 * (block - first), factors.block[block], weight[block])
    return result


@compiled
def _discount(
    metric: Float[np.ndarray, "n n"], at: int, block: Float[np.ndarray, "3"], weight: float
) -> None:
    """A := A − A_·l (D⁻¹ + A_ll)⁻¹ A_l·, D = (1/w − 1) P_ll."""
    xx, xy, yy = block
    share = weight / ((1.0 - weight) * (xx * yy - xy * xy))
    a = share * yy + metric[at, at]
    b = metric[at, at + 1] - share * xy
    d = share * xx + metric[at + 1, at + 1]
    determinant = a * d - b * b
    n = len(metric)
    columns = metric[:, at : at + 2].copy()
    for i in range(n):
        x = (d * columns[i, 0] - b * columns[i, 1]) / determinant
        y = (a * columns[i, 1] - b * columns[i, 0]) / determinant
        for j in range(n):
            metric[i, j] -= x * columns[j, 0] + y * columns[j, 1]


@compiled
def _sensitivity(factors: SubmapFactors, f: int, n: int) -> Float[np.ndarray, "B n"]:
    begin, end = factors.sensitivity_start[f], factors.sensitivity_start[f + 1]
    return factors.sensitivity[begin:end].reshape((end - begin) // n, n)


@compiled
def submap_of(
    offset: Indices, factors: SubmapFactors, f: int
) -> tuple[Indices, Indices, Values, Float[np.ndarray, "n n"], Float[np.ndarray, "B n"]]:
    """Return submap f: nodes, their indices in the state, mean, P⁻¹ and sensitivity."""
    nodes = factors.member[factors.member_start[f] : factors.member_start[f + 1]]
    mean = factors.mean[factors.mean_start[f] : factors.mean_start[f + 1]]
    n, begin = len(mean), factors.information_start[f]
    information = factors.information[begin : begin + n * n].reshape(n, n)
    return nodes, _places(offset, nodes), mean, information, _sensitivity(factors, f, n)


@compiled
def costs(
    state: Values, offset: Indices, factors: SubmapFactors, covariance_factor: float
) -> Values:
    """Compute χ² of each submap in the metric (covariance_factor · P)⁻¹."""
    result = np.empty(len(factors.member_start) - 1)
    for f in range(len(result)):
        _, at, mean, information, sensitivity = submap_of(offset, factors, f)
        n = len(mean)
        members = at[: len(at) - len(sensitivity)]
        residual, _ = submap_residual(state, members, shifted_mean(state, at, mean, sensitivity))
        s, c = elementary.sin_and_cos(state[at[0] + 2])
        poses = poses_of(len(members) - 1, n)
        row = 0
        while row < n:
            a, b = residual[row], residual[row + 1]
            residual[row] = c * a + s * b
            residual[row + 1] = -s * a + c * b
            row += 3 if row < 3 * poses else 2
        chi2 = 0.0
        for i in range(n):
            total = 0.0
            for j in range(n):
                total += information[i, j] * residual[j]
            chi2 += residual[i] * total
        result[f] = chi2 / covariance_factor
    return result


@compiled
def normal_equations(
    state: Values,
    offset: Indices,
    fixed: Bool[np.ndarray, " _"],
    factors: SubmapFactors,
    covariance_factor: float,
    scale: Values,
    entry: Indices,
    column_start: Indices,
    value_start: Indices,
) -> tuple[Values, Values, Values]:
    """Sum Σ w JᵀP⁻¹J on the pattern and Σ w JᵀP⁻¹r; return also the unweighted χ² of each submap.

    scale: the robust c of each submap. A fixed node has an identity block without couplings and a
    zero gradient, so that its step is zero.
    """
    values = np.zeros(value_start[-1])
    gradient = np.zeros(offset[-1])
    chi2 = np.empty(len(factors.member_start) - 1)
    for node in range(len(fixed)):
        if fixed[node]:
            size = offset[node + 1] - offset[node]
            for p in range(size):
                values[value_start[column_start[node]] + p * size + p] = 1.0
    pair = 0
    for f in range(len(chi2)):
        nodes, at, mean, information, sensitivity = submap_of(offset, factors, f)
        hessian, slope, raw = biased_normal(state, at, mean, information, sensitivity)
        chi2[f] = raw / covariance_factor
        weight = robust_weight(chi2[f], len(mean), scale[f]) / covariance_factor
        row = 0
        for a in range(len(nodes)):
            size = offset[nodes[a] + 1] - offset[nodes[a]]
            if not fixed[nodes[a]]:
                for p in range(size):
                    gradient[at[a] + p] += weight * slope[row + p]
            column = 0
            for b in range(len(nodes)):
                other = offset[nodes[b] + 1] - offset[nodes[b]]
                if entry[pair] >= 0:
                    base = value_start[entry[pair]]
                    for p in range(size):
                        for q in range(other):
                            values[base + p * other + q] += weight * hessian[row + p, column + q]
                pair += 1
                column += other
            row += size
    return values, gradient, chi2


@compiled
def explained(
    state: Values,
    offset: Indices,
    factors: SubmapFactors,
    covariance_factor: float,
    entry: Indices,
    value_start: Indices,
    inverse: Values,
) -> Values:
    """Compute tr(JᵀP⁻¹J Σ) of each submap: the part of its dimension that the solution absorbs.

    inverse: the entries of Σ on the pattern. For a solution with these weights the sum over all
    factors is the number of unknowns.
    """
    result = np.zeros(len(factors.member_start) - 1)
    pair = 0
    for f in range(len(result)):
        nodes, at, mean, information, sensitivity = submap_of(offset, factors, f)
        hessian, _, _ = biased_normal(state, at, mean, information, sensitivity)
        row = 0
        for a in range(len(nodes)):
            size = offset[nodes[a] + 1] - offset[nodes[a]]
            column = 0
            for b in range(len(nodes)):
                other = offset[nodes[b] + 1] - offset[nodes[b]]
                if entry[pair] >= 0:
                    base = value_start[entry[pair]]
                    times = 1.0 if nodes[a] == nodes[b] else 2.0
                    for p in range(size):
                        for q in range(other):
                            result[f] += (
                                times * hessian[row + p, column + q] * inverse[base + p * other + q]
                            )
                pair += 1
                column += other
            row += size
        result[f] /= covariance_factor
    return result
