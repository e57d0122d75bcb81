// Quantiles of χ²: the inverse of the incomplete gamma function.
#pragma once

namespace teamslam::chi2 {

// The value that χ² exceeds with the probability above = 1 − below; NaN for less than one degree of
// freedom. Both probabilities are between 0 and 1.
double quantile(double below, double above, double dof);

}  // namespace teamslam::chi2
