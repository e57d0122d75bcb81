// Covariance matrices: their faults, and their factors.
#pragma once

#include "dense.hpp"
#include "elementary.hpp"

namespace teamslam::gaussian {

// Why a matrix is no covariance; the index in teamslam.team.estimation.gaussian.FAULTS.
enum class Fault : int { NONE = 0, NOT_FINITE = 1, NOT_POSITIVE = 2, NOT_SYMMETRIC = 3 };

// The fault of a matrix that shows without a factor; sigmas: the roots of its diagonal, where it is positive.
Fault fault_of(dense::Const P, std::span<double> sigmas);

struct Factor {
  dense::Matrix L;  // lower, L Lᵀ = P; empty where there is none
  Fault fault;
};

// Rank is judged by the diagonal's scale: a pivot that is no more than n ε of its diagonal entry is
// rounding of a singular matrix.
Factor factor_or_fault(dense::Const P);

// The least and the largest standard deviation of coordinates and of headings; where there are none the
// largest is 0. independent: the least share of a number's variance that the others leave, at most 1; 0
// where the matrix is not positive definite.
struct Spread {
  struct Sigmas {
    double least = elementary::INF, most = 0.0;
  };
  Sigmas coordinates, headings;
  double independent;
};
// None where a variance is not positive.
std::optional<Spread> spread_of(dense::Const P, std::span<const bool> is_heading);

// The covariance of (x, y, θ) about pose ∘ Exp(ξ), ξ = (f, l, φ) ~ N(0, S), to second order:
// E[φ²l²]/4 = (S_φφ S_ll + 2 S_lφ²)/4 is added to the variance of f, and so on.
dense::Matrix curved(double heading, dense::Const P);

}  // namespace teamslam::gaussian
