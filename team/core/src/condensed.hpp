// Old factors as one quadratic cost over the nodes that remain, and the landmarks at rest given these.
#pragma once

#include <optional>

#include "submap_factor.hpp"

namespace teamslam::graph {

// cost + 2 slopeᵀ d + dᵀ information d.
struct Summed {
  dense::Matrix information;
  Numbers slope;
  double cost = 0.0;
};

// A quadratic of which some numbers were eliminated by Schur's complement: x = step + gain d + e with
// e ~ N(0, (L Lᵀ)⁻¹), for the d of the others, whose quadratic is `rest`. at: the places of both.
struct Elimination {
  std::vector<std::size_t> eliminated, remaining;
  Summed rest;
  dense::Matrix factor, gain;
  Numbers step;
};

// None where the quadratic does not determine these numbers.
std::optional<Elimination> eliminate(Summed&& sum, const std::vector<bool>& is_eliminated);

// Landmarks in no factor of the graph, two numbers each: x ~ N(means + gain d, covariance), d as of
// `Quadratic`. covariance: its upper triangle, row by row.
struct Resting {
  Numbers means;
  dense::Matrix gain;  // a row for each number
  Numbers covariance;

  double variance(std::size_t i, std::size_t j) const {
    return i <= j ? covariance[i * means.size() - i * (i + 1) / 2 + j] : variance(j, i);
  }
  // The upper triangle among some ascending numbers plus that of A B, in one of `size` rows.
  Numbers spread_among(std::span<const std::size_t> among, std::size_t size, dense::Const A, dense::Const B) const;
};

// Linearised factors: cost(x) = cost + 2 slopeᵀ d + dᵀ information d, d = x − at with headings wrapped,
// over some nodes, none of them fixed.
struct Quadratic : Summed {
  struct Terms {
    double cost = 0.0;
    Numbers slope;  // half of the derivative
  };

  std::vector<Index> nodes;
  Numbers at;
  std::vector<bool> is_heading;
  Resting resting;

  // d; numbers: the places of the nodes' numbers in the state.
  Numbers difference(Values state, Indices numbers) const;
  Terms terms(Values state, Indices numbers) const;

  // The same with some landmarks at rest, by ascending place, as nodes. With e = x − means − gain d ~ N(0, C)
  // it gains eᵀ C⁻¹ e, and the others at rest are conditioned on it. None where C is not positive definite.
  std::optional<Quadratic> woken(std::span<const std::size_t> places, Indices as_nodes) const;

  // Puts the landmarks at these places of `parts.eliminated` to rest, those of `before` staying.
  //
  // of_before: the place of each of before's numbers in both parts. difference: d of before. points: the
  // landmarks' numbers at the linearisation.
  void rest(const Quadratic* before, const Elimination& parts, std::span<const std::size_t> of_before,
            std::span<const double> difference, std::span<const std::size_t> rests, const Numbers& points);
};

}  // namespace teamslam::graph
