// The measurements of landmarks in one message or keyframe, with the covariances that they bring.
#pragma once

#include <vector>

#include "calibration.hpp"
#include "window.hpp"

namespace teamslam::window {

inline constexpr std::uint32_t UNNAMED = 1u << 31;  // landmark numbers from here on hold in one message or window only

// Ranges [m] and bearings [rad], relative to the sensor; claims: empty where none of them brings a covariance.
struct Measurements {
  std::vector<std::uint32_t> ids;
  std::vector<double> ranges, bearings;
  std::vector<Claim> claims;

  std::size_t size() const { return ids.size(); }
  Scan view() const { return {ids, ranges, bearings, claims}; }
  bool is_finite() const;
  bool is_unnamed() const;  // whether one has no identity; none has then
  Measurements only(const std::vector<bool>& taken) const;
  // With further ones; where only one part brings covariances, the others have the sensor's noise.
  Measurements with(const Measurements& more) const;
};

// Of points (x, y) in the sensor's frame, whose covariances are (xx, xy, yy) if any:
// (r, b) = (‖p‖, atan2(y, x)), and J S Jᵀ with J = ∂(r, b)/∂p, in the form of a point.
Measurements of_points(std::vector<std::uint32_t> ids, std::span<const se2::Point<double>> points,
                       std::span<const std::array<double, 3>> covariances);

// One measurement per landmark, by ascending id; poses: of each scan, relative to the keyframe's end.
//
// It is the median of range and bearing, moved to the keyframe's end; the median of directions is
// relative to the first of them. Its covariance is the mean of those that its measurements bring, in the
// form of the first of them: it is not divided by their number, since an error on a landmark is repeated
// a moment later.
Measurements reduce(std::span<const Scan> scans, std::span<const se2::Pose<double>> poses);

}  // namespace teamslam::window
