// A robot's map: one Gaussian over its pose and its landmarks, to which submaps are joined by the
// landmarks' identities.
//
// Map joining of Hybrid-SLAM (Brooks and Bailey 2009, HybridSLAM) with the constraints of Williams'
// constrained local submap filter (2001). A map and a submap that begins at the map's pose (t, θ) are
// independent Gaussians; that landmark b of the submap is landmark a of the map is an observation
// without noise, R(θ) b + t − a = 0.
#pragma once

#include <cstdint>
#include <optional>
#include <span>
#include <vector>

#include "dense.hpp"
#include "se2.hpp"

namespace teamslam::maps {

// N(mean, covariance) of a submap's end pose, its pose nodes and its landmarks by ascending id, in
// the frame of its start.
struct LocalMap {
  std::span<const std::uint32_t> ids;
  std::span<const double> mean;
  dense::Const covariance;

  // The index in the mean of a landmark's first coordinate.
  std::size_t at(std::size_t landmark) const { return mean.size() - 2 * (ids.size() - landmark); }
};

// N(mean, covariance) of a pose and the landmarks by ascending id, in one frame.
struct WholeMap {
  std::vector<std::uint32_t> ids;
  std::vector<double> mean;
  dense::Matrix covariance;

  LocalMap view() const { return {ids, mean, covariance}; }

  // Whether the landmarks' covariance is finite, and that of each landmark alone positive definite.
  bool has_sound_landmarks() const;
};

// Why maps can not be tied: the covariance of the constraints' innovation is not positive definite,
// or that of a single one is singular.
enum class Fault : int { NONE = 0, INDEFINITE = 1, SINGULAR = 2 };

// N(pose, covariance); known, refused: the numbers of landmarks that both maps have, and of those
// beyond the gate.
struct TiedPose {
  std::array<double, 3> pose{};
  std::array<double, 9> covariance{};
  std::size_t known = 0, refused = 0;
  Fault fault = Fault::NONE;
};

// Composes a submap without pose nodes onto the map's pose: known landmarks fused, new ones added.
//
// With s = (map, submap) and a constraint for each known landmark: the iterated EKF update of s, then
// (pose ∘ end pose, landmarks, pose ∘ new landmarks) with its Jacobian. The update has rank 2k for k
// known landmarks and the Jacobian is the identity for the map's landmarks: O(n²k) for n numbers.
// Returns why there is no joined map, which is then not written.
Fault join(const WholeMap& map, const LocalMap& submap, WholeMap& joined);

// The pose of `join` alone. Landmarks whose constraints the others contradict by more than the gate
// are left out, worst first, by Baarda's test of a single constraint: with the multiplier z = S⁻¹ y of
// the innovation y, zₗᵀ ((S⁻¹)ₗₗ)⁻¹ zₗ is the fall of the cost without constraint l, and χ²-distributed
// with two degrees of freedom.
TiedPose end_pose(const WholeMap& map, const LocalMap& submap, double gate);

// A submap corrected by the centre's estimates of errors b that all submaps of a robot share:
// N(mean + Sᵀ b + ½ Dᵀ b², f P + S'ᵀ diag(σ²) S'), S' = S + b D, with f a factor and a row of the
// sensitivity S and of the curvature D for each error.
struct SharedError {
  double value, sigma;
  std::size_t row;
};
void correct(std::span<double> mean, dense::View covariance, double factor, std::span<const SharedError> errors,
             dense::Const sensitivity, dense::Const curvature);

}  // namespace teamslam::maps
