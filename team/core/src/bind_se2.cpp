// Bindings of SE(2): a pose is (x [m], y [m], heading [rad]), an array of three numbers.
#include "binding.hpp"
#include "se2.hpp"

namespace teamslam::binding {

namespace {

using se2::Pose;

Pose<double> pose_at(const double* from) { return {from[0], from[1], from[2]}; }

MadeNumbers made_pose(const Pose<double>& pose) { return made_numbers({pose.x, pose.y, pose.heading}); }

MadeTable made_square(const linalg::Matrix3& matrix) { return made_matrix(dense::Matrix(matrix)); }

}  // namespace

void bind_se2(nb::module_& m) {
  m.def(
      "compose",
      [](const Triple& a_from_b, const Array& b_from_c) {
        check((b_from_c.ndim() == 1 || b_from_c.ndim() == 2) && b_from_c.shape(b_from_c.ndim() - 1) == 3,
              "poses must have three numbers each");
        const Pose<double> first = pose_at(a_from_b.data());
        std::vector<double> composed(b_from_c.size());
        for (std::size_t k = 0; k < composed.size(); k += 3) {
          const Pose<double> pose = se2::compose(first, pose_at(b_from_c.data() + k));
          composed[k] = pose.x, composed[k + 1] = pose.y, composed[k + 2] = pose.heading;
        }
        return made_array(std::move(composed), axes_of(b_from_c));
      },
      "a_from_b"_a, "b_from_c"_a, "a_from_c = a_from_b o b_from_c, or that of each row of b_from_c.");
  m.def(
      "inverse", [](const Triple& a_from_b) { return made_pose(se2::inverse(pose_at(a_from_b.data()))); }, "a_from_b"_a,
      "b_from_a.");
  m.def(
      "between",
      [](const Triple& a_from_b, const Triple& a_from_c) {
        return made_pose(se2::between(pose_at(a_from_b.data()), pose_at(a_from_c.data())));
      },
      "a_from_b"_a, "a_from_c"_a, "b_from_c = a_from_b^-1 o a_from_c: the motion from b to c, seen in b.");
  m.def(
      "transformed",
      [](const Triple& a_from_b, const Numbers& point_in_b) {
        check(point_in_b.size() == 2, "a point must have two numbers");
        const auto [x, y] = se2::transformed(pose_at(a_from_b.data()), {point_in_b(0), point_in_b(1)});
        return made_numbers({x, y});
      },
      "a_from_b"_a, "point_in_b"_a, "The point's coordinates in frame a.");
  m.def(
      "exponential",
      [](const Triple& xi) { return made_pose(se2::exponential({xi.data()[0], xi.data()[1], xi.data()[2]})); }, "xi"_a,
      "Exp: R^3 -> SE(2), the motion at the constant twist xi = (forward, left, turn) for unit time.");
  m.def(
      "logarithm",
      [](const Triple& pose) {
        const auto [forward, left, turn] = se2::logarithm(pose_at(pose.data()));
        return made_numbers({forward, left, turn});
      },
      "pose"_a, "Log: SE(2) -> R^3, the inverse of `exponential` for |heading| < pi.");
  m.def(
      "adjoint", [](const Triple& a_from_b) { return made_square(se2::adjoint(pose_at(a_from_b.data()))); }, "a_from_b"_a,
      "Ad with T o Exp(xi) = Exp(Ad_T xi) o T: carries a perturbation from the right to the left.");
  m.def(
      "tangent", [](double heading) { return made_square(se2::tangent(heading)); }, "heading"_a,
      "d(x, y, heading)/d(xi) of pose o Exp(xi) for a pose of this heading.");
}

}  // namespace teamslam::binding
