// A submap as a factor between its start pose, its other poses and its landmarks.
//
// For a submap that starts at pose s, has the poses e (its end, then its pose nodes) and observes
// landmarks l, with the rotation R of the heading of s,
//
//     r = (Rᵀ(p_e − p_s), wrap(θ_e − θ_s), …, Rᵀ(l₁ − p_s), …) − mean ~ N(0, P).
//
// In the map frame, r' = T r with T = blkdiag(R, 1, …, R, …), its Jacobian is the identity for (e, …,
// l₁, …) and
//
//     G = [−I | (v_y, −v_x)ᵀ] per point v = p − p_s,  [0 0 −1] for the heading
//
// for s, and its metric is M = T P⁻¹ Tᵀ. The state is additive in (x, y, θ).
//
// A submap with sensitivities S and curvatures D (a row per bias) has the mean
// mean + Σ_b (S_b b + ½ D_b b²); the Jacobian of r' for a bias is −T (S_b + D_b b). Its biases, one number
// each, follow the other members.
#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "dense.hpp"
#include "se2.hpp"

namespace teamslam::graph {

using Index = std::int64_t;
using Indices = std::span<const Index>;
using Values = std::span<const double>;
using Numbers = std::vector<double>;

// The largest ratio of a landmark's distance in the joined map to the measured one, and of its
// inverse. A landmark beyond it is an outlier, whose covariance must not grow with the distance.
inline constexpr double LARGEST_RATIO = 1.25;
// The largest angle [rad] between a landmark's direction in the joined map and the measured one.
inline constexpr double LARGEST_TURN = 0.2;
// The power of a landmark's range with which a bias moves it that moves no landmark.
inline constexpr Index NO_POWER = -1;

// JᵀP⁻¹J, JᵀP⁻¹r and χ² = rᵀP⁻¹r over a factor's members.
struct Normal {
  dense::Matrix hessian;
  Numbers gradient;
  double chi2;
};

// r' in the map frame, and v = p − p_s of each point, the end pose first.
struct Residual {
  Numbers numbers;
  std::vector<se2::Point<double>> from_start;
};

// at: the index in the state of the first number of each member: the start pose, the other poses,
// the landmarks, the biases.
struct Submap {
  Numbers mean;                                // of (poses, landmarks)
  dense::Matrix information;                   // P⁻¹
  std::vector<se2::Spread<double>> landmarks;  // each one's own covariance
  dense::Matrix sensitivity;                   // a row per bias
  std::vector<Index> range_power;              // of each row, the power of a landmark's range, 0, 1 or NO_POWER
  dense::Matrix curvature;                     // a row per bias; no rows where all are zero
  bool is_measured = true;                     // false: a saved map, whose errors belong to no range

  std::size_t size() const { return mean.size(); }
  std::size_t biases() const { return range_power.size(); }
  std::size_t poses() const { return (size() - 2 * landmarks.size()) / 3; }
  std::size_t points() const { return poses() + landmarks.size(); }  // but for the start
  std::size_t members() const { return 1 + points() + biases(); }
  std::size_t unknowns() const { return 3 + size() + biases(); }
  std::size_t row_of(std::size_t point) const { return point < poses() ? 3 * point : 2 * point + poses(); }

  Numbers shifted_mean(Values state, Indices at) const;  // mean + Σ_b (S_b b + ½ D_b b²)
  Residual residual(Values state, Indices at) const;
  Normal normal(Values state, Indices at) const;
  double chi2(Values state, Indices at) const;
  // r_lᵀ (factor · P_ll)⁻¹ r_l of each landmark.
  void landmark_chi2(Values state, Indices at, double factor, std::span<double> to) const;

  // The same with its noise at the ranges of the joined map, for errors proportional to the range.
  //
  // q is the distance of a landmark, in the state, from the submap's viewpoint (the middle of its
  // poses), over the measured distance, and φ the angle between the two. The landmark's errors are
  // rotated by φ and multiplied by q, P' = T P Tᵀ with T = blkdiag(1, …, q R(φ), …), and its
  // derivatives by the sensor's errors are those at its place in the map: S' = qᵏ R(φ) S with k = 0
  // for an offset of ranges and 1 for their scale.
  //
  // With the noise of the measured distance d(1 + e) instead, a measurement that came out short
  // weighs more, by (1 + e)⁻² (Peelle's puzzle); and where the scale b of the ranges is a state, the
  // noise (e along, ε across) couples to itself: a map and all ranges that are smaller by s have a
  // χ² that is smaller by 2 s for each measured number. Both make maps smaller, the second by more
  // the more submaps there are.
  Submap at_joined_ranges(Values state, Indices at) const;

  // The same with (P + blkdiag(0, (1/w_l − 1) P_ll))⁻¹: a landmark of weight w_l counts as if its own
  // covariance were that much larger. By Woodbury's identity, one landmark after the other.
  Submap discounted(Values weights) const;

 private:
  double bias(Values state, Indices at, std::size_t b) const { return state[at[1 + points() + b]]; }
  // S + D b, the derivative of the mean by each bias at a state.
  dense::Matrix sensitivity_at(Values state, Indices at) const;
  Residual residual_of(const Numbers& shifted, Values state, Indices at) const;
  Normal unbiased_normal(const Numbers& shifted, Values state, Indices at) const;
};

// χ² beyond which a factor of `dimension` numbers is discounted; a sound one exceeds it with a
// probability below e⁻⁷ (Laurent & Massart 2000, lemma 1).
inline double gate_of(double dimension, double scale) {
  return (dimension + 2.0 * pack::sqrt(7.0 * dimension) + 14.0) * scale * scale;
}

// The loss is χ² up to the gate g and g (2 − g/χ²) beyond. Its slope, the weight, is (g/χ²)² there, so
// that the pull of an outlier falls with the third power of its distance.
inline double robust_weight(double chi2, double gate) { return chi2 > gate ? (gate / chi2) * (gate / chi2) : 1.0; }
inline double robust_loss(double chi2, double gate) { return chi2 > gate ? gate * (2.0 - gate / chi2) : chi2; }

}  // namespace teamslam::graph
