// SE(2): poses are (x [m], y [m], heading [rad]); a perturbation is on the right, pose ∘ Exp(ξ) with
// ξ = (forward [m], left [m], turn [rad]). team/estimation/geometry.py has the same conventions.
#pragma once

#include "linalg.hpp"

namespace teamslam::se2 {

using elementary::SineCosine;
using linalg::Lower3;
using pack::all, pack::max, pack::min, pack::select;

template <class T>
struct Point {
  T x, y;
};

// A symmetric 2 × 2 covariance.
template <class T>
struct Spread {
  T xx, xy, yy;
};

template <class T>
struct Pose {
  T x, y, heading;
};

// A pose with its heading's sine and cosine, which are those of the sum, not of the wrapped angle.
template <class T>
struct Directed {
  T x, y, heading, sine, cosine;
};

struct Motion {
  double forward, left, turn;
};

// The same direction in (−π, π].
template <class T>
inline T wrapped(T angle) {
  const T turns = pack::floor((elementary::PI - angle) / elementary::TWO_PI);
  return angle + elementary::TWO_PI * turns;
}

// (θ/2) cot(θ/2) of a wrapped θ, the diagonal of V(θ)⁻¹ with V of `moved_by_noise`; 1 at θ = 0.
template <class T>
inline T half_cotangent(T turn) {
  const T half = 0.5 * turn;
  const auto [s, c] = elementary::sin_cos_near(half);
  return select(pack::abs(turn) < 1e-4, 1.0 - half * half / 3.0, half / (s / c));
}

// pose ∘ motion; of_turn: of the motion's turn.
template <class T>
inline Directed<T> driven(const Pose<T>& pose, const Motion& motion, const SineCosine<double>& of_turn) {
  const auto [s, c] = elementary::sin_cos_near(pose.heading);
  return {pose.x + (c * motion.forward - s * motion.left), pose.y + (s * motion.forward + c * motion.left),
          wrapped(T(pose.heading + motion.turn)), s * of_turn.cosine + c * of_turn.sine,
          c * of_turn.cosine - s * of_turn.sine};
}

// at ∘ Exp(L ε).
//
// Exp(f, l, φ) = (V(φ) (f, l), φ), V = [[sin φ/φ, −(1 − cos φ)/φ], [(1 − cos φ)/φ, sin φ/φ]]; near
// φ = 0 the quotients are taken from their series.
template <class T>
inline Directed<T> moved_by_noise(const Directed<T>& at, const Lower3& L, const T (&noise)[3]) {
  const T forward = L.l00 * noise[0], left = L.l10 * noise[0] + L.l11 * noise[1];
  T turn = L.l20 * noise[0] + L.l21 * noise[1] + L.l22 * noise[2];
  turn = min(max(turn, all<T>(-elementary::FARTHEST)), all<T>(elementary::FARTHEST));
  const auto [of_turn, by_turn] = elementary::sin_cos_near(turn);
  const auto small = pack::abs(turn) < 1e-4;
  const T square = turn * turn, per = 1.0 / select(small, 1.0, turn);
  const T along = select(small, T(1.0 - square * (1.0 / 6.0)), T(of_turn * per));
  const T across = select(small, T(turn * (0.5 - square * (1.0 / 24.0))), T((1.0 - by_turn) * per));
  const T ahead = along * forward - across * left, aside = across * forward + along * left;
  const T s = at.sine, c = at.cosine;
  return {at.x + c * ahead - s * aside, at.y + s * ahead + c * aside, wrapped(T(at.heading + turn)),
          s * by_turn + c * of_turn, c * by_turn - s * of_turn};
}

// A sensor's place m on the robot's base. With S the sensor's pose since the window's start the
// base's is m ∘ S ∘ m⁻¹, and a point p seen from the sensor's start is m p from the base's.
class Mount {
 public:
  Mount() = default;
  Mount(double x, double y, double heading) : x_(x), y_(y), is_mounted_(x != 0.0 || y != 0.0 || heading != 0.0) {
    const auto [s, c] = elementary::sin_cos(heading);
    sine_ = s;
    cosine_ = c;
    away_x_ = -c * x - s * y;
    away_y_ = s * x - c * y;
  }

  bool is_mounted() const { return is_mounted_; }

  Pose<double> base_pose(const Pose<double>& sensor) const {
    const auto [s, c] = elementary::sin_cos(sensor.heading);
    const Point<double> moved =
        base_point({sensor.x + c * away_x_ - s * away_y_, sensor.y + s * away_x_ + c * away_y_});
    return {moved.x, moved.y, sensor.heading + 0.0};
  }
  Point<double> base_point(const Point<double>& p) const {
    return {(cosine_ * p.x - sine_ * p.y) + x_, (sine_ * p.x + cosine_ * p.y) + y_};
  }
  // Along the axes of the base's frame.
  Spread<double> base_spread(const Spread<double>& P) const {
    const double s = sine_, c = cosine_;
    return {c * c * P.xx - 2.0 * c * s * P.xy + s * s * P.yy, c * s * (P.xx - P.yy) + (c * c - s * s) * P.xy,
            s * s * P.xx + 2.0 * c * s * P.xy + c * c * P.yy};
  }

 private:
  double x_ = 0, y_ = 0, sine_ = 0, cosine_ = 1, away_x_ = 0, away_y_ = 0;
  bool is_mounted_ = false;
};

}  // namespace teamslam::se2
