// Matrices of any size, row by row, and their algebra: every sum in the order of its index.
//
// A BLAS sums in another order on another processor. Here a register holds different entries, never
// parts of one sum, so its width changes no bit.
#pragma once

#include <cassert>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <span>
#include <utility>
#include <vector>

namespace teamslam::dense {

// A matrix that is read, or a part of one: row i begins at data + i · stride.
struct Const {
  const double* data;
  std::size_t rows, columns, stride;

  const double* operator[](std::size_t i) const {
    assert(i < rows);
    return data + i * stride;
  }
  Const part(std::size_t top, std::size_t left, std::size_t height, std::size_t width) const {
    assert(top + height <= rows && left + width <= columns);
    return {data + top * stride + left, height, width, stride};
  }
};

// A matrix that is written, or a part of one.
struct View {
  double* data;
  std::size_t rows, columns, stride;

  double* operator[](std::size_t i) const {
    assert(i < rows);
    return data + i * stride;
  }
  operator Const() const { return {data, rows, columns, stride}; }
  View part(std::size_t top, std::size_t left, std::size_t height, std::size_t width) const {
    assert(top + height <= rows && left + width <= columns);
    return {data + top * stride + left, height, width, stride};
  }
};

// A matrix that holds its numbers.
class Matrix {
 public:
  Matrix() = default;
  Matrix(std::size_t rows, std::size_t columns) : rows_(rows), columns_(columns), numbers_(rows * columns) {}
  explicit Matrix(Const from) : Matrix(from.rows, from.columns) {
    for (std::size_t i = 0; i < rows_; i++)
      for (std::size_t j = 0; j < columns_; j++) numbers_[i * columns_ + j] = from[i][j];
  }

  std::size_t rows() const { return rows_; }
  std::size_t columns() const { return columns_; }
  double* operator[](std::size_t i) {
    assert(i < rows_);
    return numbers_.data() + i * columns_;
  }
  const double* operator[](std::size_t i) const {
    assert(i < rows_);
    return numbers_.data() + i * columns_;
  }
  View view() { return {numbers_.data(), rows_, columns_, columns_}; }
  Const view() const { return {numbers_.data(), rows_, columns_, columns_}; }
  operator Const() const { return view(); }
  std::vector<double>&& numbers() && { return std::move(numbers_); }

 private:
  std::size_t rows_ = 0, columns_ = 0;
  std::vector<double> numbers_;
};

inline constexpr std::size_t BLOCK = 32;  // columns factored or solved by loops, before a product takes them from the others

// A column, as a matrix.
inline Const column(std::span<const double> x) { return {x.data(), x.size(), 1, 1}; }
inline View column(std::span<double> x) { return {x.data(), x.size(), 1, 1}; }

Matrix identity(std::size_t n);
Matrix transposed(Const a);
bool is_finite(Const a);

// Σ aᵢ bᵢ in eight lanes, which are summed in pairs.
double inner(std::span<const double> a, std::span<const double> b);

// A x.
std::vector<double> product(Const a, std::span<const double> x);

// A B.
Matrix product(Const a, Const b);

// Which entries of a product are needed or read.
struct Shape {
  bool is_upper = false;       // only the upper triangle of the square A B is needed; some below it are written too
  bool is_lower = false;       // B is lower triangular, with zeros above
  bool is_left_upper = false;  // A is upper triangular, with zeros below
};

// B := A⁻¹ B by elimination with partial pivoting, A := what is left of it; false for a zero pivot.
[[nodiscard]] bool solve(View A, View B);

// The upper triangle of U := the factor R with Rᵀ R = U, of which the upper triangle is read; false
// where a pivot is not positive.
[[nodiscard]] bool factor_upper(View U);

// Lower L with L Lᵀ = A, from the lower triangle of A; none where A is not positive definite.
std::optional<Matrix> cholesky(Const A);

// right := L⁻¹ right, and L⁻ᵀ right.
void solve_lower(Const L, View right);
void solve_upper(Const L, View right);

// (L Lᵀ)⁻¹ = RᵀR, R = L⁻¹, exactly symmetric.
Matrix inverse_from_factor(Const L);

}  // namespace teamslam::dense
