// Several scans of a moment reduced to one range and bearing for each landmark.
#pragma once

#include <vector>

#include "window.hpp"

namespace teamslam::window {

struct Reduced {
  std::vector<std::uint32_t> ids;
  std::vector<double> ranges, bearings;
  std::vector<Claim> claims;  // empty where no scan brings any
};

// One measurement per landmark, by ascending id; poses: of each scan, relative to the keyframe's end.
//
// It is the median of range and bearing, moved to the keyframe's end; the median of directions is
// relative to the first of them. Its covariance is the mean of those that its measurements bring, in the
// form of the first of them: it is not divided by their number, since an error on a landmark is repeated
// a moment later.
Reduced reduce(std::span<const Scan> scans, std::span<const se2::Pose<double>> poses);

}  // namespace teamslam::window
