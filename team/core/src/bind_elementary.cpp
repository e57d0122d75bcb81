// Bindings of the functions with defined bits: of a number, or of each of an array of any shape.
#include "binding.hpp"
#include "elementary.hpp"
#include "se2.hpp"

namespace teamslam::binding {

namespace {

// In packs, with zeros behind the last number; both begin at a pack's first number.
template <class F>
void each_pack(std::vector<double>& x, F&& function) {
  const std::size_t n = x.size();
  x.resize(pack::padded(n));
  for (std::size_t i = 0; i < x.size(); i += pack::WIDTH) function(i, pack::load(&x[i]));
  x.resize(n);
}

template <double (*function)(double)>
void def_of_one(nb::module_& m, const char* name, const char* argument, const char* doc) {
  m.def(name, [](const Number& x) { return function(x.value); }, nb::arg(argument), doc);
  m.def(
      name,
      [](const Array& x) {
        std::vector<double> y(x.size());
        for (std::size_t i = 0; i < y.size(); i++) y[i] = function(x.data()[i]);
        return made_array(std::move(y), axes_of(x));
      },
      nb::arg(argument));
}

// Numbers with the lengths of their axes: an array's, or one number.
struct Operand {
  std::span<const double> numbers;
  Axes axes;

  Operand(const Array& from) : numbers(from.data(), from.size()), axes(axes_of(from)) {}
  Operand(const Number& from) : numbers(&from.value, 1) {}
};

// Of each pair, as NumPy broadcasts them.
template <double (*function)(double, double)>
MadeArray each_of_both(const Operand& x, const Operand& y) {
  if (x.axes == y.axes) {
    std::vector<double> z(x.numbers.size());
    for (std::size_t i = 0; i < z.size(); i++) z[i] = function(x.numbers[i], y.numbers[i]);
    return made_array(std::move(z), x.axes);
  }
  const Broadcast both(x.axes, y.axes);
  std::vector<double> z(both.left.size());
  for (std::size_t i = 0; i < z.size(); i++) z[i] = function(x.numbers[both.left[i]], y.numbers[both.right[i]]);
  return made_array(std::move(z), both.axes);
}

template <double (*function)(double, double)>
void def_of_two(nb::module_& m, const char* name, const char* first, const char* second, const char* doc) {
  const nb::arg one(first), other(second);
  m.def(name, [](const Number& x, const Number& y) { return function(x.value, y.value); }, one, other, doc);
  m.def(name, [](const Array& x, const Array& y) { return each_of_both<function>(x, y); }, one, other);
  m.def(name, [](const Array& x, const Number& y) { return each_of_both<function>(x, y); }, one, other);
  m.def(name, [](const Number& x, const Array& y) { return each_of_both<function>(x, y); }, one, other);
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
      "angle"_a, "Sine and cosine of an angle [rad], or of each of an array; NaN unless finite.");
  m.def("sin_and_cos", sines_and_cosines, "angle"_a);
  m.def("exp", [](const Number& x) { return elementary::exp(x.value); }, "x"_a,
        "e^x, or of each of an array; 0 below -745.2, infinite above 709.8.");
  m.def(
      "exp",
      [](const Array& x) {
        std::vector<double> powers(x.data(), x.data() + x.size());
        each_pack(powers, [&](std::size_t i, const pack::Pack& each) { pack::store(&powers[i], elementary::exp(each)); });
        return made_array(std::move(powers), axes_of(x));
      },
      "x"_a);
  def_of_one<elementary::sin>(m, "sin", "angle", "Sine of an angle [rad], or of each of an array.");
  def_of_one<elementary::cos>(m, "cos", "angle", "Cosine of an angle [rad], or of each of an array.");
  def_of_one<elementary::tan>(m, "tan", "angle", "Tangent of an angle [rad], or of each of an array.");
  def_of_one<elementary::log>(m, "log", "x", "Natural logarithm of x, or of each of an array.");
  def_of_one<elementary::log1p>(m, "log1p", "x", "ln(1 + x); x may be an array.");
  def_of_one<elementary::expm1>(m, "expm1", "x", "e^x - 1; x may be an array.");
  m.def("squared", [](const Number& x) { return x.value * x.value; }, "x"_a,
        "x x; x may be an array. (Python's `x**2` is the C library's `pow`.)");
  m.def("squared", [](const Array::Any& x) { return nb::cast(x) * nb::cast(x); }, "x"_a,
        nb::sig("def squared(x: NDArray[numpy.float64]) -> NDArray[numpy.float64]"));
  def_of_one<elementary::normal_below>(m, "normal_below", "x",
             "Probability of a standard normal variable below x, to 1e-15; x may be an array.");
  def_of_one<se2::wrapped<double>>(m, "wrapped", "angle", "Wrap an angle to (-pi, pi]; it may be an array.");
  def_of_two<elementary::atan2>(m, "atan2", "y", "x", "Direction of (x, y) in [-pi, pi]; both may be arrays.");
  def_of_two<elementary::hypot>(m, "hypot", "x", "y", "Length of (x, y); both may be arrays.");
}

}  // namespace teamslam::binding
