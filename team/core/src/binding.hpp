// Shared by all bindings: arrays from Python, checked once, and arrays to Python.
//
// nanobind checks type, dimensions and layout; it converts numbers, and copies where only the layout
// differs, but never converts ids and indices, which would wrap. The functions here check lengths and
// finiteness. Vectors, spans, matrices and poses of the core are arguments and results themselves.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/array.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/shared_ptr.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <span>
#include <string>
#include <vector>

#include "dense.hpp"
#include "se2.hpp"

namespace nb = nanobind;
using namespace nb::literals;

// A number of Python: a float, an integer, one of NumPy's numbers; but no array, not even of one number.
struct Number {
  double value;
};

template <>
struct nanobind::detail::type_caster<Number> {
  NB_TYPE_CASTER(Number, const_name("float"))

  bool from_python(handle from, std::uint8_t, cleanup_list*) noexcept {
    if (!PyFloat_Check(from.ptr())) {
      const PyNumberMethods* of_number = Py_TYPE(from.ptr())->tp_as_number;
      if (!of_number || !of_number->nb_float || PySequence_Check(from.ptr())) return false;
    }
    value.value = PyFloat_AsDouble(from.ptr());
    if (value.value != -1.0 || !PyErr_Occurred()) return true;
    PyErr_Clear();
    return false;
  }
};

// An array of any shape, read row by row: one of another layout is copied, faster than by nanobind.
class Array {
 public:
  using Any = nb::ndarray<const double, nb::device::cpu>;

  Array() = default;
  explicit Array(Any&& from) : held_(std::move(from)), data_(held_.data()) {
    std::int64_t step = 1;
    bool is_in_order = true;
    for (std::size_t i = ndim(); i-- > 0; step *= std::int64_t(shape(i)))
      is_in_order = is_in_order && (shape(i) == 1 || held_.stride(i) == step);
    if (is_in_order || size() == 0) return;
    copied_.reserve(size());
    copy(0, held_.data());
    data_ = copied_.data();
  }

  const double* data() const { return data_; }
  std::size_t size() const { return held_.size(); }
  std::size_t ndim() const { return held_.ndim(); }
  std::size_t shape(std::size_t i) const { return held_.shape(i); }

 private:
  void copy(std::size_t axis, const double* from) {
    if (axis == ndim()) return copied_.push_back(*from);
    for (std::size_t i = 0; i < shape(axis); i++) copy(axis + 1, from + std::int64_t(i) * held_.stride(axis));
  }

  Any held_;
  std::vector<double> copied_;
  const double* data_ = nullptr;
};

template <>
struct nanobind::detail::type_caster<Array> {
  NB_TYPE_CASTER(Array, make_caster<Array::Any>::Name)

  bool from_python(handle from, std::uint8_t flags, cleanup_list* cleanup) noexcept {
    make_caster<Array::Any> caster;
    if (!caster.from_python(from, flags, cleanup)) return false;
    value = Array(std::move(caster.value));
    return true;
  }
};

namespace teamslam::binding {

// Arrays from Python, and arrays to Python.
using Numbers = nb::ndarray<const double, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Table = nb::ndarray<const double, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using Stack = nb::ndarray<const double, nb::ndim<3>, nb::c_contig, nb::device::cpu>;
using Ids = nb::ndarray<const std::uint32_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
template <class T, class Shape>
using Made = nb::ndarray<nb::numpy, T, Shape, nb::c_contig>;
using MadeArray = nb::ndarray<nb::numpy, double, nb::c_contig>;
using MadeNumbers = Made<double, nb::ndim<1>>;
using MadeTable = Made<double, nb::ndim<2>>;
using MadeStack = Made<double, nb::ndim<3>>;
using MadeIds = Made<std::uint32_t, nb::ndim<1>>;

// Numbers as an array of numpy.int64.
struct Places {
  std::vector<std::int64_t> numbers;
};

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

// Lengths of an array's axes.
using Axes = std::vector<std::size_t>;

template <class Any>
Axes axes_of(const Any& array) {
  Axes axes(array.ndim());
  for (std::size_t i = 0; i < axes.size(); i++) axes[i] = array.shape(i);
  return axes;
}

inline std::size_t product_of(std::span<const std::size_t> axes) {
  std::size_t count = 1;
  for (const std::size_t each : axes) count *= each;
  return count;
}

inline MadeArray made_array(std::vector<double>&& values, const Axes& axes) {
  auto* kept = new std::vector<double>(std::move(values));
  nb::capsule owner(kept, [](void* p) noexcept { delete static_cast<std::vector<double>*>(p); });
  return MadeArray(kept->data(), axes.size(), axes.data(), owner);
}

// Two shapes broadcast against each other, as by NumPy: the common shape, and the place in either
// array of each of its entries.
struct Broadcast {
  Axes axes;
  std::vector<std::size_t> left, right;

  Broadcast(std::span<const std::size_t> a, std::span<const std::size_t> b) : axes(std::max(a.size(), b.size())) {
    const std::size_t n = axes.size();
    std::vector<std::size_t> of_a(n), of_b(n), at(n);  // steps; 0 along an axis that is repeated
    std::size_t step_a = 1, step_b = 1;
    for (std::size_t back = 1; back <= n; back++) {
      const std::size_t i = n - back;
      const std::size_t in_a = back <= a.size() ? a[a.size() - back] : 1, in_b = back <= b.size() ? b[b.size() - back] : 1;
      check(in_a == in_b || in_a == 1 || in_b == 1, "the shapes do not fit each other");
      axes[i] = in_a == 1 ? in_b : in_a;
      if (in_a != 1) of_a[i] = step_a;
      if (in_b != 1) of_b[i] = step_b;
      step_a *= in_a;
      step_b *= in_b;
    }
    const std::size_t count = product_of(axes);
    std::size_t in_a = 0, in_b = 0;
    left.reserve(count);
    right.reserve(count);
    for (std::size_t k = 0; k < count; k++) {
      left.push_back(in_a);
      right.push_back(in_b);
      for (std::size_t i = n; i-- > 0;) {
        in_a += of_a[i];
        in_b += of_b[i];
        if (++at[i] < axes[i]) break;
        in_a -= of_a[i] * axes[i];
        in_b -= of_b[i] * axes[i];
        at[i] = 0;
      }
    }
  }
};

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

// The core's types as arrays: `set` gives a value the numbers of an array, `array_of` makes an array.
template <class T, class Given>
void set(std::vector<T>& to, const Given& from) {
  to.assign(from.data(), from.data() + from.size());
}
template <class T, class Given>
void set(std::span<const T>& to, const Given& from) {
  to = {from.data(), from.size()};
}
template <class Given>
void set(dense::Matrix& to, const Given& from) {
  to = dense::Matrix(matrix_of(from));
}
template <class Given>
void set(linalg::Matrix3& to, const Given& from) {
  std::copy_n(from.data(), 9, to.entries[0]);
}
template <class Given>
void set(se2::Pose<double>& to, const Given& from) {
  to = {from(0), from(1), from(2)};
}
template <class Given>
void set(se2::Motion& to, const Given& from) {
  to = {from(0), from(1), from(2)};
}
template <class Given>
void set(se2::Point<double>& to, const Given& from) {
  to = {from(0), from(1)};
}

inline nb::object array_of(std::vector<double>&& from) { return nb::cast(made_numbers(std::move(from))); }
// nanobind's own array of integers is of "long long", which is another type to whatever looks at the
// type and not at its size.
inline nb::object array_of(std::vector<std::int64_t>&& from) {
  const std::size_t n = from.size();
  return nb::cast(made<std::int64_t, nb::ndim<1>>(std::move(from), {n})).attr("view")("int64");
}
inline nb::object array_of(Places&& from) { return array_of(std::move(from.numbers)); }
inline nb::object array_of(std::span<const std::int64_t> from) {
  return array_of(std::vector<std::int64_t>(from.begin(), from.end()));
}
inline nb::object array_of(std::vector<bool>&& from) {
  const std::size_t n = from.size();
  auto* kept = new bool[n];
  std::copy(from.begin(), from.end(), kept);
  nb::capsule owner(kept, [](void* p) noexcept { delete[] static_cast<bool*>(p); });
  return nb::cast(Made<bool, nb::ndim<1>>(kept, {n}, owner));
}
inline nb::object array_of(dense::Matrix&& from) { return nb::cast(made_matrix(std::move(from))); }
inline nb::object array_of(const linalg::Matrix3& from) { return array_of(dense::Matrix(from)); }
inline nb::object array_of(const se2::Pose<double>& from) { return array_of(std::vector{from.x, from.y, from.heading}); }
inline nb::object array_of(const se2::Motion& from) { return array_of(std::vector{from.forward, from.left, from.turn}); }
inline nb::object array_of(const se2::Point<double>& from) { return array_of(std::vector{from.x, from.y}); }

}  // namespace teamslam::binding

namespace nanobind::detail {

// A type of the core that is an array of T in Python.
template <class V, class T, class Shape>
struct ArrayCaster {
  using Given = ndarray<const T, Shape, c_contig, device::cpu>;
  NB_TYPE_CASTER(V, make_caster<Given>::Name)

  bool from_python(handle from, std::uint32_t flags, cleanup_list* cleanup) noexcept {
    if (!std::is_same_v<T, double>) flags &= ~std::uint32_t(cast_flags::convert);
    make_caster<Given> caster;
    if (!caster.from_python(from, flags, cleanup) || !caster.value.is_valid()) return false;  // None is no array
    given_ = std::move(caster.value);
    teamslam::binding::set(value, given_);
    return true;
  }

  template <class From>
  static handle from_cpp(From&& from, rv_policy, cleanup_list*) noexcept {
    return teamslam::binding::array_of(V(std::forward<From>(from))).release();
  }

 private:
  Given given_;  // what a span refers to
};

template <class T>
using VectorCaster = ArrayCaster<std::vector<T>, T, ndim<1>>;
template <class T>
using SpanCaster = ArrayCaster<std::span<const T>, T, ndim<1>>;

template <>
struct type_caster<std::vector<double>> : VectorCaster<double> {};
template <>
struct type_caster<std::vector<std::int64_t>> : VectorCaster<std::int64_t> {};
template <>
struct type_caster<std::vector<bool>> : VectorCaster<bool> {};
template <>
struct type_caster<std::span<const double>> : SpanCaster<double> {};
template <>
struct type_caster<std::span<const std::int64_t>> : SpanCaster<std::int64_t> {};
template <>
struct type_caster<teamslam::binding::Places> : ArrayCaster<teamslam::binding::Places, std::int64_t, ndim<1>> {};
template <>
struct type_caster<teamslam::dense::Matrix> : ArrayCaster<teamslam::dense::Matrix, double, ndim<2>> {};
template <>
struct type_caster<teamslam::linalg::Matrix3> : ArrayCaster<teamslam::linalg::Matrix3, double, shape<3, 3>> {};
template <>
struct type_caster<teamslam::se2::Pose<double>> : ArrayCaster<teamslam::se2::Pose<double>, double, shape<3>> {};
template <>
struct type_caster<teamslam::se2::Motion> : ArrayCaster<teamslam::se2::Motion, double, shape<3>> {};
template <>
struct type_caster<teamslam::se2::Point<double>> : ArrayCaster<teamslam::se2::Point<double>, double, shape<2>> {};

}  // namespace nanobind::detail

namespace teamslam::binding {

// One function for each file of bindings.
void bind_checks(nb::module_& m);
void bind_consensus(nb::module_& m);
void bind_dense(nb::module_& m);
void bind_elementary(nb::module_& m);
void bind_graph(nb::module_& m);
void bind_maps(nb::module_& m);
void bind_models(nb::module_& m);
void bind_motion(nb::module_& m);
void bind_se2(nb::module_& m);
void bind_segmenter(nb::module_& m);
void bind_sparse(nb::module_& m);
void bind_random(nb::module_& m);
void bind_window(nb::module_& m);

}  // namespace teamslam::binding
