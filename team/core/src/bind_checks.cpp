// Checks of the arrays in messages, given as their bytes: little-endian float64 or uint32.
//
// A refused array raises ValueError("reason: detail"). Symmetry and rank of a covariance are judged in
// units of its standard deviations, so that units and scale do not matter.
#include <algorithm>
#include <bit>
#include <cstring>

#include "binding.hpp"
#include "elementary.hpp"

namespace teamslam::binding {

namespace {

static_assert(std::endian::native == std::endian::little);

constexpr std::uint32_t UNNAMED = 1u << 31;  // landmark numbers from here on hold in one window only
constexpr std::size_t LARGEST_JOINT = 4096;  // rows of a covariance

[[noreturn]] void refuse(const char* reason, const std::string& detail) {
  throw nb::value_error((std::string(reason) + ": " + detail).c_str());
}

// The numbers in bytes, which need not be aligned.
template <class T>
struct Packed {
  const char* data;
  std::size_t count;

  Packed(const nb::bytes& bytes, const char* what) : data(bytes.c_str()), count(bytes.size() / sizeof(T)) {
    if (bytes.size() % sizeof(T))
      refuse("wrong length", std::string(what) + " has " + std::to_string(bytes.size()) + " bytes, not a multiple of " +
                                 std::to_string(sizeof(T)));
  }

  T operator[](std::size_t i) const {
    T number;
    std::memcpy(&number, data + i * sizeof(T), sizeof(T));
    return number;
  }
};

using Floats = Packed<double>;
using Count = std::optional<std::size_t>;

void check_count(std::size_t count, std::size_t expected, const char* what) {
  if (count != expected)
    refuse("wrong length", std::string(what) + " has " + std::to_string(count) + " numbers, " + std::to_string(expected) + " expected");
}

Floats finite_floats(const nb::bytes& data, const char* what, Count count) {
  const Floats values(data, what);
  if (count) check_count(values.count, *count, what);
  for (std::size_t i = 0; i < values.count; i++)
    if (!std::isfinite(values[i])) refuse("not finite", what);
  return values;
}

// float32, or float64 as in older logs.
void check_derivatives(const nb::bytes& data, std::size_t count, const char* what) {
  if (data.size() == sizeof(double) * count) {
    finite_floats(data, what, count);
    return;
  }
  const Packed<float> values(data, what);
  check_count(values.count, count, what);
  for (std::size_t i = 0; i < values.count; i++)
    if (!std::isfinite(values[i])) refuse("not finite", what);
}

void check_angles(const nb::bytes& data, const char* what, std::size_t count) {
  const Floats values = finite_floats(data, what, count);
  for (std::size_t i = 0; i < values.count; i++)
    if (std::fabs(values[i]) > elementary::PI) refuse("out of bounds", std::string(what) + " outside (−π, π]");
}

void check_ranges(const nb::bytes& data, const char* what, Count count) {
  const Floats values = finite_floats(data, what, count);
  for (std::size_t i = 0; i < values.count; i++)
    if (values[i] < 0.0) refuse("out of bounds", "a range is negative");
}

void check_named(const nb::bytes& data, const char* what) {
  const Packed<std::uint32_t> values(data, what);
  for (std::size_t i = 0; i < values.count; i++)
    if (values[i] >= UNNAMED)
      refuse("out of bounds", std::string(what) + " from 2³¹ on are of landmarks without identities");
}

void check_ascending(const nb::bytes& data, const char* what) {
  const Packed<std::uint32_t> values(data, what);
  for (std::size_t i = 1; i < values.count; i++)
    if (!(values[i - 1] < values[i])) refuse("not ascending", what);
}

double clipped(double value) { return value < -2.0 ? -2.0 : value > 2.0 ? 2.0 : value; }

// P / (σ_i σ_j), clipped: an entry beyond ±1 belongs to no covariance, and its square might overflow.
double scaled(double value, double sigma, double other) { return clipped(value / sigma / other); }

// Whether each pivot of a matrix with a unit diagonal, the upper triangle of U, exceeds n ε.
bool is_positive(dense::View U) {
  if (!dense::factor_upper(U)) return false;
  for (std::size_t i = 0; i < U.rows; i++)
    if (U[i][i] * U[i][i] <= double(U.rows) * elementary::EPSILON) return false;
  return true;
}

void check_pose_covariance(const nb::bytes& data, const char* what) {
  const Floats P = finite_floats(data, what, 9);
  double sigmas[3], U[9] = {};
  for (std::size_t i = 0; i < 3; i++) {
    if (!(P[4 * i] > 0.0)) refuse("not positive definite", what);
    sigmas[i] = pack::sqrt(P[4 * i]);
  }
  for (std::size_t i = 0; i < 3; i++) {
    U[4 * i] = 1.0;
    for (std::size_t j = i + 1; j < 3; j++) {
      U[3 * i + j] = scaled(P[3 * j + i], sigmas[i], sigmas[j]);
      if (std::fabs(U[3 * i + j] - scaled(P[3 * i + j], sigmas[j], sigmas[i])) > 1e-9) refuse("not symmetric", what);
    }
  }
  if (!is_positive({U, 3, 3, 3})) refuse("not positive definite", what);
}

void check_packed_covariance(const nb::bytes& data, std::size_t n, const char* what) {
  if (n > LARGEST_JOINT)
    refuse("too large",
           std::string(what) + " has " + std::to_string(n) + " rows, " + std::to_string(LARGEST_JOINT) + " at most");
  const Floats P = finite_floats(data, what, n * (n + 1) / 2);
  std::vector<double> sigmas(n);
  for (std::size_t i = 0, at = 0; i < n; at += n - i++) {
    if (!(P[at] > 0.0)) refuse("not positive definite", what);
    sigmas[i] = pack::sqrt(P[at]);
  }
  dense::Matrix U(n, n);
  for (std::size_t i = 0, at = 0; i < n; i++)
    for (std::size_t j = i; j < n; j++) U[i][j] = scaled(P[at++], sigmas[i], sigmas[j]);
  if (!is_positive(U.view())) refuse("not positive definite", what);
}

void check_blocks(const nb::bytes& data, std::size_t count, const char* what) {
  const Floats P = finite_floats(data, what, 3 * count);
  for (std::size_t i = 0; i < P.count; i += 3) {  // xx · yy could overflow
    const double root = pack::sqrt(pack::max(P[i], 0.0)) * pack::sqrt(pack::max(P[i + 2], 0.0));
    if (!(std::fabs(P[i + 1]) < root)) refuse("not positive definite", what);
  }
}

}  // namespace

void bind_checks(nb::module_& m) {
  m.def(
      "check_finite", [](const nb::bytes& data, const char* what, Count count) { finite_floats(data, what, count); },
      "data"_a, "what"_a, "count"_a = nb::none(), "Raise ValueError unless there are `count` float64, all finite.");
  m.def("check_derivatives", check_derivatives, "data"_a, "count"_a, "what"_a,
        "Raise ValueError unless there are `count` finite float32, or as many float64.");
  m.def("check_angles", check_angles, "data"_a, "what"_a, "count"_a,
        "Raise ValueError unless there are `count` angles in [-pi, pi].");
  m.def("check_ranges", check_ranges, "data"_a, "what"_a, "count"_a = nb::none(),
        "Raise ValueError unless there are `count` finite float64, none negative.");
  m.def("check_named", check_named, "data"_a, "what"_a,
        "Raise ValueError if an id is that of a landmark without identity, 2^31 or larger.\n\n"
        "A window assigns these numbers itself, so they would collide.");
  m.def("check_ascending", check_ascending, "data"_a, "what"_a,
        "Raise ValueError unless the ids are strictly ascending.");
  m.def("check_pose_covariance", check_pose_covariance, "data"_a, "what"_a,
        "Raise ValueError unless nine float64 form a symmetric positive definite 3 x 3 matrix.\n\n"
        "Symmetry is judged by the standard deviations, |P_ij - P_ji| <= 1e-9 sigma_i sigma_j; a pivot by the\n"
        "rounding error of a matrix with a unit diagonal.");
  m.def("check_packed_covariance", check_packed_covariance, "data"_a, "n"_a, "what"_a,
        "Raise ValueError unless a packed upper triangle is a positive definite n x n matrix.");
  m.def("check_blocks", check_blocks, "data"_a, "count"_a, "what"_a,
        "Raise ValueError unless there are `count` packed 2 x 2 covariances (3 float64 each).");
}

}  // namespace teamslam::binding
