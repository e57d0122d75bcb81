#include "arrow.hpp"

#include <algorithm>

namespace teamslam::window {

namespace {

// From columns begin … end − 1 of a row its multiple of another.
void take(double* row, double factor, const double* other, std::size_t begin, std::size_t end) {
  for (std::size_t j = begin; j < end; j++) row[j] -= factor * other[j];
}

// From columns begin … end − 1 of a row the multiples of three rows by their column `later`.
void take_three(double* __restrict row, const double* a, const double* b, const double* c, std::size_t later,
                std::size_t begin, std::size_t end) {
  const double of_a = a[later], of_b = b[later], of_c = c[later];
  for (std::size_t j = begin; j < end; j++) row[j] = ((row[j] - of_a * a[j]) - of_b * b[j]) - of_c * c[j];
}

// Divides row k by the root of its pivot, up to column `near` and from `behind` on; whether the pivot
// is positive.
bool divide(dense::View U, std::size_t k, std::size_t near, std::size_t behind) {
  double* row = U[k];
  if (!(row[k] > 0.0 && row[k] < elementary::INF)) return false;
  const double root = pack::sqrt(row[k]);
  for (std::size_t i = k; i < near; i++) row[i] /= root;
  for (std::size_t i = behind; i < U.rows; i++) row[i] /= root;
  return true;
}

// The upper triangle := the factor's transpose, `chain` unknowns of which are poses'; whether each
// pivot is positive.
bool factor(dense::View U, std::size_t chain) {
  const std::size_t n = U.rows;
  for (std::size_t pose = 0; pose < chain; pose += 3) {
    const std::size_t near = std::min(pose + 6, chain);
    for (std::size_t k = pose; k < pose + 3; k++) {
      if (!divide(U, k, near, chain)) return false;
      for (std::size_t later = k + 1; later < pose + 3; later++) {
        take(U[later], U[k][later], U[k], later, near);
        take(U[later], U[k][later], U[k], chain, n);
      }
    }
    const double *a = U[pose], *b = U[pose + 1], *c = U[pose + 2];
    for (std::size_t later = pose + 3; later < near; later++) {
      take_three(U[later], a, b, c, later, later, near);
      take_three(U[later], a, b, c, later, chain, n);
    }
    for (std::size_t later = chain; later < n; later++)
      if (a[later] != 0.0 || b[later] != 0.0 || c[later] != 0.0) take_three(U[later], a, b, c, later, later, n);
  }
  for (std::size_t k = chain; k < n; k++) {
    if (!divide(U, k, k, k)) return false;
    for (std::size_t later = k + 1; later < n; later++) take(U[later], U[k][later], U[k], later, n);
  }
  return true;
}

// The first unknown that A or its factor connects with unknown k.
std::size_t first(std::size_t k, std::size_t chain) { return k >= chain || k < 6 ? 0 : k - k % 3 - 3; }

// Row i of B less `factor` times row k.
void take_row(dense::View B, std::size_t i, double factor, std::size_t k) {
  if (factor != 0.0) take(B[i], factor, B[k], 0, B.columns);
}

void divide_row(dense::View B, std::size_t k, double by) {
  for (std::size_t j = 0; j < B.columns; j++) B[k][j] /= by;
}

// B := U⁻¹ U⁻ᵀ B.
void solve(dense::Const U, dense::View B, std::size_t chain) {
  const std::size_t n = U.rows;
  for (std::size_t k = 0; k < n; k++) {
    for (std::size_t p = first(k, chain); p < k; p++) take_row(B, k, U[p][k], p);
    divide_row(B, k, U[k][k]);
  }
  for (std::size_t end = n; end > 0;) {
    const std::size_t begin = (end - 1) / dense::BLOCK * dense::BLOCK;
    for (std::size_t k = end; k-- > begin;) {
      divide_row(B, k, U[k][k]);
      for (std::size_t p = std::max(begin, first(k, chain)); p < k; p++) take_row(B, p, U[p][k], k);
    }
    for (std::size_t k = begin; k < end; k++)
      for (std::size_t p = first(k, chain); p < begin; p++) take_row(B, p, U[p][k], k);
    end = begin;
  }
}

}  // namespace

std::optional<Matrix3> metric_of(Matrix3 C, const double (&jitter)[3]) {
  Matrix3 metric{{{1.0, 0.0, 0.0}, {0.0, 1.0, 0.0}, {0.0, 0.0, 1.0}}};
  for (std::size_t i = 0; i < 3; i++) C[i][i] += jitter[i];
  if (!dense::solve({C[0], 3, 3, 3}, {metric[0], 3, 3, 3})) return std::nullopt;
  return metric;
}

void add_motion(dense::View A, dense::View B, std::size_t column, std::size_t k, const Pose<double>& before,
                const Pose<double>& after, const Matrix3& W, const std::array<double, 3>& r) {
  const Matrix3 Ad = se2::adjoint(se2::between(after, before));
  double J[3][6] = {};
  for (std::size_t i = 0; i < 3; i++) {
    for (std::size_t j = 0; j < 3; j++) J[i][j] = -Ad[i][j];
    J[i][3 + i] = 1.0;
  }
  const std::size_t skipped = k ? 0 : 3, at = 3 * k - 3;  // J[·][i] is of unknown at + i
  for (std::size_t i = skipped; i < 6; i++) {
    double weighted[3] = {};
    for (std::size_t a = 0; a < 3; a++)
      for (std::size_t b = 0; b < 3; b++) weighted[b] += J[a][i] * W[a][b];
    for (std::size_t b = 0; b < 3; b++) B[at + i][column] += weighted[b] * r[b];
    for (std::size_t j = skipped; j < 6; j++)
      for (std::size_t b = 0; b < 3; b++) A[at + i][at + j] += weighted[b] * J[b][j];
  }
}

Fault solve_arrow(dense::Const A, dense::View B, std::size_t poses) {
  const std::size_t n = A.rows;
  std::vector<double> sigmas(n);
  if (const Fault fault = gaussian::fault_of(A, sigmas); fault != Fault::NONE) return fault;
  dense::Matrix U = dense::transposed(A);
  if (!factor(U.view(), 3 * poses)) return Fault::NOT_POSITIVE;
  for (std::size_t i = 0; i < n; i++) {
    const double pivot = U[i][i] / sigmas[i];
    if (pivot * pivot <= double(n) * elementary::EPSILON) return Fault::NOT_POSITIVE;
  }
  solve(U.view(), B, 3 * poses);
  return Fault::NONE;
}

}  // namespace teamslam::window
