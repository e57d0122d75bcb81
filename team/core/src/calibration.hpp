// Correction of a raw measurement of range and bearing, and the limits beyond which it is refused.
#pragma once

#include <array>
#include <optional>

#include "se2.hpp"

namespace teamslam::models {

inline constexpr double OFF_AXIS = 0.17364817766693041;  // least cosine to the optical axis at which a depth determines a range

// The parameters of team/config.py: Sensor that are not its noise. lens: the coefficients of the
// bearing's error, b (l₀ + l₁ b + l₂ b²); optical_axis: of a camera, whose range is a depth along it.
struct Calibration {
  double range_offset = 0, range_scale = 1, bearing_offset = 0;
  std::optional<std::array<double, 3>> lens;
  std::optional<double> optical_axis;
  double least_range, most_range, half_field;

  struct Corrected {
    double range, bearing;
    bool is_accepted;
  };
  // ((r − range_offset)/range_scale, b − bearing_offset − lens(b)); a depth is divided by the cosine of
  // its angle to the optical axis, and NaN where that is below OFF_AXIS. Accepted are measurements in the
  // ranges and in the field of view whose corrected range is positive.
  Corrected correct(double r, double b) const {
    double angle = b - bearing_offset;
    if (lens) angle = angle - b * ((*lens)[0] + b * ((*lens)[1] + b * (*lens)[2]));
    double distance = (r - range_offset) / range_scale;
    if (optical_axis) {
      const double cosine = elementary::sin_cos(b - *optical_axis).cosine;
      distance = cosine > OFF_AXIS ? distance / cosine : elementary::NOT_A_NUMBER;
    }
    const double turned = std::fmod(b + elementary::PI, elementary::TWO_PI);
    const double off_axis = pack::abs((turned < 0.0 ? turned + elementary::TWO_PI : turned) - elementary::PI);
    const bool is_within = least_range <= r && r <= most_range && off_axis <= half_field;
    return {distance, se2::wrapped(angle), is_within && distance > 0.0};
  }
};

}  // namespace teamslam::models
