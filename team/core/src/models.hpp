// The measurement model h: range and bearing of a point landmark, and its noise.
//
//     range = max(‖landmark − pose‖, NEAREST_M),  bearing = atan2(Δy, Δx) − heading.
//
// A measurement is polar, with the noise of the sensor or a covariance of its own, or a point in
// the sensor's frame whose noise is Gaussian in the plane. With (eₓ, e_y) the predicted direction in
// the map, (u, v) in the robot, and d the distance, the Jacobians are
//
//     ∂h/∂landmark = [eₓ e_y; −e_y/d eₓ/d],  ∂h/∂ξ = [−u −v 0; v/d −u/d −1].
//
// Two evaluations differ in rounding. `predict` and `place` take the heading's sine and cosine and no
// angle: they are for particles, which are many. `line_to`, `polar`, `located` take angles.
#pragma once

#include <array>
#include <type_traits>

#include "se2.hpp"

namespace teamslam::models {

using pack::all, pack::copysign, pack::max, pack::select;
using se2::Directed, se2::Point, se2::Pose;

inline constexpr double NEAREST_M = 1e-3;
inline constexpr double LOG_2_PI = 1.8378770664093453;

// Variances of a measurement, and the share of each that is white: the rest is constant.
struct Noise {
  double range_variance, range_per_m2, range_white, bearing_variance, bearing_white;

  bool is_white() const { return range_white == 1.0 && bearing_white == 1.0; }
};

// The covariance that a measurement brings: a row of `own` in team/estimation/models.py.
struct Claim {
  double rr, rb, bb, form;

  bool is_made() const { return form >= 0.0; }
  bool is_of_point() const { return form > 0.0; }
};
inline constexpr Claim OF_SENSOR = {0.0, 0.0, 0.0, -1.0};

// A landmark given its particle's path: mean [m] and covariance [m²].
template <class T>
struct Landmark {
  T x, y, xx, xy, yy;
};

// The covariance (rr, rb, bb) along and across a direction, turned by the angle of (sine, cosine).
template <class T>
struct Turned {
  T along, both, across;
};
template <class T, class R>
inline Turned<T> turned(R rr, R rb, R bb, const T& sine, const T& cosine) {
  const T s = sine, c = cosine;
  return {c * c * rr - 2.0 * c * s * rb + s * s * bb, c * s * (rr - bb) + (c * c - s * s) * rb,
          s * s * rr + 2.0 * c * s * rb + c * c * bb};
}

// A measurement, as it is for all particles alike.
//
// along, both, across: its covariance along and across the bearing [m²]; rr + rr_per_m2 r²: the
// variance of a range r.
struct Reading {
  double range, bearing, sine, cosine, along, both, across, rr, rr_per_m2, rb, bb;
  bool is_point;
};

inline Reading reading_of(double range, double bearing, const Noise& sensor, const Claim& claim) {
  Reading z{};
  const double reach = max(range, NEAREST_M);
  z.range = range;
  z.bearing = bearing;
  const auto [s, c] = elementary::sin_cos(bearing);
  z.sine = s;
  z.cosine = c;
  if (!claim.is_made()) {
    z.rr = sensor.range_variance;
    z.rr_per_m2 = sensor.range_per_m2;
    z.bb = sensor.bearing_variance;
    z.along = sensor.range_variance + sensor.range_per_m2 * reach * reach;
  } else {
    z.rr = z.along = claim.rr;
    z.rb = claim.rb;
    z.bb = claim.bb;
    z.is_point = claim.is_of_point();
  }
  z.both = z.rb * reach;
  z.across = z.bb * reach * reach;
  return z;
}

// z − h and its noise: that of the sensor at the predicted range, or the measurement's own.
template <class T>
struct Innovation {
  T of_range, of_bearing, rr, rb, bb;
};

// The innovation of a point, with that of its bearing, δ, given by sine and cosine.
//
// Both innovations are the point's: with its error (r cos δ − d, r sin δ) along and across the
// predicted direction and S its covariance turned there, (e₀, e₁/d) and diag(1, 1/d) S diag(1, 1/d).
// A linear map of both leaves all that follows as it is for the point itself.
template <class T>
inline Innovation<T> innovation_of_point(const Reading& z, const T& distance, const T& sine_off, const T& cosine_off) {
  const double reach = max(z.range, NEAREST_M);
  const T d = distance;
  const Turned<T> S = turned(z.along, z.both, z.across, sine_off, cosine_off);
  return {reach * cosine_off - d, reach * sine_off / d, S.along, S.both / d, S.across / (d * d)};
}

template <class T>
inline Innovation<T> innovation_of_polar(const Reading& z, const T& distance, const T& off) {
  return {z.range - distance, off, z.rr + z.rr_per_m2 * distance * distance, all<T>(z.rb), all<T>(z.bb)};
}

// By the predicted range and the bearing's innovation.
template <class T>
inline Innovation<T> innovation_of(const Reading& z, const T& distance, const T& off) {
  if (!z.is_point) return innovation_of_polar(z, distance, off);
  const auto [s, c] = elementary::sin_cos_near(off);
  return innovation_of_point(z, distance, s, c);
}

// A landmark seen from a pose: its distance [m] and its direction in the map [rad].
template <class T>
struct Line {
  T dx, dy, distance, direction;
};

template <class T>
inline Line<T> line_to(const Pose<T>& pose, const T& x, const T& y) {
  const T dx = x - pose.x, dy = y - pose.y;
  const T distance = max(T(pack::sqrt(T(dx * dx + dy * dy))), all<T>(NEAREST_M));
  if constexpr (std::is_same_v<T, double>) {
    return {dx, dy, distance, elementary::atan2(dy, dx)};
  } else {
    const auto is_apart = max(pack::abs(dx), pack::abs(dy)) >= 1e-240;
    const T along = select(is_apart, dx, copysign(all<T>(1.0), dx));
    return {dx, dy, distance, copysign(elementary::direction_near(pack::abs(dy), along), dy)};
  }
}

// h in angles: range [m] and bearing [rad], or a measurement.
struct Polar {
  double range, bearing;
};

inline Polar polar(const Pose<double>& pose, const Point<double>& landmark) {
  const Line<double> line = line_to(pose, landmark.x, landmark.y);
  return {line.distance, se2::wrapped(line.direction - pose.heading)};
}

// z − h of a landmark that is predicted at a range and a bearing.
inline Innovation<double> innovation_of(const Reading& z, const Polar& predicted) {
  return innovation_of(z, predicted.range, se2::wrapped(z.bearing - predicted.bearing));
}

// The rows of range and bearing: ∂h/∂ξ of h(pose ∘ Exp(ξ), landmark) at ξ = 0, by the predicted
// bearing, and ∂h/∂landmark, by the landmark's direction in the map.
using PoseJacobian = std::array<std::array<double, 3>, 2>;
using LandmarkJacobian = std::array<std::array<double, 2>, 2>;

inline PoseJacobian pose_jacobian(double distance, double bearing) {
  const auto [s, c] = elementary::sin_cos(bearing);
  return {{{-c, -s, 0.0}, {s / distance, -c / distance, -1.0}}};
}

inline LandmarkJacobian landmark_jacobian(double distance, double direction) {
  const auto [s, c] = elementary::sin_cos(direction);
  return {{{c, s}, {-s / distance, c / distance}}};
}

// The inverse of h: the point at a range and a bearing from a pose.
inline Point<double> located(const Pose<double>& pose, const Polar& z) {
  const auto [s, c] = elementary::sin_cos(pose.heading + z.bearing);
  return {pose.x + z.range * c, pose.y + z.range * s};
}

// A landmark seen from a pose: distance, its direction in the map (ex, ey) and in the robot (u, v),
// sine and cosine of the bearing's innovation, both innovations and their noise.
template <class T>
struct Prediction : Innovation<T> {
  T distance, ex, ey, u, v, sine_off, cosine_off;
};

// h and z − h.
//
// The bearing's innovation δ is the angle between the direction that was read and the one that is
// predicted, by their vector and scalar products.
template <class T>
inline Prediction<T> predict(const Directed<T>& pose, const Landmark<T>& at, const Reading& z) {
  Prediction<T> p;
  const T s = pose.sine, c = pose.cosine, dx = at.x - pose.x, dy = at.y - pose.y;
  const T apart = pack::sqrt(T(dx * dx + dy * dy));
  const auto here = apart < NEAREST_M;
  p.distance = select(here, NEAREST_M, apart);
  const T per = 1.0 / p.distance;
  p.ex = select(here, c, T(dx * per));
  p.ey = select(here, s, T(dy * per));
  p.u = c * p.ex + s * p.ey;
  p.v = c * p.ey - s * p.ex;
  p.sine_off = z.sine * p.u - z.cosine * p.v;
  p.cosine_off = z.cosine * p.u + z.sine * p.v;
  Innovation<T>& innovation = p;
  if (z.is_point) {
    innovation = innovation_of_point(z, p.distance, p.sine_off, p.cosine_off);
  } else {
    const T off = copysign(elementary::direction_near(pack::abs(p.sine_off), p.cosine_off), p.sine_off);
    innovation = innovation_of_polar(z, p.distance, off);
  }
  return p;
}

// A landmark at first sight in the direction (ex, ey): the inverse model g and Σ = G R Gᵀ, G = ∂g/∂z.
template <class T>
inline Landmark<T> place_in(const T& ex, const T& ey, const T& x, const T& y, const Reading& z) {
  const double distance = max(z.range, NEAREST_M);
  return {x + distance * ex, y + distance * ey,
          z.along * ex * ex + z.across * ey * ey - 2.0 * z.both * ex * ey,
          (z.along - z.across) * ex * ey + z.both * (ex * ex - ey * ey),
          z.along * ey * ey + z.across * ex * ex + 2.0 * z.both * ex * ey};
}

template <class T>
inline Landmark<T> place(const Directed<T>& pose, const Reading& z) {
  const T s = pose.sine, c = pose.cosine;
  const T ex = c * z.cosine - s * z.sine, ey = s * z.cosine + c * z.sine;
  return place_in(ex, ey, pose.x, pose.y, z);
}

inline Landmark<double> place(const Pose<double>& pose, const Reading& z) {
  const auto [ey, ex] = elementary::sin_cos(pose.heading + z.bearing);
  return place_in<double>(ex, ey, pose.x, pose.y, z);
}

template <class T>
struct Gain {
  T x, y, per;  // per: 1/s
};

// Conditions the landmark's covariance on one scalar of row h and returns the gain.
//
// For 2 × 2, Σ − Σhhᵀ Σ/s = (R Σ + |Σ| h⊥h⊥ᵀ)/s with s = hᵀΣh + R: a sum of positive terms, so the
// covariance stays positive definite.
template <class T>
inline Gain<T> condition_spread(Landmark<T>& m, T hx, T hy, T variance) {
  const T xx = m.xx, xy = m.xy, yy = m.yy;
  const T wx = xx * hx + xy * hy, wy = xy * hx + yy * hy;
  const T per = 1.0 / (hx * wx + hy * wy + variance);
  const T shrunk = variance * per, across = (xx * yy - xy * xy) * per;
  m.xx = shrunk * xx + across * hy * hy;
  m.xy = shrunk * xy - across * hx * hy;
  m.yy = shrunk * yy + across * hx * hx;
  return {wx * per, wy * per, per};
}

// The EKF update of a landmark by a measurement, linearised once; returns log p(z).
//
// The range is taken first, then the bearing less its regression on the range, since what is left of
// its error is independent of the range's.
template <class T>
inline T update(Landmark<T>& m, const Prediction<T>& p) {
  const T per = 1.0 / p.distance, slope = p.rb / p.rr;
  const Gain<T> range = condition_spread(m, p.ex, p.ey, p.rr);
  const T dx = range.x * p.of_range, dy = range.y * p.of_range;
  const T hx = -p.ey * per - slope * p.ex, hy = p.ex * per - slope * p.ey;
  const T of_bearing = p.of_bearing - slope * p.of_range - (hx * dx + hy * dy);
  const Gain<T> bearing = condition_spread(m, hx, hy, T(p.bb - slope * p.rb));
  m.x += dx + bearing.x * of_bearing;
  m.y += dy + bearing.y * of_bearing;
  const T chi2 = p.of_range * p.of_range * range.per + of_bearing * of_bearing * bearing.per;
  const T volume = elementary::log_of_normal(T(range.per * bearing.per)) - 2.0 * LOG_2_PI;
  return 0.5 * (volume - chi2);
}

}  // namespace teamslam::models
