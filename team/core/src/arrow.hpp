// The normal equations of a window's smoother: a chain of poses, and landmarks that are seen from them.
//
// Of A X = B, A = Jᵀ W J, the unknowns are three numbers for each pose, the error ξ of pose ∘ Exp(ξ),
// and two for each landmark. Each pose is connected with the poses next to it and with any landmark,
// no landmark with another: the blocks of A lie on an arrow.
#pragma once

#include <array>
#include <optional>

#include "gaussian.hpp"
#include "se2.hpp"

namespace teamslam::window {

using gaussian::Fault;
using linalg::Matrix3;
using se2::Pose;

// C⁻¹ of a motion's noise C with `jitter` added to its variances, since noise of rank 2 has no inverse.
std::optional<Matrix3> metric_of(Matrix3 C, const double (&jitter)[3]);

// Adds the motion to pose k from the pose before it, which is exactly zero before pose 0.
//
// Its residual is ξ_k − Ad(x_k⁻¹ x_{k−1}) ξ_{k−1} − r in the metric W. column: that of B.
void add_motion(dense::View A, dense::View B, std::size_t column, std::size_t k, const Pose<double>& before,
                const Pose<double>& after, const Matrix3& W, const std::array<double, 3>& r);

// B := A⁻¹ B by the Cholesky factor of A, of which the lower triangle is read; poses: their number.
//
// The factor has A's zeros among the poses, and only what is not zero is computed. Terms are taken in
// the order of `dense`, whose bits these are: a product with zero changes none.
[[nodiscard]] Fault solve_arrow(dense::Const A, dense::View B, std::size_t poses);

}  // namespace teamslam::window
