#include "motion.hpp"

namespace teamslam::motion {

namespace {

// A C Aᵀ.
Matrix3 sandwiched(const Matrix3& A, const Matrix3& C) {
  Matrix3 half{}, whole{};
  for (int i = 0; i < 3; i++)
    for (int k = 0; k < 3; k++)
      for (int j = 0; j < 3; j++) half[i][j] += A[i][k] * C[k][j];
  for (int i = 0; i < 3; i++)
    for (int k = 0; k < 3; k++)
      for (int j = 0; j < 3; j++) whole[i][j] += half[i][k] * A[j][k];
  return whole;
}

// (C + Cᵀ)/2.
Matrix3 symmetric(const Matrix3& C) {
  Matrix3 made{};
  for (int i = 0; i < 3; i++)
    for (int j = 0; j < 3; j++) made[i][j] = 0.5 * (C[i][j] + C[j][i]);
  return made;
}

// Exp(ξ + (a u, b)), then l across the path and a final turn c.
//
// (ξ₀, ξ₁) = d u with the path length d, negative backwards; u stays the direction of motion in the
// moving frame. The noises a and b reach the end's tangent space by Jr (u, 0) and the last column of
// SE(2)'s right Jacobian Jr at ξ (Solà et al., A micro Lie theory, eq. 163). Near φ = 0 its quotients
// are taken from their series.
Increment arc(const Motion& twist, double distance, const Noises& n) {
  const auto [x, y, turn] = twist;
  double sine, cosine, cubic;
  if (pack::abs(turn) < 1e-3) {
    const double square = turn * turn;
    sine = 1.0 - square / 6.0;
    cosine = 0.5 - square / 24.0;
    cubic = turn * (1.0 / 6.0 - square / 120.0);
  } else {
    const double s = elementary::sin_cos(turn).sine, half = elementary::sin_cos(0.5 * turn).sine / turn;
    sine = s / turn;
    cosine = 2.0 * (half * half);
    cubic = (turn - s) / (turn * turn);
  }
  const double ux = distance != 0.0 ? x / distance : 1.0, uy = distance != 0.0 ? y / distance : 0.0;
  const double ax = sine * ux + turn * cosine * uy, ay = -turn * cosine * ux + sine * uy;
  const double bx = x * cubic - y * cosine, by = x * cosine + y * cubic;
  const double xx = n.forward * ax * ax + n.turn * bx * bx + 2.0 * n.both * ax * bx + n.lateral * uy * uy;
  const double xy = n.forward * ax * ay + n.turn * bx * by + n.both * (ax * by + ay * bx) - n.lateral * ux * uy;
  const double yy = n.forward * ay * ay + n.turn * by * by + 2.0 * n.both * ay * by + n.lateral * ux * ux;
  const double xt = n.turn * bx + n.both * ax, yt = n.turn * by + n.both * ay, tt = n.turn + n.final_turn;
  return {se2::exponential(twist), {{{xx, xy, xt}, {xy, yy, yt}, {xt, yt, tt}}}};
}

// A turn and a straight path after it: J = [1 0; 0 d; 0 1] for the noises (a, b).
Increment turn_then_drive(double distance, double turn, const Noises& n) {
  const auto [s, c] = elementary::sin_cos(turn);
  const double xy = n.both * distance, yy = n.turn * distance * distance + n.lateral, yt = n.turn * distance;
  return {{distance * c, distance * s, se2::wrapped(turn)},
          {{{n.forward, xy, n.both}, {xy, yy, yt}, {n.both, yt, n.turn + n.final_turn}}}};
}

Motion calibrated(const Model& model, const Moved& moved) {
  const auto [x, y, measured_turn] = moved.twist;
  const double most = model.yaw_rate_limit * moved.duration_s;
  const double turn = pack::min(pack::max(model.yaw_scale * measured_turn, -most), most), way = elementary::hypot(x, y);
  const double scale = way < model.slow_below * moved.duration_s ? model.slow_scale : model.forward_scale;
  const double effective = pack::max(scale * way - model.turn_drag * pack::abs(turn), 0.0);
  const double share = way > 0.0 ? effective / way : 0.0, forward = share * x;
  return {forward, share * y, turn + model.veer * forward};
}

Motion times(double share, const Motion& twist) { return {share * twist.forward, share * twist.left, share * twist.turn}; }

}  // namespace

// The densities' variances, and in addition:
//
// - Ma & Ma's α₁ … α₆: their errors of v, ω and γ have the variances α₁v² + α₂ω², α₃v² + α₄ω²,
//   α₅v² + α₆ω² and are held for one interval T (eq. 2-4): times T² on the path and the turns. As a
//   density that is T·t.
// - errors of two wheels, J diag(V_l, V_r) Jᵀ with V = noise² |way|: d = (s_r + s_l)/2 and
//   φ = (s_r − s_l)/base (Downs eq. 2.3-2.4), so s = d ± φ base/2 and J = [1/2 1/2; −1/base 1/base].
//   They alone correlate a and b.
// - errors that are a constant share of the way for an interval.
Noises noises_of(const Model& model, double duration_s, double distance, double turn) {
  Noises n{model.forward.variance(duration_s, distance, turn), model.turn.variance(duration_s, distance, turn), 0.0,
           model.final_turn.variance(duration_s, distance, turn), 0.0};
  if (model.alphas && duration_s > 0.0) {
    const auto [a1, a2, a3, a4, a5, a6] = *model.alphas;
    const double v = distance / duration_s, w = turn / duration_s, v2 = v * v, w2 = w * w;
    const double spread = model.alpha_interval_s * duration_s;
    n.forward += (a1 * v2 + a2 * w2) * spread;
    n.turn += (a3 * v2 + a4 * w2) * spread;
    n.final_turn += (a5 * v2 + a6 * w2) * spread;
  }
  if (model.wheels) {
    const auto [base, left, right] = *model.wheels;
    const double half = 0.5 * base * turn;
    const double of_left = left * left * pack::abs(distance - half), of_right = right * right * pack::abs(distance + half);
    const double total = of_left + of_right;
    n.forward += 0.25 * total;
    n.turn += total / (base * base);
    n.both = 0.5 * (of_right - of_left) / base;
  }
  n.lateral = model.lateral.variance(duration_s, distance, turn);
  if (model.shares && duration_s > 0.0) {
    const auto [along, across, heading] = *model.shares;
    const double shared = distance * distance * model.shares_interval_s / duration_s;
    n.forward += along * along * shared;
    n.lateral += across * across * shared;
    n.turn += heading * heading * shared;
  }
  return n;
}

Increment compose(const Increment& motion, const Step& then) {
  const Matrix3 &C = motion.covariance, &Ad = then.Ad;
  Matrix3 half{};
  for (int i = 0; i < 3; i++)
    for (int j = 0; j < 3; j++) half[i][j] = Ad[i][0] * C[0][j] + Ad[i][1] * C[1][j] + Ad[i][2] * C[2][j];
  Increment after{se2::compose(motion.mean, then.motion.mean), {}};
  for (int i = 0; i < 3; i++)
    for (int j = i; j < 3; j++)
      after.covariance[i][j] = after.covariance[j][i] =
          then.motion.covariance[i][j] + (half[i][0] * Ad[j][0] + half[i][1] * Ad[j][1] + half[i][2] * Ad[j][2]);
  return after;
}

Increment of_sensor(const Increment& step, const Pose<double>& mount) {
  const Pose<double> away = se2::inverse(mount);
  return {se2::compose(se2::compose(away, step.mean), mount), symmetric(sandwiched(se2::adjoint(away), step.covariance))};
}

Increment increment_of(const Model& model, double duration_s, double forward, double yaw_rate) {
  const double rate = model.clipped(model.yaw_scale * yaw_rate), lost = model.turn_drag * pack::abs(rate) * duration_s;
  const double scale = pack::abs(forward) < model.slow_below ? model.slow_scale : model.forward_scale;
  const double logged = scale * forward * duration_s, left = pack::abs(logged) - lost;
  const double distance = pack::copysign(left < 0.0 ? 0.0 : left, logged), turn = rate * duration_s + model.veer * distance;
  const Noises noises = noises_of(model, duration_s, distance, turn);
  return model.turns_first ? turn_then_drive(distance, turn, noises) : arc({distance, 0.0, turn}, distance, noises);
}

Point<double> forward_column(const Model& model, double duration_s, double forward, double yaw_rate) {
  if (model.has_known_scale(pack::abs(forward))) return {0.0, 0.0};
  const double way = model.forward_scale * forward * duration_s;
  if (model.turns_first) return {way, 0.0};
  const auto [s, c] = elementary::sin_cos(0.5 * (model.clipped(model.yaw_scale * yaw_rate) * duration_s));
  return {way * c, -way * s};
}

Increment part_of(const Model& model, const Moved& moved, double share, double rest) {
  const Motion twist = calibrated(model, moved), part = times(share, twist);
  if (!moved.covariance) {
    const double way = pack::copysign(elementary::hypot(part.forward, part.left), part.forward);
    return arc(part, way, noises_of(model, share * moved.duration_s, way, part.turn));
  }
  Matrix3 C = sandwiched(se2::adjoint(se2::exponential(times(rest, twist))), *moved.covariance);
  for (auto& row : C.entries)
    for (double& x : row) x = model.covariance_factor * share * x;
  return {se2::exponential(part), symmetric(C)};
}

Point<double> forward_column(const Model& model, const Moved& moved, double share) {
  const double speed = elementary::hypot(moved.twist.forward, moved.twist.left) / moved.duration_s;
  if (model.has_known_scale(speed)) return {0.0, 0.0};
  const auto [x, y, turn] = times(share, calibrated(model, moved));
  const auto [s, c] = elementary::sin_cos(0.5 * turn);
  return {c * x + s * y, c * y - s * x};
}

}  // namespace teamslam::motion
