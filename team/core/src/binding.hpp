// What the bindings share: arrays from Python, checked once, and arrays to Python.
//
// nanobind checks type, dimensions and layout; it converts numbers, and copies where only the layout
// differs, but never converts ids, which would wrap. The functions here check lengths and finiteness.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/array.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>

#include <cmath>
#include <cstdint>
#include <span>
#include <string>
#include <vector>

#include "dense.hpp"

namespace nb = nanobind;
using namespace nb::literals;

// Numbers as an array of numpy.int64: nanobind makes one of "long long", which is another type to
// whatever looks at the type and not at its size.
struct Places {
  std::vector<std::int64_t> numbers;
};

template <>
struct nanobind::detail::type_caster<Places> {
  using Array = nb::ndarray<nb::numpy, std::int64_t, nb::ndim<1>, nb::c_contig>;
  NB_TYPE_CASTER(Places, make_caster<Array>::Name)

  static handle from_cpp(Places&& places, rv_policy, cleanup_list*) noexcept {
    auto* kept = new std::vector<std::int64_t>(std::move(places.numbers));
    capsule owner(kept, [](void* p) noexcept { delete static_cast<std::vector<std::int64_t>*>(p); });
    return nb::cast(Array(kept->data(), {kept->size()}, owner)).attr("view")("int64").release();
  }
};

namespace teamslam::binding {

// Arrays from Python, and arrays to Python.
using Numbers = nb::ndarray<const double, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Table = nb::ndarray<const double, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using Stack = nb::ndarray<const double, nb::ndim<3>, nb::c_contig, nb::device::cpu>;
using Triple = nb::ndarray<const double, nb::shape<3>, nb::c_contig, nb::device::cpu>;
using Matrix3 = nb::ndarray<const double, nb::shape<3, 3>, nb::c_contig, nb::device::cpu>;
using Ids = nb::ndarray<const std::uint32_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
template <class T, class Shape>
using Made = nb::ndarray<nb::numpy, T, Shape, nb::c_contig>;
using MadeNumbers = Made<double, nb::ndim<1>>;
using MadeTable = Made<double, nb::ndim<2>>;
using MadeStack = Made<double, nb::ndim<3>>;
using MadeIds = Made<std::uint32_t, nb::ndim<1>>;

// A number that has to be finite and is not.
struct NotFiniteError : std::domain_error {
  using std::domain_error::domain_error;
};

inline void check(bool is_right, const char* what) {
  if (!is_right) throw nb::value_error(what);
}

inline void check_finite(const double* from, std::size_t size, const char* name) {
  for (std::size_t i = 0; i < size; i++)
    if (!std::isfinite(from[i])) throw NotFiniteError(std::string(name) + " must be finite");
}

template <class Array>
std::span<const double> finite(const Array& array, const char* name) {
  check_finite(array.data(), array.size(), name);
  return {array.data(), array.size()};
}

template <class T, class Shape>
Made<T, Shape> made(std::vector<T>&& values, std::initializer_list<std::size_t> shape) {
  auto* kept = new std::vector<T>(std::move(values));
  nb::capsule owner(kept, [](void* p) noexcept { delete static_cast<std::vector<T>*>(p); });
  return Made<T, Shape>(kept->data(), shape, owner);
}

inline MadeNumbers made_numbers(std::vector<double>&& values) {
  const std::size_t n = values.size();
  return made<double, nb::ndim<1>>(std::move(values), {n});
}

inline dense::Const matrix_of(const Table& table) {
  return {table.data(), table.shape(0), table.shape(1), table.shape(1)};
}

inline MadeTable made_matrix(dense::Matrix&& matrix) {
  const std::size_t rows = matrix.rows(), columns = matrix.columns();
  return made<double, nb::ndim<2>>(std::move(matrix).numbers(), {rows, columns});
}

// One function for each file of bindings.
void bind_elementary(nb::module_& m);
void bind_maps(nb::module_& m);
void bind_window(nb::module_& m);

}  // namespace teamslam::binding
