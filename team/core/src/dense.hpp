// Matrices of any size, row by row.
#pragma once

#include <cassert>
#include <cstddef>
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
  std::vector<double> numbers() && { return std::move(numbers_); }

 private:
  std::size_t rows_ = 0, columns_ = 0;
  std::vector<double> numbers_;
};

}  // namespace teamslam::dense
