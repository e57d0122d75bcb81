// Bindings of the functions with defined bits: of a number, or of each of an array of any shape.
#include "binding.hpp"
#include "elementary.hpp"
#include "se2.hpp"

namespace teamslam::binding {

namespace {

template <class F>
MadeArray each_of(const Array& x, F&& function) {
  std::vector<double> y(x.size());
  for (std::size_t i = 0; i < y.size(); i++) y[i] = function(x.data()[i]);
  return made_array(std::move(y), axes_of(x));
}

// In packs, with zeros behind the last number; both begin at a pack's first number.
template <class F>
void each_pack(std::vector<double>& x, F&& function) {
  const std::size_t n = x.size();
  x.resize(pack::padded(n));
  for (std::size_t i = 0; i < x.size(); i += pack::WIDTH) function(i, pack::load(&x[i]));
  x.resize(n);
}

template <class F>
void def_of_one(nb::module_& m, const char* name, F function, const char* argument, const char* doc) {
  m.def(name, [function](const Number& x) { return function(x.value); }, nb::arg(argument), doc);
  m.def(name, [function](const Array& x) { return each_of(x, function); }, nb::arg(argument));
}

// Of each pair of two arrays, or of an array and a number; as NumPy broadcasts them.
template <class F>
MadeArray each_of_both(std::span<const double> x, const Axes& of_x, std::span<const double> y, const Axes& of_y, F&& function) {
  std::vector<double> z;
  if (of_x == of_y) {
    for (std::size_t i = 0; i < x.size(); i++) z.push_back(function(x[i], y[i]));
    return made_array(std::move(z), of_x);
  }
  const Broadcast both(of_x, of_y);
  for (std::size_t i = 0; i < both.left.size(); i++) z.push_back(function(x[both.left[i]], y[both.right[i]]));
  return made_array(std::move(z), both.axes);
}

std::span<const double> numbers_of(const Array& x) { return {x.data(), x.size()}; }

template <class F>
void def_of_two(nb::module_& m, const char* name, F function, const char* first, const char* second, const char* doc) {
  const nb::arg one(first), other(second);
  m.def(name, [function](const Number& x, const Number& y) { return function(x.value, y.value); }, one, other, doc);
  m.def(
      name,
      [function](const Array& x, const Array& y) {
        return each_of_both(numbers_of(x), axes_of(x), numbers_of(y), axes_of(y), function);
      },
      one, other);
  m.def(
      name,
      [function](const Array& x, const Number& y) {
        return each_of_both(numbers_of(x), axes_of(x), {&y.value, 1}, {}, function);
      },
      one, other);
  m.def(
      name,
      [function](const Number& x, const Array& y) {
        return each_of_both({&x.value, 1}, {}, numbers_of(y), axes_of(y), function);
      },
      one, other);
}

using Both = std::tuple<MadeArray, MadeArray>;

Both sines_and_cosines(const Array& angles) {
  std::vector<double> sines(angles.size()), cosines(pack::padded(angles.size()));
  for (std::size_t i = 0; i < sines.size(); i++) sines[i] = elementary::near(angles.data()[i]);
  each_pack(sines, [&](std::size_t i, const pack::Pack& angle) {
    const auto [s, c] = elementary::sin_cos_near(angle);
    pack::store(&sines[i], s);
    pack::store(&cosines[i], c);
  });
  cosines.resize(sines.size());
  return {made_array(std::move(sines), axes_of(angles)), made_array(std::move(cosines), axes_of(angles))};
}

}  // namespace

void bind_elementary(nb::module_& m) {
  m.def(
      "sin_and_cos",
      [](const Number& angle) {
        const auto [s, c] = elementary::sin_cos(angle.value);
        return std::tuple(s, c);
      },
      "angle"_a, "Sine and cosine of an angle [rad], or of each of an array; NaN of what is not finite.");
  m.def("sin_and_cos", sines_and_cosines, "angle"_a);
  m.def("exp", [](const Number& x) { return elementary::exp(x.value); }, "x"_a,
        "E to the power of x, or of each of an array; 0 below -745.2, infinite above 709.8.");
  m.def(
      "exp",
      [](const Array& x) {
        std::vector<double> powers(x.data(), x.data() + x.size());
        each_pack(powers, [&](std::size_t i, const pack::Pack& each) { pack::store(&powers[i], elementary::exp(each)); });
        return made_array(std::move(powers), axes_of(x));
      },
      "x"_a);
  def_of_one(m, "sin", elementary::sin, "angle", "The sine of an angle [rad], or of each of an array.");
  def_of_one(m, "cos", elementary::cos, "angle", "The cosine of an angle [rad], or of each of an array.");
  def_of_one(m, "tan", elementary::tan, "angle", "The tangent of an angle [rad], or of each of an array.");
  def_of_one(m, "log", elementary::log, "x", "The natural logarithm of x, or of each of an array.");
  def_of_one(m, "log1p", elementary::log1p, "x", "The logarithm of 1 + x, or of that of each of an array.");
  def_of_one(m, "expm1", elementary::expm1, "x", "E to the power of x, less 1; x may be an array.");
  m.def("squared", [](const Number& x) { return x.value * x.value; }, "x"_a,
        "The square of x, or of each of an array: Python's `x**2` is the C library's `pow`.");
  m.def("squared", [](const Array::Any& x) { return nb::cast(x) * nb::cast(x); }, "x"_a,
        nb::sig("def squared(x: NDArray[numpy.float64]) -> NDArray[numpy.float64]"));
  def_of_one(m, "normal_below", elementary::normal_below, "x",
             "The probability that a standard normal variable stays below x, to 1e-15; x may be an array.");
  def_of_one(m, "wrapped", se2::wrapped<double>, "angle", "The same direction in (-pi, pi]; angle may be an array.");
  def_of_two(m, "atan2", elementary::atan2, "y", "x", "The direction of (x, y) in [-pi, pi]; both may be arrays.");
  def_of_two(m, "hypot", elementary::hypot, "x", "y", "The length of (x, y); both may be arrays.");
}

}  // namespace teamslam::binding
