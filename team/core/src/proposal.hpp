// The proposal of FastSLAM 2.0, in the space of the motion's noise ε: no covariance of motion is
// inverted, so it may be singular. Thrun et al. 2005, section 13.5-13.8; Montemerlo 2003, chapter 4.
#pragma once

#include "models.hpp"

namespace teamslam::window {

using linalg::Lower3;
using models::Landmark, models::Prediction;
using pack::all;

// ε ~ N(m, A Aᵀ), at first N(0, I).
template <class T>
struct MotionNoise {
  T m[3] = {T{}, T{}, T{}};
  T A[3][3] = {{all<T>(1.0), T{}, T{}}, {T{}, all<T>(1.0), T{}}, {T{}, T{}, all<T>(1.0)}};
};

// Conditions ε on row·ε + v = row·m + innovation, v ~ N(0, variance); returns the factor of |det A|².
//
// Potter's square-root update: the covariance can not lose its sign. Maybeck 1979, section 7.3.
template <class T>
inline T condition(MotionNoise<T>& noise, const T (&row)[3], T innovation, T variance) {
  auto& [m, A] = noise;
  T p[3], g[3];
  for (int k = 0; k < 3; k++) p[k] = A[0][k] * row[0] + A[1][k] * row[1] + A[2][k] * row[2];
  const T total = p[0] * p[0] + p[1] * p[1] + p[2] * p[2] + variance;
  const T per = 1.0 / total, left = variance * per, share = 1.0 / (1.0 + pack::sqrt(left));
  for (int i = 0; i < 3; i++) g[i] = (A[i][0] * p[0] + A[i][1] * p[1] + A[i][2] * p[2]) * per;
  for (int i = 0; i < 3; i++) m[i] = m[i] + g[i] * innovation;
  for (int i = 0; i < 3; i++) g[i] = share * g[i];
  for (int i = 0; i < 3; i++)
    for (int k = 0; k < 3; k++) A[i][k] = A[i][k] - g[i] * p[k];
  return left;
}

// Conditions ε on the measurement of a known landmark predicted at ε = m; returns the term of
// log |det A|.
//
// There z = h + H L (ε − m) + v with the joint covariance S = Hₗ Σ Hₗᵀ + R of v. The range is taken
// first, then the bearing less its regression on the range, so each is scalar.
template <class T>
inline T condition(MotionNoise<T>& noise, const Lower3& L, const Landmark<T>& at, const Prediction<T>& q) {
  const T ex = q.ex, ey = q.ey, per = 1.0 / q.distance, xx = at.xx, xy = at.xy, yy = at.yy;
  const T S_rr = xx * ex * ex + 2.0 * xy * ex * ey + yy * ey * ey + q.rr;
  const T S_rb = (xy * (ex * ex - ey * ey) + (yy - xx) * ex * ey) * per + q.rb;
  const T S_bb = (xx * ey * ey - 2.0 * xy * ex * ey + yy * ex * ex) * (per * per) + q.bb;
  const T slope = S_rb / S_rr, u = q.u, v = q.v;
  const T r[3] = {-u * L.l00 - v * L.l10, -v * L.l11, T{}};
  const T b[3] = {(v * L.l00 - u * L.l10) * per - L.l20 - slope * r[0], -u * L.l11 * per - L.l21 - slope * r[1],
                  all<T>(-L.l22)};
  const T before[3] = {noise.m[0], noise.m[1], noise.m[2]};
  T of_bearing = q.of_bearing - slope * q.of_range;
  const T left = condition(noise, r, q.of_range, S_rr);
  of_bearing -= b[0] * (noise.m[0] - before[0]) + b[1] * (noise.m[1] - before[1]) + b[2] * (noise.m[2] - before[2]);
  const T lower = condition(noise, b, of_bearing, T(S_bb - slope * S_rb));
  return 0.5 * elementary::log_of_normal(T(left * lower));
}

// Replaces m by a draw m + A n; returns log N(ε; 0, I) − log N(ε; m, A Aᵀ) but for |det A|.
template <class T>
inline T draw(MotionNoise<T>& noise, const T (&normal)[3]) {
  auto& [m, A] = noise;
  T e[3];
  for (int i = 0; i < 3; i++) e[i] = m[i] + A[i][0] * normal[0] + A[i][1] * normal[1] + A[i][2] * normal[2];
  for (int i = 0; i < 3; i++) m[i] = e[i];
  const T before = normal[0] * normal[0] + normal[1] * normal[1] + normal[2] * normal[2];
  return 0.5 * before - 0.5 * (e[0] * e[0] + e[1] * e[1] + e[2] * e[2]);
}

}  // namespace teamslam::window
