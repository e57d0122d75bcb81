// The landmarks of a window solved again: by Gauss-Newton, given each particle's path.
#pragma once

#include "particles.hpp"

namespace teamslam::window {

// One measurement of a window, as it was read at one of its keyframes.
struct WindowMeasurement {
  std::uint32_t id;
  std::size_t keyframe;
  double range, bearing;
  Claim claim;
};

// Solves a landmark of each particle over its measurements, given the particle's path.
//
// Minimises Σ ‖z − h(path, landmark) − b‖² in R⁻¹ plus ‖b‖² in B⁻¹ from the EKF's mean with at most
// three steps, each kept only if the cost falls. R is the white part of the noise, of the range
// predicted at the start; b ~ N(0, B) is the landmark's constant error, B the rest of the variances
// (of the last measurement's range), eliminated by Schur's complement: with D = Σ R⁻¹ + B⁻¹ and
// C = Σ Hᵀ R⁻¹ the covariance is (Σ Hᵀ R⁻¹ H − C D⁻¹ Cᵀ)⁻¹ at the result. Where no evaluation is
// finite the EKF's mean and covariance stay.
//
// id, slot: the landmark and its place among `starts`, five rows each as of `Particles::map`; path: x, y,
// heading of each keyframe. The landmark's rows of `solved`, which has the rows of `starts`, are written.
void solve_along_paths(std::uint32_t id, std::size_t slot, const Rows& starts, const Rows& path,
                       std::span<const WindowMeasurement> measurements, const Noise& noise, Rows& solved);

}  // namespace teamslam::window
