// The motion of one interval of odometry as a Gaussian on SE(2).
//
// Thrun, Burgard and Fox 2005, section 5.3, with the noise in the tangent space of the motion's end,
// so that motions compose: truth = mean ∘ Exp(ξ), ξ ~ N(0, C) in (forward, left, turn).
#pragma once

#include <array>
#include <optional>

#include "se2.hpp"

namespace teamslam::motion {

using linalg::Matrix3;
using se2::Motion, se2::Point, se2::Pose;

// Standard deviations of a noise by time, path length and turn: its variance is
// per_s² t + per_m² |d| + per_rad² |φ|.
struct Densities {
  double per_s = 0, per_m = 0, per_rad = 0;

  double variance(double duration_s, double distance, double turn) const {
    return per_s * per_s * duration_s + per_m * per_m * pack::abs(distance) + per_rad * per_rad * pack::abs(turn);
  }
};

// The parameters of team/config.py: MotionModel.
struct Model {
  bool turns_first = false;
  Densities forward, turn, final_turn, lateral;
  double forward_scale = 1, yaw_scale = 1, yaw_rate_limit = elementary::INF, turn_drag = 0, veer = 0;
  double slow_below = 0, slow_scale = 1, covariance_factor = 1;
  std::optional<std::array<double, 2>> calibrated_speed;
  std::optional<std::array<double, 6>> alphas;
  double alpha_interval_s = 1;
  std::optional<std::array<double, 3>> wheels;  // distance of the wheels, noise of the left and of the right one
  std::optional<std::array<double, 3>> shares;  // of forward, lateral, heading
  double shares_interval_s = 0.2;

  double clipped(double rate) const { return rate < -yaw_rate_limit ? -yaw_rate_limit : rate > yaw_rate_limit ? yaw_rate_limit : rate; }
  // Whether the scale of this speed is known, so that it has no error of its own.
  bool has_known_scale(double speed) const {
    return calibrated_speed && (*calibrated_speed)[0] <= speed && speed <= (*calibrated_speed)[1];
  }
};

// Variances of the noises a (forward), b (turn), c (final turn) and l (lateral), and cov(a, b).
struct Noises {
  double forward, turn, both, final_turn, lateral;
};

Noises noises_of(const Model& model, double duration_s, double distance, double turn);

struct Increment {
  Pose<double> mean{};
  Matrix3 covariance{};
};

// A further motion, with what carries an earlier error to its end.
struct Step {
  explicit Step(const Increment& of) : motion(of), Ad(se2::adjoint(se2::inverse(of.mean))) {}

  Increment motion;
  Matrix3 Ad;
};

// mean₁ ∘ mean₂ with Ad C₁ Adᵀ + C₂, Ad = Ad(mean₂⁻¹): T₁Exp(ξ₁)T₂Exp(ξ₂) = T₁T₂Exp(Ad(T₂⁻¹)ξ₁)Exp(ξ₂),
// to first order in the noise.
Increment compose(const Increment& motion, const Step& then);

// A motion of the base as one of the sensor at m, T Exp(ξ) m = m (m⁻¹ T m) Exp(Ad(m⁻¹) ξ).
Increment of_sensor(const Increment& step, const Pose<double>& mount);

// A shift ξ of an earlier motion, seen at the end of a further motion: Ad(motion⁻¹) ξ.
inline Motion shift_after(const Motion& shift, const Pose<double>& motion) {
  const auto [s, c] = elementary::sin_cos(motion.heading);
  const double x = shift.forward - motion.y * shift.turn, y = shift.left + motion.x * shift.turn;
  return {c * x + s * y, -s * x + c * y, shift.turn};
}

// The motion of an interval whose forward speed [m/s] and yaw rate [rad/s] were measured.
//
// With v = forward_scale·forward (slow_scale·forward where |forward| < slow_below),
// ω = clip(yaw_scale·yaw_rate, ±yaw_rate_limit), the path length
// d = sign(v) max(|v| − turn_drag·|ω|, 0)·t, the turn φ = ω t + veer·d and the noises a (forward, on
// d), b (turn, on φ), c (final turn), l (lateral), the motion is
//
// - "turn-then-drive": turn φ + b, drive d + a, then (0, l, c): the thesis, section 4.3.1;
// - all others: Exp(d + a, 0, φ + b), then (0, l, c): the arc of Thrun et al. table 5.3 and Ma & Ma
//   eq. 1-4, with its limit φ → 0.
Increment increment_of(const Model& model, double duration_s, double forward, double yaw_rate);

// d/db at 0 of the interval's motion (ahead, left), in the tangent space of its end, if the true path
// length is (1 + b) times the measured one; zero where the scale is known.
Point<double> forward_column(const Model& model, double duration_s, double forward, double yaw_rate);

// A motion Exp(twist) that was measured over an interval of duration_s; covariance: the source's own
// of the whole interval's error, in the tangent space of its end.
struct Moved {
  Motion twist;
  double duration_s;
  std::optional<Matrix3> covariance;
};

// A share of a measured motion at constant twist, followed by the share `rest`.
//
// The twist is calibrated as the speeds of `increment_of` are; the scales of speed apply to the path
// length in any direction, veer follows its forward part. Without the source's covariance the noise
// is the model's over this path length, turn and time. A share f of the source's covariance C is
// f Ad C Adᵀ, with Ad of the motion that follows. Seen from the interval's end the error then grows
// evenly, so however the interval is split, its parts compose to C: Σ Ad⁻¹ (f Ad C Adᵀ) Ad⁻ᵀ = C.
Increment part_of(const Model& model, const Moved& moved, double share, double rest);

// As for a motion by speeds, of a share of a measured motion.
Point<double> forward_column(const Model& model, const Moved& moved, double share);

}  // namespace teamslam::motion
