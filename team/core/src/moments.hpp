// Moment matching: a mixture of particles becomes one Gaussian, headings on the circle.
//
// Poses after a way with an uncertain heading lie on a bent strip. The mean of their coordinates
// lies inside of its bend, short of where the robot went. A submap's poses have their mean and
// scatter on SE(2), where the strip is straight: pose = μ ∘ Exp(ξ) with ξ of mean zero (Long, Wolfe,
// Mashner and Chirikjian 2012, The banana distribution is Gaussian).
#pragma once

#include <array>

#include "gaussian.hpp"
#include "rows.hpp"
#include "se2.hpp"

namespace teamslam::window {

// Added to each pose's variances [m², m², rad²]: motion noise of rank 2 leaves P singular.
inline constexpr double POSE_JITTER[3] = {1e-6, 1e-6, 1e-8};

// N(mean, covariance) of (poses, landmarks by ascending id); covariance row by row.
struct Gaussian {
  std::vector<std::uint32_t> ids;
  std::vector<double> mean, covariance;
  gaussian::Fault fault = gaussian::Fault::NONE;
};

// A mean pose and each pose's deviation from it in (x, y, heading): rows x, y, heading.
struct OnGroup {
  std::array<double, 3> mean;
  Rows deviations;
};

// The exponentials of log weights.
std::vector<double> weights_of(std::span<const double> log_weights);

// The direction of Σ wᵢ (cos aᵢ, sin aᵢ).
double mean_direction(std::span<const double> angles, std::span<const double> weights);

// The mean of the poses in the rows from `first` on, headings on the circle.
se2::Pose<double> mean_pose(const Rows& poses, std::size_t first, std::span<const double> weights);

// The factor for the scatter of particles with which its inverse is right on average.
//
// N = 1/Σ wᵢ² particles estimate their own mean, and the inverse of the covariance of such a sample
// of q-dimensional normals is too large by ν/(ν − q − 1), ν = N − 1 (Anderson 2003, section 7.7):
// the factor is N/(N − q − 2), with the q = 3 numbers of a pose, the directions in which no particle
// has a covariance of its own. Fewer than ten particles are taken as ten.
double sample_factor(std::span<const double> weights);

// The mean pose μ on SE(2), and each pose's deviation from it.
//
// μ's heading is the mean direction, its position the one with Σ wᵢ ξᵢ = 0 for the translations of
// ξᵢ = Log(μ⁻¹ ∘ poseᵢ). With Log(x, y, φ) = V(φ)⁻¹ (x, y), V(φ)⁻¹ = [[a, φ/2], [−φ/2, a]] and
// a = (φ/2) cot(φ/2), that is linear: Σ wᵢ V(φᵢ)⁻¹ R(μ)ᵀ (pᵢ − p) = 0. A deviation is ξᵢ turned by
// μ's heading. poses: rows x, y, heading.
OnGroup on_group(const Rows& poses, std::span<const double> weights);

// Mean and covariance of the mixture Σ wᵢ N(μᵢ, blkdiag(0, Σ₁, …, Σ_L)) of poses and landmarks.
//
// poses: three rows each; map: five rows a landmark; slots: the landmarks' places in it, in the order of
// the result. The scatter between the particles is taken times `between`. on_se2: the poses' mean and
// deviations are `on_group`, otherwise those of their coordinates.
Gaussian moments(const Rows& poses, std::span<const double> weights, const Rows& map,
                 std::span<const std::size_t> slots, double between, bool on_se2);

// The Gaussian of a submap: `moments` by ascending id, on SE(2), times `sample_factor`, with
// POSE_JITTER on each pose, and why they are no covariance.
Gaussian submap_moments(const Rows& poses, std::span<const double> log_weights, std::span<const std::uint32_t> ids,
                        const Rows& map);

}  // namespace teamslam::window
