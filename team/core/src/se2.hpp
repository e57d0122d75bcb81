// SE(2): poses are (x [m], y [m], heading [rad]); a perturbation is on the right, pose ∘ Exp(ξ) with
// ξ = (forward [m], left [m], turn [rad]). `a_from_b` maps coordinates in b into a.
#pragma once

#include "linalg.hpp"

namespace teamslam::se2 {

using elementary::SineCosine;
using linalg::Lower3, linalg::Matrix3;
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

// a_from_c = a_from_b ∘ b_from_c.
inline Pose<double> compose(const Pose<double>& a_from_b, const Pose<double>& b_from_c) {
  const auto [s, c] = elementary::sin_cos(a_from_b.heading);
  return {a_from_b.x + c * b_from_c.x - s * b_from_c.y, a_from_b.y + s * b_from_c.x + c * b_from_c.y,
          wrapped(a_from_b.heading + b_from_c.heading)};
}

// b_from_a.
inline Pose<double> inverse(const Pose<double>& a_from_b) {
  const auto [s, c] = elementary::sin_cos(a_from_b.heading);
  return {-c * a_from_b.x - s * a_from_b.y, s * a_from_b.x - c * a_from_b.y, wrapped(-a_from_b.heading)};
}

// b_from_c = a_from_b⁻¹ ∘ a_from_c: the motion from b to c, seen in b.
inline Pose<double> between(const Pose<double>& a_from_b, const Pose<double>& a_from_c) {
  const auto [s, c] = elementary::sin_cos(a_from_b.heading);
  const double dx = a_from_c.x - a_from_b.x, dy = a_from_c.y - a_from_b.y;
  return {c * dx + s * dy, -s * dx + c * dy, wrapped(a_from_c.heading - a_from_b.heading)};
}

// The point's coordinates in frame a.
inline Point<double> transformed(const Pose<double>& a_from_b, const Point<double>& in_b) {
  const auto [s, c] = elementary::sin_cos(a_from_b.heading);
  return {a_from_b.x + c * in_b.x - s * in_b.y, a_from_b.y + s * in_b.x + c * in_b.y};
}

// V(turn) (forward, left): the end of a constant twist in unit time.
//
// V(θ) = [[sin θ/θ, −(1 − cos θ)/θ], [(1 − cos θ)/θ, sin θ/θ]]; near θ = 0 the quotients are taken
// from their series.
inline Point<double> swept(const Motion& twist) {
  double along, across;
  if (pack::abs(twist.turn) < 1e-4) {
    const double square = twist.turn * twist.turn;
    along = 1.0 - square / 6.0;
    across = twist.turn * (0.5 - square / 24.0);
  } else {
    const auto [s, c] = elementary::sin_cos(twist.turn);
    along = s / twist.turn;
    across = (1.0 - c) / twist.turn;
  }
  return {along * twist.forward - across * twist.left, across * twist.forward + along * twist.left};
}

// Exp: R³ → SE(2), (V(θ) (forward, left), θ).
inline Pose<double> exponential(const Motion& twist) {
  const auto [x, y] = swept(twist);
  return {x, y, wrapped(twist.turn)};
}

// Log: SE(2) → R³, the inverse of `exponential` for |θ| < π.
inline Motion logarithm(const Pose<double>& pose) {
  const double turn = wrapped(pose.heading), half = 0.5 * turn, a = half_cotangent(turn);
  return {a * pose.x + half * pose.y, -half * pose.x + a * pose.y, turn};
}

// Ad with T ∘ Exp(ξ) = Exp(Ad_T ξ) ∘ T: carries a perturbation from the right to the left.
inline Matrix3 adjoint(const Pose<double>& a_from_b) {
  const auto [s, c] = elementary::sin_cos(a_from_b.heading);
  return {{{c, -s, a_from_b.y}, {s, c, -a_from_b.x}, {0.0, 0.0, 1.0}}};
}

// ∂(x, y, θ)/∂ξ of pose ∘ Exp(ξ) for a pose of this heading.
inline Matrix3 tangent(double heading) {
  const auto [s, c] = elementary::sin_cos(heading);
  return {{{c, -s, 0.0}, {s, c, 0.0}, {0.0, 0.0, 1.0}}};
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
