#include "submap_factor.hpp"

namespace teamslam::graph {

namespace {

// Calls do_row with the row of each point's two numbers; headings are left out.
template <class F>
void each_point(const Submap& submap, F&& do_row) {
  const std::size_t of_poses = 3 * submap.poses();
  for (std::size_t row = 0; row < submap.size(); row += row < of_poses ? 3 : 2) do_row(row);
}

void turn(double& x, double& y, double c, double s) {
  const double a = x, b = y;
  x = c * a - s * b;
  y = s * a + c * b;
}

void turn_and_stretch(double& x, double& y, double c, double s, double stretch) {
  const double a = x, b = y;
  x = stretch * (c * a - s * b);
  y = stretch * (s * a + c * b);
}

// T P⁻¹ Tᵀ.
dense::Matrix rotated(const Submap& submap, double heading) {
  const auto [s, c] = elementary::sin_cos(heading);
  dense::Matrix metric = submap.information;
  const std::size_t n = submap.size();
  each_point(submap, [&](std::size_t row) {
    double *x = metric[row], *y = metric[row + 1];
    for (std::size_t k = 0; k < n; k++) turn(x[k], y[k], c, s);
  });
  for (std::size_t k = 0; k < n; k++)
    each_point(submap, [&, row_k = metric[k]](std::size_t row) { turn(row_k[row], row_k[row + 1], c, s); });
  return metric;
}

// A := A − A_·l (D⁻¹ + A_ll)⁻¹ A_l·, D = (1/w − 1) P_ll.
void discount(dense::Matrix& A, std::size_t at, const se2::Spread<double>& P, double weight) {
  const double share = weight / ((1.0 - weight) * (P.xx * P.yy - P.xy * P.xy));
  const double a = share * P.yy + A[at][at], b = A[at][at + 1] - share * P.xy;
  const double d = share * P.xx + A[at + 1][at + 1];
  const double determinant = a * d - b * b;
  const std::size_t n = A.rows();
  Numbers first(n), second(n);
  for (std::size_t i = 0; i < n; i++) {
    first[i] = A[i][at];
    second[i] = A[i][at + 1];
  }
  for (std::size_t i = 0; i < n; i++) {
    const double x = (d * first[i] - b * second[i]) / determinant;
    const double y = (a * second[i] - b * first[i]) / determinant;
    double* row = A[i];
    for (std::size_t j = 0; j < n; j++) row[j] -= x * first[j] + y * second[j];
  }
}

}  // namespace

Numbers Submap::shifted_mean(Values state, Indices at) const {
  Numbers shifted = mean;
  for (std::size_t b = 0; b < biases(); b++) {
    const double value = bias(state, at, b);
    for (std::size_t i = 0; i < size(); i++) shifted[i] += value * sensitivity[b][i];
    if (!curvature.rows()) continue;
    for (std::size_t i = 0; i < size(); i++) shifted[i] += 0.5 * value * value * curvature[b][i];
  }
  return shifted;
}

dense::Matrix Submap::sensitivity_at(Values state, Indices at) const {
  dense::Matrix rows = sensitivity;
  for (std::size_t b = 0; b < curvature.rows(); b++)
    for (std::size_t i = 0; i < size(); i++) rows[b][i] += bias(state, at, b) * curvature[b][i];
  return rows;
}

Residual Submap::residual_of(const Numbers& shifted, Values state, Indices at) const {
  const std::size_t start = at[0];
  const auto [s, c] = elementary::sin_cos(state[start + 2]);
  Residual found{Numbers(size()), std::vector<se2::Point<double>>(points())};
  for (std::size_t point = 0; point < points(); point++) {
    const std::size_t row = row_of(point), own = at[point + 1];
    const double x = state[own] - state[start], y = state[own + 1] - state[start + 1];
    found.from_start[point] = {x, y};
    found.numbers[row] = x - (c * shifted[row] - s * shifted[row + 1]);
    found.numbers[row + 1] = y - (s * shifted[row] + c * shifted[row + 1]);
    if (point < poses()) {
      const double turn = state[own + 2] - state[start + 2];
      found.numbers[row + 2] = se2::wrapped(turn - shifted[row + 2]);
    }
  }
  return found;
}

Residual Submap::residual(Values state, Indices at) const { return residual_of(shifted_mean(state, at), state, at); }

Normal Submap::unbiased_normal(const Numbers& shifted, Values state, Indices at) const {
  const std::size_t n = size();
  const Residual r = residual_of(shifted, state, at);
  const dense::Matrix metric = rotated(*this, state[at[0] + 2]);
  dense::Matrix jacobian(n, 3);  // of the start pose
  for (std::size_t point = 0; point < points(); point++) {
    const std::size_t row = row_of(point);
    jacobian[row][0] = -1.0;
    jacobian[row + 1][1] = -1.0;
    jacobian[row][2] = r.from_start[point].y;
    jacobian[row + 1][2] = -r.from_start[point].x;
    if (point < poses()) jacobian[row + 2][2] = -1.0;
  }
  Normal found{dense::Matrix(unknowns(), unknowns()), Numbers(unknowns()), 0.0};
  dense::Matrix& H = found.hessian;
  for (std::size_t i = 0; i < n; i++) {
    const double* M = metric[i];
    double total = 0.0;
    for (std::size_t j = 0; j < n; j++) total += M[j] * r.numbers[j];
    found.gradient[i + 3] = total;
    found.chi2 += r.numbers[i] * total;
    for (std::size_t j = 0; j < n; j++) H[i + 3][j + 3] = M[j];
    for (std::size_t a = 0; a < 3; a++) {
      const double by = jacobian[i][a];
      found.gradient[a] += by * total;
      double* row = H[a] + 3;
      for (std::size_t j = 0; j < n; j++) row[j] += by * M[j];
    }
  }
  for (std::size_t j = 0; j < n; j++)
    for (std::size_t a = 0; a < 3; a++) {
      H[j + 3][a] = H[a][j + 3];
      for (std::size_t b = 0; b < 3; b++) H[a][b] += H[a][j + 3] * jacobian[j][b];
    }
  return found;
}

Normal Submap::normal(Values state, Indices at) const {
  Normal found = unbiased_normal(shifted_mean(state, at), state, at);
  if (!biases()) return found;
  dense::Matrix& H = found.hessian;
  const std::size_t n = size(), first = n + 3;
  const auto [s, c] = elementary::sin_cos(state[at[0] + 2]);
  dense::Matrix turned = sensitivity_at(state, at);
  for (std::size_t b = 0; b < biases(); b++) {
    double* row = turned[b];
    each_point(*this, [&, s = s, c = c](std::size_t i) { turn(row[i], row[i + 1], c, s); });
    for (std::size_t j = 0; j < n; j++) found.gradient[first + b] -= row[j] * found.gradient[3 + j];
  }
  const dense::Matrix cross = dense::product(H.view().part(0, 3, first, n), dense::transposed(turned));
  for (std::size_t a = 0; a < first; a++)
    for (std::size_t b = 0; b < biases(); b++) H[a][first + b] = H[first + b][a] = -cross[a][b];
  const dense::Matrix own = dense::product(turned, cross.view().part(3, 0, n, biases()));
  for (std::size_t b = 0; b < biases(); b++)
    for (std::size_t other = 0; other < biases(); other++) H[first + other][first + b] = own[other][b];
  return found;
}

double Submap::chi2(Values state, Indices at) const {
  Numbers r = residual(state, at).numbers;
  const auto [s, c] = elementary::sin_cos(state[at[0] + 2]);
  each_point(*this, [&, s = s, c = c](std::size_t row) {
    const double a = r[row], b = r[row + 1];
    r[row] = c * a + s * b;
    r[row + 1] = -s * a + c * b;
  });
  double chi2 = 0.0;
  for (std::size_t i = 0; i < size(); i++) {
    const double* row = information[i];
    double total = 0.0;
    for (std::size_t j = 0; j < size(); j++) total += row[j] * r[j];
    chi2 += r[i] * total;
  }
  return chi2;
}

void Submap::landmark_chi2(Values state, Indices at, double factor, std::span<double> to) const {
  const Numbers r = residual(state, at).numbers;
  const auto [s, c] = elementary::sin_cos(state[at[0] + 2]);
  for (std::size_t l = 0; l < landmarks.size(); l++) {
    const std::size_t row = 3 * poses() + 2 * l;
    const double x = c * r[row] + s * r[row + 1], y = -s * r[row] + c * r[row + 1];
    const auto& [xx, xy, yy] = landmarks[l];
    const double determinant = (xx * yy - xy * xy) * factor;
    to[l] = (yy * x * x - 2.0 * xy * x * y + xx * y * y) / determinant;
  }
}

Submap Submap::at_joined_ranges(Values state, Indices at) const {
  Submap moved = *this;
  if (!is_measured) return moved;
  const std::size_t n = size(), start = at[0];
  const double viewpoints = double(poses() + 1);
  double x = 0.0, y = 0.0;
  for (std::size_t k = 0; k < poses(); k++) {
    x = x + mean[3 * k] / viewpoints;
    y = y + mean[3 * k + 1] / viewpoints;
  }
  const double heading = state[start + 2];
  const auto [s0, c0] = elementary::sin_cos(heading);
  const double x_map = state[start] + c0 * x - s0 * y, y_map = state[start + 1] + s0 * x + c0 * y;
  for (std::size_t l = 0; l < landmarks.size(); l++) {
    const std::size_t row = 3 * poses() + 2 * l, node = at[1 + poses() + l];
    const double own_x = mean[row] - x, own_y = mean[row + 1] - y;
    const double dx = state[node] - x_map, dy = state[node + 1] - y_map;
    const double own = elementary::hypot(own_x, own_y), joined = elementary::hypot(dx, dy);
    if (!(own > 0.0 && joined > 0.0)) continue;
    const double q = pack::min(pack::max(joined / own, 1.0 / LARGEST_RATIO), LARGEST_RATIO);
    double angle = se2::wrapped(elementary::atan2(dy, dx) - elementary::atan2(own_y, own_x) - heading);
    angle = pack::min(pack::max(angle, -LARGEST_TURN), LARGEST_TURN);
    const auto [s, c] = elementary::sin_cos(angle);
    const auto& [xx, xy, yy] = landmarks[l];
    const double across = 2.0 * c * s * xy;
    moved.landmarks[l] = {q * q * (c * c * xx + s * s * yy - across),
                          q * q * (c * s * (xx - yy) + (c * c - s * s) * xy),
                          q * q * (s * s * xx + c * c * yy + across)};
    double *upper = moved.information[row], *lower = moved.information[row + 1];
    for (std::size_t k = 0; k < n; k++) turn_and_stretch(upper[k], lower[k], c, s, 1.0 / q);
    for (std::size_t k = 0; k < n; k++)
      turn_and_stretch(moved.information[k][row], moved.information[k][row + 1], c, s, 1.0 / q);
    for (std::size_t b = 0; b < biases(); b++)
      if (range_power[b] != NO_POWER)
        for (dense::Matrix* each : {&moved.sensitivity, &moved.curvature})
          if (each->rows()) turn_and_stretch((*each)[b][row], (*each)[b][row + 1], c, s, range_power[b] ? q : 1.0);
  }
  return moved;
}

Submap Submap::discounted(Values weights) const {
  Submap result = *this;
  for (std::size_t l = 0; l < landmarks.size(); l++)
    if (weights[l] < 1.0) discount(result.information, 3 * poses() + 2 * l, landmarks[l], weights[l]);
  return result;
}

}  // namespace teamslam::graph
