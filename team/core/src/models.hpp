// The measurement model h: range and bearing of a point landmark, and its noise.
//
//     range = max(‖landmark − pose‖, NEAREST_M),  bearing = atan2(Δy, Δx) − heading.
//
// A measurement is polar, with the noise of the sensor or a covariance of its own, or a point in
// the sensor's frame whose noise is Gaussian in the plane. With (eₓ, e_y) the predicted direction in
// the map, (u, v) in the robot, and d the distance, the Jacobians are
//
//     ∂h/∂landmark = [eₓ e_y; −e_y/d eₓ/d],  ∂h/∂ξ = [−u −v 0; v/d −u/d −1].
#pragma once

#include "se2.hpp"

namespace teamslam::models {

using pack::all, pack::copysign, pack::max, pack::select;
using se2::Directed;

inline constexpr double NEAREST_M = 1e-3;
inline constexpr double LOG_2_PI = 1.8378770664093453;

// Variances of a measurement, and the share of each that is white: the rest is constant.
struct Noise {
  double range_variance, range_per_m2, range_white, bearing_variance, bearing_white;

  bool is_white() const { return range_white == 1.0 && bearing_white == 1.0; }
};

// The covariance that a measurement brings: a row of `own` in team/estimation/scans.py.
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

// A landmark seen from a pose: distance, its direction in the map (ex, ey) and in the robot (u, v),
// sine and cosine of the bearing's innovation, both innovations and their noise.
template <class T>
struct Prediction {
  T distance, ex, ey, u, v, sine_off, cosine_off, of_range, of_bearing, rr, rb, bb;
};

// h and z − h.
//
// The bearing's innovation δ is the angle between the direction that was read and the one that is
// predicted, by their vector and scalar products. For a point both innovations are the point's:
// with its error (r cos δ − d, r sin δ) along and across the predicted direction and S its
// covariance turned there, (e₀, e₁/d) and diag(1, 1/d) S diag(1, 1/d).
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
  p.of_range = z.range - p.distance;
  p.of_bearing = copysign(elementary::direction_near(pack::abs(p.sine_off), p.cosine_off), p.sine_off);
  p.rr = z.rr + z.rr_per_m2 * p.distance * p.distance;
  p.rb = all<T>(z.rb);
  p.bb = all<T>(z.bb);
  if (z.is_point) {
    const double reach = max(z.range, NEAREST_M);
    const T d = p.distance;
    const Turned<T> S = turned(z.along, z.both, z.across, p.sine_off, p.cosine_off);
    p.of_range = reach * p.cosine_off - d;
    p.of_bearing = reach * p.sine_off / d;
    p.rr = S.along;
    p.rb = S.both / d;
    p.bb = S.across / (d * d);
  }
  return p;
}

// A landmark at first sight: the inverse model g and Σ = G R Gᵀ, G = ∂g/∂z.
template <class T>
inline Landmark<T> place(const Directed<T>& pose, const Reading& z) {
  const double distance = max(z.range, NEAREST_M);
  const T s = pose.sine, c = pose.cosine;
  const T ex = c * z.cosine - s * z.sine, ey = s * z.cosine + c * z.sine;
  return {pose.x + distance * ex, pose.y + distance * ey,
          z.along * ex * ex + z.across * ey * ey - 2.0 * z.both * ex * ey,
          (z.along - z.across) * ex * ey + z.both * (ex * ex - ey * ey),
          z.along * ey * ey + z.across * ex * ex + 2.0 * z.both * ex * ey};
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
