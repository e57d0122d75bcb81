// Rows of numbers, one for each particle: a quantity of all particles is contiguous.
#pragma once

#include <cassert>
#include <span>
#include <vector>

#include "pack.hpp"

namespace teamslam::window {

// Rows of `count` numbers, padded to whole multiples of LANES; lanes behind the last repeat it.
class Rows {
 public:
  explicit Rows(std::size_t count, std::size_t rows = 0)
      : count_(count), stride_(pack::padded(count)), data_(rows * stride_) {}

  std::size_t count() const { return count_; }
  std::size_t stride() const { return stride_; }
  std::size_t rows() const { return data_.size() / stride_; }
  double* operator[](std::size_t row) {
    assert(row < rows());
    return data_.data() + row * stride_;
  }
  const double* operator[](std::size_t row) const {
    assert(row < rows());
    return data_.data() + row * stride_;
  }
  // The row without its padding.
  std::span<const double> numbers(std::size_t row) const { return {(*this)[row], count_}; }

  void resize(std::size_t rows) { data_.resize(rows * stride_); }
  void append(const Rows& others) {
    assert(others.stride_ == stride_);
    data_.insert(data_.end(), others.data_.begin(), others.data_.end());
  }
  // Writes values[0], values[step], … into a row.
  void set(std::size_t row, const double* values, std::size_t step) {
    double* to = (*this)[row];
    for (std::size_t i = 0; i < stride_; i++) to[i] = values[step * (i < count_ ? i : count_ - 1)];
  }
  // Replaces each number of each row by that of its parent; parents are padded as the rows are.
  void copy_from(std::span<const std::size_t> parents) {
    assert(parents.size() == stride_);
    std::vector<double> copied(stride_);
    for (std::size_t row = 0; row < rows(); row++) {
      double* numbers = (*this)[row];
      for (std::size_t i = 0; i < stride_; i++) copied[i] = numbers[parents[i]];
      std::memcpy(numbers, copied.data(), stride_ * sizeof(double));
    }
  }

 private:
  std::size_t count_, stride_;
  std::vector<double> data_;
};

}  // namespace teamslam::window
