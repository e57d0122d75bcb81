// The derivative of a window's Gaussian by errors that many windows share.
//
// A small calibration error b shifts every submap of a robot alike. With S = ∂mean/∂b a submap is
// r = h(x) − (mean + S b) ~ N(0, P), and the centre estimates b together with the map. The mean of the
// particles has no derivative in closed form; S is that of the window's smoother, linearised about the
// particles' mean path: with J, W over the motions and the measurements and g the derivative of their
// residuals, S = −(JᵀWJ)⁻¹ Jᵀ W g. As in the window itself the path takes the measurements as
// independent, and the landmarks are solved for given the path. The clock's derivative changes with b: D is
// its difference between the solutions S b later and earlier.
#pragma once

#include "window.hpp"

namespace teamslam::window {

// The errors: a bearing is b too large; a measurement is stamped b too late against the odometry (it was
// made at the pose x ∘ Exp(−b τ), with the twist τ); the path driven is (1 + b) times the odometry's; a
// range is b too large, or (1 + b) times the true one.
enum Bias : std::size_t { BEARING, CLOCK_OFFSET, FORWARD_SCALE, RANGE_OFFSET, RANGE_SCALE, BIASES };

// A row for each Bias over (end pose, pose nodes, landmarks by ascending id), in the base's frame: the
// first derivative, and for a closed window the second derivative by the clock's offset. Those by the other
// errors are negligible for calibrated robots.
struct Sensitivity {
  dense::Matrix rows, curvature;
  gaussian::Fault fault = gaussian::Fault::NONE;  // of the smoother; there are no rows then

  // The numbers in single precision, as in a message.
  Sensitivity rounded() &&;
};

// mean: the window's, of `close`, or of `run` without `with_nodes`.
Sensitivity sensitivity_of(const Window& window, std::span<const double> mean, bool with_nodes);

}  // namespace teamslam::window
