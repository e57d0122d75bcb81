// Bindings of SE(2): a pose is (x [m], y [m], heading [rad]), an array of three numbers.
#include "binding.hpp"

namespace teamslam::binding {

namespace {

using se2::Pose;

MadeArray compose(const Pose<double>& a_from_b, const Array& b_from_c) {
  check((b_from_c.ndim() == 1 || b_from_c.ndim() == 2) && b_from_c.shape(b_from_c.ndim() - 1) == 3,
        "poses must have three numbers each");
  std::vector<double> composed;
  composed.reserve(b_from_c.size());
  for (const double* at = b_from_c.data(); composed.size() < b_from_c.size(); at += 3) {
    const auto [x, y, heading] = se2::compose(a_from_b, Pose<double>{at[0], at[1], at[2]});
    composed.insert(composed.end(), {x, y, heading});
  }
  return made_array(std::move(composed), axes_of(b_from_c));
}

nb::bytes bytes_of(std::span<const double> numbers) { return nb::bytes(numbers.data(), numbers.size_bytes()); }

}  // namespace

void bind_se2(nb::module_& m) {
  m.def("compose", compose, "a_from_b"_a, "b_from_c"_a, "a_from_c = a_from_b o b_from_c, or that of each row of b_from_c.");
  m.def("inverse", se2::inverse, "a_from_b"_a, "b_from_a.");
  m.def("between", se2::between, "a_from_b"_a, "a_from_c"_a,
        "b_from_c = a_from_b^-1 o a_from_c: the motion from b to c, seen in b.");
  m.def("transformed", se2::transformed, "a_from_b"_a, "point_in_b"_a, "Return the point's coordinates in frame a.");
  m.def("exponential", se2::exponential, "xi"_a,
        "Exp: R^3 -> SE(2), the motion at the constant twist xi = (forward, left, turn) for unit time.");
  m.def("logarithm", se2::logarithm, "pose"_a, "Log: SE(2) -> R^3, the inverse of `exponential` for |heading| < pi.");
  m.def("adjoint", se2::adjoint, "a_from_b"_a,
        "Ad with T o Exp(xi) = Exp(Ad_T xi) o T: carries a perturbation from the right to the left.");
  m.def("tangent", se2::tangent, "heading"_a, "d(x, y, heading)/d(xi) of pose o Exp(xi) for a pose of this heading.");
  m.def(
      "pose_bytes",
      [](const Pose<double>& mean, const linalg::Matrix3& P) {
        const std::array numbers{mean.x, mean.y, mean.heading};
        std::array<double, 9> symmetric;
        for (std::size_t i = 0; i < 3; i++)
          for (std::size_t j = 0; j < 3; j++) symmetric[3 * i + j] = 0.5 * (P[i][j] + P[j][i]);
        return std::tuple(bytes_of(numbers), bytes_of(symmetric));
      },
      "mean"_a, "covariance"_a, "Encode a pose and its covariance, made exactly symmetric, as float64 for a message.");
}

}  // namespace teamslam::binding
