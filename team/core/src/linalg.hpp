// Small dense algebra, every sum in the order of its index.
#pragma once

#include <cstddef>
#include <span>
#include <vector>

#include "dense.hpp"
#include "elementary.hpp"

namespace teamslam::linalg {

// A lower triangular 3 × 3 matrix.
struct Lower3 {
  double l00 = 0, l10 = 0, l11 = 0, l20 = 0, l21 = 0, l22 = 0;

  bool is_finite() const {
    for (const double x : {l00, l10, l11, l20, l21, l22})
      if (!std::isfinite(x)) return false;
    return true;
  }
};

// A 3 × 3 matrix.
struct Matrix3 {
  double entries[3][3];

  double* operator[](std::size_t i) { return entries[i]; }
  const double* operator[](std::size_t i) const { return entries[i]; }
  operator dense::Const() const { return {entries[0], 3, 3, 3}; }
};

inline constexpr double SMALLEST_VARIANCE = 1e-200;  // a variance of motion below it is zero [m², rad²]

// Lower L with L Lᵀ = C, of any rank; NaN where C is indefinite.
//
// A pivot within 1e-9 of its diagonal entry is rounding of zero: its column is zero, and rounding
// grows by 1e9 at most until the next pivot. So is one below SMALLEST_VARIANCE, whose quotients
// would not be finite. A pivot below −1e-6 of its diagonal entry means that C is indefinite.
inline Lower3 semidefinite_factor(std::span<const double, 9> C) {
  double L[3][3] = {};
  for (int j = 0; j < 3; j++) {
    double pivot = C[4 * j];
    for (int k = 0; k < j; k++) pivot -= L[j][k] * L[j][k];
    if (!(pivot >= -1e-6 * std::fabs(C[4 * j]))) {
      L[j][j] = elementary::NOT_A_NUMBER;
    } else if (pivot > pack::max(1e-9 * C[4 * j], SMALLEST_VARIANCE)) {
      L[j][j] = pack::sqrt(pivot);
      for (int i = j + 1; i < 3; i++) {
        double rest = C[3 * i + j];
        for (int k = 0; k < j; k++) rest -= L[i][k] * L[j][k];
        L[i][j] = rest / L[j][j];
      }
    }
  }
  return {L[0][0], L[1][0], L[1][1], L[2][0], L[2][1], L[2][2]};
}

// νᵀ S⁻¹ ν by the Cholesky factor of S, row by row; NaN where a pivot is not above rounding.
inline double normalised_square(std::span<const double> error, std::span<const double> S) {
  const std::size_t m = error.size();
  std::vector<double> L(m * m), white(m);
  double squares = 0.0;
  for (std::size_t j = 0; j < m; j++) {
    for (std::size_t k = 0; k < j; k++) {
      double rest = S[j * m + k];
      for (std::size_t i = 0; i < k; i++) rest -= L[j * m + i] * L[k * m + i];
      L[j * m + k] = rest / L[k * m + k];
    }
    double pivot = S[j * m + j], rest = error[j];
    for (std::size_t i = 0; i < j; i++) {
      pivot -= L[j * m + i] * L[j * m + i];
      rest -= L[j * m + i] * white[i];
    }
    if (!(pivot > double(m) * elementary::EPSILON * S[j * m + j])) return elementary::NOT_A_NUMBER;
    L[j * m + j] = pack::sqrt(pivot);
    white[j] = rest / L[j * m + j];
    squares += white[j] * white[j];
  }
  return squares;
}

// Σ values in NumPy's order: by halves down to 128 numbers, whose sums are in eight lanes.
inline double pairwise_sum(std::span<const double> x) {
  const std::size_t n = x.size();
  if (n > 128) {
    const std::size_t half = n / 2 - (n / 2) % 8;
    return pairwise_sum(x.first(half)) + pairwise_sum(x.subspan(half));
  }
  double lanes[8] = {};
  const std::size_t whole = n - n % 8;
  for (std::size_t i = 0; i < whole; i += 8)
    for (std::size_t j = 0; j < 8; j++) lanes[j] += x[i + j];
  double total = ((lanes[0] + lanes[1]) + (lanes[2] + lanes[3])) + ((lanes[4] + lanes[5]) + (lanes[6] + lanes[7]));
  for (std::size_t i = whole; i < n; i++) total += x[i];
  return total;
}

}  // namespace teamslam::linalg
