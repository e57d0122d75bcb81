// Scans, motions and the noise of a sensor from Python, for the bindings.
#pragma once

#include "binding.hpp"
#include "consensus.hpp"
#include "segmenter.hpp"

namespace teamslam::binding {

// (mean, covariance) of a motion.
using MadeIncrement = std::tuple<se2::Pose<double>, linalg::Matrix3>;

inline MadeIncrement made_increment(const motion::Increment& of) { return {of.mean, of.covariance}; }

// A stamp or a duration: of a message, below 2⁶² ns, with the offset of its clock.
inline motion::Nanoseconds checked_ns(motion::Nanoseconds stamp_ns) {
  constexpr motion::Nanoseconds MOST = window::Segmenter::NEVER + window::Segmenter::NEVER / 4;
  check(stamp_ns >= -MOST && stamp_ns <= MOST, "a time must be within 182 years of 0");
  return stamp_ns;
}

inline motion::Interval checked(motion::Interval interval) {
  checked_ns(interval.end_ns);
  checked_ns(interval.duration_ns);
  check(interval.duration_ns >= 0, "duration_ns must not be negative");
  return interval;
}

inline models::Noise noise_of(const std::array<double, 5>& noise) {
  check_finite(noise.data(), 5, "the noise of the sensor");
  check(noise[0] > 0.0 && noise[1] >= 0.0 && noise[3] > 0.0, "the variances of the sensor must be positive");
  check(noise[2] > 0.0 && noise[2] <= 1.0 && noise[4] > 0.0 && noise[4] <= 1.0,
        "the white shares of the sensor must be in (0, 1]");
  return {noise[0], noise[1], noise[2], noise[3], noise[4]};
}

inline std::span<const models::Claim> claims_of(const Table& own, std::size_t n) {
  check(own.shape(0) == n && (own.shape(1) == 0 || own.shape(1) == 4), "own must be (n, 0) or (n, 4)");
  finite(own, "own");
  static_assert(sizeof(models::Claim) == 4 * sizeof(double));
  if (own.shape(1) == 0) return {};
  return {reinterpret_cast<const models::Claim*>(own.data()), n};
}

inline window::Scan scan_of(const window::Keyframe& keyframe) {
  if (!keyframe.seen.is_finite()) throw NotFiniteError("measurements must be finite");
  return keyframe.seen.view();
}

constexpr std::size_t MOST_PARTICLES = 10'000'000;

inline window::Settings settings_of(std::size_t particles, const std::array<double, 5>& noise, bool improved,
                                    const std::array<double, 3>& mount, double resample_below) {
  check(particles > 0 && particles <= MOST_PARTICLES, "particles must be in 1 ... 10,000,000");
  check_finite(mount.data(), 3, "the mount");
  check_finite(&resample_below, 1, "resample_below");
  return {particles, improved, noise_of(noise), se2::Mount(mount[0], mount[1], mount[2]), resample_below};
}

inline window::Consensus gate_of(const std::array<double, 5>& noise, double max_range, double field_of_view, double share) {
  check(max_range > 0.0 && field_of_view > 0.0, "max_range and field_of_view must be positive");
  check(share > 0.0 && share < 1.0, "outlier_share must be in (0, 1)");
  return window::Consensus(noise_of(noise), max_range, field_of_view, share);
}

}  // namespace teamslam::binding
