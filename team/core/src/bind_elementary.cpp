// Bindings of the functions with defined bits.
#include "binding.hpp"
#include "elementary.hpp"

namespace teamslam::binding {

namespace {

template <class F>
MadeNumbers each_of(const Numbers& x, F&& function) {
  std::vector<double> y(x.size());
  for (std::size_t i = 0; i < y.size(); i++) y[i] = function(x(i));
  return made_numbers(std::move(y));
}

template <class F>
MadeNumbers each_of_both(const Numbers& x, const Numbers& y, F&& function) {
  check(x.size() == y.size(), "both arrays must have one length");
  std::vector<double> z(x.size());
  for (std::size_t i = 0; i < z.size(); i++) z[i] = function(x(i), y(i));
  return made_numbers(std::move(z));
}

// In packs, with zeros behind the last number.
template <class F>
void each_pack(std::vector<double>& x, F&& function) {
  const std::size_t n = x.size();
  x.resize(pack::padded(n));
  for (std::size_t i = 0; i < x.size(); i += pack::WIDTH) function(i, pack::load(&x[i]));
  x.resize(n);
}

}  // namespace

void bind_elementary(nb::module_& m) {
  m.def(
      "sin_and_cos",
      [](const Numbers& angles) {
        std::vector<double> sines(angles.size()), cosines(pack::padded(angles.size()));
        for (std::size_t i = 0; i < sines.size(); i++) sines[i] = elementary::near(angles(i));
        each_pack(sines, [&](std::size_t i, const pack::Pack& angle) {
          const auto [s, c] = elementary::sin_cos_near(angle);
          pack::store(&sines[i], s);
          pack::store(&cosines[i], c);
        });
        cosines.resize(sines.size());
        return std::tuple(made_numbers(std::move(sines)), made_numbers(std::move(cosines)));
      },
      "angles"_a, "Sine and cosine of each angle [rad]; NaN of what is not finite.");
  m.def(
      "exp",
      [](const Numbers& x) {
        std::vector<double> powers(x.data(), x.data() + x.size());
        each_pack(powers, [&](std::size_t i, const pack::Pack& each) { pack::store(&powers[i], elementary::exp(each)); });
        return made_numbers(std::move(powers));
      },
      "x"_a, "E to the power of each x; 0 below -745.2, infinite above 709.8.");
  m.def("log", [](const Numbers& x) { return each_of(x, elementary::log); }, "x"_a, "The natural logarithm of each x.");
  m.def("log1p", [](const Numbers& x) { return each_of(x, elementary::log1p); }, "x"_a, "The logarithm of each 1 + x.");
  m.def("expm1", [](const Numbers& x) { return each_of(x, elementary::expm1); }, "x"_a, "E to the power of each x, less 1.");
  m.def(
      "normal_below", [](const Numbers& x) { return each_of(x, elementary::normal_below); }, "x"_a,
      "The probability that a standard normal variable stays below each x, to 1e-15.");
  m.def("atan2", [](const Numbers& y, const Numbers& x) { return each_of_both(y, x, elementary::atan2); }, "y"_a, "x"_a,
        "The direction of each (x, y) in [-pi, pi].");
  m.def("hypot", [](const Numbers& x, const Numbers& y) { return each_of_both(x, y, elementary::hypot); }, "x"_a, "y"_a,
        "The length of each (x, y).");
}

}  // namespace teamslam::binding
