// Quantiles of χ²: the inverse of the incomplete gamma function.
#pragma once

#include <optional>
#include <span>

namespace teamslam::chi2 {

// The value that χ² exceeds with the probability above = 1 − below; NaN for less than one degree of
// freedom. Both probabilities are between 0 and 1.
double quantile(double below, double above, double dof);

// value: the scale s of terms s χ²(dof), their weighted median. total: the sum of their dof.
struct Scale {
  double value, total;
};

// Of the terms of at least one degree of freedom; none without such a term. squares: the terms. medians:
// of χ²(dof). The median of the ratios, weighted by dof, is interpolated between the middles of their weights.
std::optional<Scale> estimate_scale(std::span<const double> squares, std::span<const double> dof,
                                    std::span<const double> medians);

}  // namespace teamslam::chi2
