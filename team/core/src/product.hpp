// Products of matrices: each entry adds its terms in the order of their index.
//
// A tile of four rows stays in registers over all terms. A register holds different entries, never
// parts of one sum, so neither its width nor the tiles change a bit.
#pragma once

#include <algorithm>
#include <cstring>

#include "dense.hpp"
#include "pack.hpp"

namespace teamslam::dense {

// The left factor of a product: entry (i, k) is at[i · row + k · column].
struct Left {
  const double* at;
  std::size_t row, column;
};

inline Left by_rows(Const a) { return {a.data, a.stride, 1}; }
inline Left by_columns(Const a) { return {a.data, 1, a.stride}; }  // of Aᵀ

// What becomes of C with the sum S = A B of each entry: C + S and C − S term by term, C − S as a whole, S.
enum class Into { ADD, SUBTRACT, SUBTRACT_SUM, SET };

using Register = pack::Numbers;

template <class T>
T load(const double* from) {
  T x;
  std::memcpy(&x, from, sizeof x);
  return x;
}

// R rows of a product, N registers T wide.
template <Into INTO, std::size_t R, class T, std::size_t N>
inline void multiply_tile(double* c, std::size_t c_stride, Left a, const double* b, std::size_t b_stride, std::size_t depth) {
  constexpr std::size_t LANES = sizeof(T) / sizeof(double);
  T sum[R][N];
  for (std::size_t r = 0; r < R; r++)
    for (std::size_t q = 0; q < N; q++)
      sum[r][q] = INTO == Into::ADD || INTO == Into::SUBTRACT ? load<T>(c + r * c_stride + q * LANES) : T{};
  for (std::size_t k = 0; k < depth; k++) {
    T right[N];
    for (std::size_t q = 0; q < N; q++) right[q] = load<T>(b + k * b_stride + q * LANES);
    for (std::size_t r = 0; r < R; r++) {
      const double left = a.at[r * a.row + k * a.column];
      for (std::size_t q = 0; q < N; q++) {
        if constexpr (INTO == Into::SUBTRACT)
          sum[r][q] -= left * right[q];
        else
          sum[r][q] += left * right[q];
      }
    }
  }
  for (std::size_t r = 0; r < R; r++)
    for (std::size_t q = 0; q < N; q++) {
      double* to = c + r * c_stride + q * LANES;
      const T entries = INTO == Into::SUBTRACT_SUM ? load<T>(to) - sum[r][q] : sum[r][q];
      std::memcpy(to, &entries, sizeof entries);
    }
}

// The columns of a product from `column` on that N registers hold. From some rows on the columns of B
// are copied first, to lie side by side.
template <Into INTO, class T, std::size_t N>
void multiply_columns(View c, Left a, Const b, Shape shape, std::size_t column, std::vector<double>& packed) {
  constexpr std::size_t LANES = N * sizeof(T) / sizeof(double), PACKED = 16;
  const std::size_t rows = shape.is_upper ? std::min(c.rows, column + LANES) : c.rows;
  const double* right = b.data + column;
  std::size_t stride = b.stride;
  if (rows >= PACKED) {
    packed.resize(b.rows * LANES);
    for (std::size_t k = 0; k < b.rows; k++) std::copy_n(right + k * stride, LANES, packed.data() + k * LANES);
    right = packed.data();
    stride = LANES;
  }
  for (std::size_t i = 0; i < rows; i += 4) {
    const std::size_t zeros = std::max(shape.is_left_upper ? i : 0, shape.is_lower ? column : 0);
    const std::size_t first = std::min(zeros, b.rows), depth = b.rows - first;
    const Left left{a.at + i * a.row + first * a.column, a.row, a.column};
    double* to = c.data + i * c.stride + column;
    const double* from = right + first * stride;
    switch (rows - i) {
      case 1: multiply_tile<INTO, 1, T, N>(to, c.stride, left, from, stride, depth); break;
      case 2: multiply_tile<INTO, 2, T, N>(to, c.stride, left, from, stride, depth); break;
      case 3: multiply_tile<INTO, 3, T, N>(to, c.stride, left, from, stride, depth); break;
      default: multiply_tile<INTO, 4, T, N>(to, c.stride, left, from, stride, depth);
    }
  }
}

// C and A B, where C overlaps neither A nor B.
template <Into INTO>
void multiply(View c, Left a, Const b, Shape shape = {}) {
  assert(c.columns == b.columns);
  constexpr std::size_t LANES = pack::IN_REGISTER;
  std::vector<double> packed;
  std::size_t column = 0;
  for (; column + 2 * LANES <= c.columns; column += 2 * LANES)
    multiply_columns<INTO, Register, 2>(c, a, b, shape, column, packed);
  if (column + LANES <= c.columns) {
    multiply_columns<INTO, Register, 1>(c, a, b, shape, column, packed);
    column += LANES;
  }
  for (; column < c.columns; column++) multiply_columns<INTO, double, 1>(c, a, b, shape, column, packed);
}

}  // namespace teamslam::dense
