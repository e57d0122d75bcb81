#include "dense.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

#include "product.hpp"

namespace teamslam::dense {

namespace {

// row −= factor · other.
void take(double* __restrict row, double factor, const double* __restrict other, std::size_t count) {
  for (std::size_t j = 0; j < count; j++) row[j] -= factor * other[j];
}

void divide(double* row, double by, std::size_t count) {
  for (std::size_t j = 0; j < count; j++) row[j] /= by;
}

}  // namespace

Matrix identity(std::size_t n) {
  Matrix made(n, n);
  for (std::size_t i = 0; i < n; i++) made[i][i] = 1.0;
  return made;
}

Matrix transposed(Const a) {
  Matrix made(a.columns, a.rows);
  for (std::size_t i = 0; i < a.rows; i++)
    for (std::size_t j = 0; j < a.columns; j++) made[j][i] = a[i][j];
  return made;
}

bool is_finite(Const a) {
  double lost[8] = {};  // 0 · x is no number where x is not finite
  for (std::size_t i = 0; i < a.rows; i++) {
    std::size_t j = 0;
    for (; j + 8 <= a.columns; j += 8)
      for (std::size_t lane = 0; lane < 8; lane++) lost[lane] += 0.0 * a[i][j + lane];
    for (; j < a.columns; j++) lost[0] += 0.0 * a[i][j];
  }
  return std::all_of(lost, lost + 8, [](double x) { return x == 0.0; });
}

double inner(std::span<const double> a, std::span<const double> b) {
  assert(a.size() == b.size());
  double l[8] = {}, rest = 0.0;
  const std::size_t n = a.size(), whole = n - n % 8;
  for (std::size_t i = 0; i < whole; i += 8)
    for (std::size_t j = 0; j < 8; j++) l[j] += a[i + j] * b[i + j];
  for (std::size_t i = whole; i < n; i++) rest += a[i] * b[i];
  return (((l[0] + l[4]) + (l[2] + l[6])) + ((l[1] + l[5]) + (l[3] + l[7]))) + rest;
}

std::vector<double> product(Const a, std::span<const double> x) {
  assert(a.columns == x.size());
  std::vector<double> sums(a.rows);
  const std::size_t whole = a.rows - a.rows % 8;
  for (std::size_t i = 0; i < whole; i += 8) {
    double s[8] = {};
    for (std::size_t p = 0; p < a.columns; p++)
      for (std::size_t r = 0; r < 8; r++) s[r] += a.data[(i + r) * a.stride + p] * x[p];
    std::copy(s, s + 8, &sums[i]);
  }
  for (std::size_t i = whole; i < a.rows; i++)
    for (std::size_t p = 0; p < a.columns; p++) sums[i] += a[i][p] * x[p];
  return sums;
}

Matrix product(Const a, Const b) {
  assert(a.columns == b.rows);
  Matrix c(a.rows, b.columns);
  multiply<Into::SET>(c.view(), by_rows(a), b);
  return c;
}

bool solve(View A, View B) {
  assert(A.rows == A.columns && B.rows == A.rows);
  const std::size_t n = A.rows, many = B.columns;
  for (std::size_t k = 0; k < n; k++) {
    std::size_t best = k;
    for (std::size_t i = k + 1; i < n; i++)
      if (std::fabs(A[i][k]) > std::fabs(A[best][k])) best = i;
    if (A[best][k] == 0.0) return false;
    if (best != k) {
      std::swap_ranges(A[k], A[k] + n, A[best]);
      std::swap_ranges(B[k], B[k] + many, B[best]);
    }
    for (std::size_t i = k + 1; i < n; i++) {
      const double factor = A[i][k] / A[k][k];
      if (factor == 0.0) continue;
      take(A[i] + k + 1, factor, A[k] + k + 1, n - k - 1);
      take(B[i], factor, B[k], many);
    }
  }
  for (std::size_t k = n; k-- > 0;) {
    divide(B[k], A[k][k], many);
    for (std::size_t i = 0; i < k; i++) take(B[i], A[i][k], B[k], many);
  }
  return true;
}

bool factor_upper(View U) {
  assert(U.rows == U.columns);
  const std::size_t n = U.rows;
  for (std::size_t begin = 0; begin < n; begin += BLOCK) {
    const std::size_t end = std::min(begin + BLOCK, n);
    for (std::size_t k = begin; k < end; k++) {
      const double pivot = U[k][k];
      if (!(pivot > 0.0 && pivot < std::numeric_limits<double>::infinity())) return false;
      divide(U[k] + k, std::sqrt(pivot), n - k);
      for (std::size_t later = k + 1; later < end; later++) take(U[later] + later, U[k][later], U[k] + later, n - later);
    }
    if (end < n) {
      const Const right = U.part(begin, end, end - begin, n - end);
      multiply<Into::SUBTRACT>(U.part(end, end, n - end, n - end), by_columns(right), right, {.is_upper = true});
    }
  }
  return true;
}

std::optional<Matrix> cholesky(Const A) {
  Matrix U = transposed(A);
  if (!factor_upper(U.view())) return {};
  Matrix L(A.rows, A.rows);
  for (std::size_t k = 0; k < A.rows; k++)
    for (std::size_t i = k; i < A.rows; i++) L[i][k] = U[k][i];
  return L;
}

void solve_lower(Const L, View right) {
  assert(L.rows == L.columns && right.rows == L.rows);
  const std::size_t n = right.rows, many = right.columns;
  if (many == 1) {
    for (std::size_t k = 0; k < n; k += 4) {  // four rows at once
      const std::size_t high = std::min<std::size_t>(4, n - k);
      const double* rows[4];
      double s[4];
      for (std::size_t r = 0; r < 4; r++) {
        rows[r] = L[k + std::min(r, high - 1)];
        s[r] = right[k + std::min(r, high - 1)][0];
      }
      for (std::size_t p = 0; p < k; p++)
        for (std::size_t r = 0; r < 4; r++) s[r] -= rows[r][p] * right[p][0];
      for (std::size_t r = 0; r < high; r++) {
        for (std::size_t p = 0; p < r; p++) s[r] -= rows[r][k + p] * s[p];
        right[k + r][0] = s[r] /= rows[r][k + r];
      }
    }
    return;
  }
  for (std::size_t begin = 0; begin < n; begin += BLOCK) {
    const std::size_t end = std::min(begin + BLOCK, n);
    if (begin > 0)
      multiply<Into::SUBTRACT>(right.part(begin, 0, end - begin, many), by_rows(L.part(begin, 0, end - begin, begin)),
                               right.part(0, 0, begin, many));
    for (std::size_t k = begin; k < end; k++) {
      for (std::size_t p = begin; p < k; p++) take(right[k], L[k][p], right[p], many);
      divide(right[k], L[k][k], many);
    }
  }
}

void solve_upper(Const L, View right) {
  assert(L.rows == L.columns && right.rows == L.rows);
  const std::size_t n = right.rows, many = right.columns;
  if (many == 1) {
    for (std::size_t k = n; k-- > 0;) {
      const double pivot = right[k][0] /= L[k][k];
      for (std::size_t p = 0; p < k; p++) right[p][0] -= L[k][p] * pivot;
    }
    return;
  }
  for (std::size_t begin = (n + BLOCK - 1) / BLOCK * BLOCK; begin > 0;) {
    begin -= BLOCK;
    const std::size_t end = std::min(begin + BLOCK, n);
    for (std::size_t k = end; k-- > begin;) {
      divide(right[k], L[k][k], many);
      for (std::size_t p = begin; p < k; p++) take(right[p], L[k][p], right[k], many);
    }
    if (begin > 0)
      multiply<Into::SUBTRACT>(right.part(0, 0, begin, many), by_columns(L.part(begin, 0, end - begin, begin)),
                               right.part(begin, 0, end - begin, many));
  }
}

Matrix inverse_from_factor(Const L) {
  assert(L.rows == L.columns);
  const std::size_t n = L.rows;
  Matrix R = identity(n);
  for (std::size_t begin = 0; begin < n; begin += BLOCK) {
    const std::size_t end = std::min(begin + BLOCK, n);
    if (begin > 0)
      multiply<Into::SUBTRACT>(R.view().part(begin, 0, end - begin, begin), by_rows(L.part(begin, 0, end - begin, begin)),
                               R.view().part(0, 0, begin, begin), {.is_lower = true});
    for (std::size_t k = begin; k < end; k++) {
      for (std::size_t p = begin; p < k; p++) take(R[k], L[k][p], R[p], p + 1);
      divide(R[k], L[k][k], k + 1);
    }
  }
  Matrix inverse(n, n);
  if (n < BLOCK) {
    for (std::size_t k = 0; k < n; k++)
      for (std::size_t i = 0; i <= k; i++)
        for (std::size_t j = i; j <= k; j++) inverse[i][j] += R[k][i] * R[k][j];
  } else {
    multiply<Into::SET>(inverse.view(), by_columns(R), R, {.is_upper = true, .is_lower = true});
  }
  for (std::size_t i = 0; i < n; i++)
    for (std::size_t j = 0; j < i; j++) inverse[i][j] = inverse[j][i];
  return inverse;
}

}  // namespace teamslam::dense
