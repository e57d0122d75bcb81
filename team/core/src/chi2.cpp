// χ² of n degrees of freedom does not exceed x with the probability P(n/2, x/2), the regularised
// incomplete gamma function: a series below its middle, a continued fraction of 1 − P above it (Press
// et al. 2007, section 6.2). Its inverse is found by Halley's steps within a bracket, to some 1e-15.
#include "chi2.hpp"

#include <algorithm>
#include <utility>
#include <vector>

#include "elementary.hpp"
#include "linalg.hpp"

namespace teamslam::chi2 {

namespace {

constexpr double LARGE = 16.0;  // shape from which Stirling's series gives Γ to the last place
constexpr int MOST_TERMS = 100000, MOST_STEPS = 200;
constexpr double PRECISE = 1e-16;
constexpr double SETTLED = 1e-9;  // relative length of the last step: the next one would be shorter than rounding

struct Tails {
  double below, above, density;
};

// xᵃ e⁻ˣ / Γ(a + 1), without the cancellation of its large factors (x near a).
double scale_of(double a, double x) {
  double shape = a, factor = 1.0;
  while (shape < LARGE) {
    shape += 1.0;
    factor *= shape / x;
  }
  const double away = (x - shape) / shape, inverse = 1.0 / (shape * shape);
  const double series =
      1.0 / 12.0 -
      inverse * (1.0 / 360.0 -
                 inverse * (1.0 / 1260.0 - inverse * (1.0 / 1680.0 - inverse * (1.0 / 1188.0 - inverse / 521.5))));
  const double stirling = series / shape;
  const double ratio = away > -0.5 ? elementary::log1p(away) : elementary::log(x / shape);
  const double exponent = shape * (ratio - away) - stirling;
  return factor * elementary::exp(exponent) / pack::sqrt(2.0 * elementary::PI * shape);
}

// P(a, x), 1 − P(a, x) and dP/dx.
Tails tails(double a, double x) {
  const double scale = scale_of(a, x);
  if (x < a + 1.0) {
    double term = 1.0, total = 1.0;
    for (int k = 1; k < MOST_TERMS; k++) {
      term *= x / (a + k);
      total += term;
      if (term < PRECISE * total) break;
    }
    return {scale * total, 1.0 - scale * total, scale * a / x};
  }
  double b = x + 1.0 - a, c = elementary::INF, d = 1.0 / b, fraction = d;
  for (int k = 1; k < MOST_TERMS; k++) {
    const double numerator = k * (a - k);
    b += 2.0;
    d = 1.0 / (b + numerator * d);
    c = b + numerator / c;
    fraction *= d * c;
    if (pack::abs(d * c - 1.0) < PRECISE) break;
  }
  const double above = scale * a * fraction;
  return {1.0 - above, above, scale * a / x};
}

}  // namespace

double quantile(double below, double above, double dof) {
  if (!(dof >= 1.0)) return elementary::NOT_A_NUMBER;
  const double a = 0.5 * dof;
  double low = 0.0, high = elementary::INF;
  const double t = pack::sqrt(-2.0 * elementary::log(pack::min(below, above)));
  const double normal = t - (2.30753 + 0.27061 * t) / (1.0 + t * (0.99229 + 0.04481 * t));
  const double cube = 1.0 - 1.0 / (9.0 * a) + pack::copysign(normal, below - above) / (3.0 * pack::sqrt(a));
  double x = cube > 0.1 ? a * cube * cube * cube : elementary::exp(elementary::log(below) / a);
  for (int k = 0; k < MOST_STEPS; k++) {  // P(a, x) = below, by the smaller of the two tails
    const Tails at = tails(a, x);
    const double error = below <= above ? at.below - below : above - at.above;
    (error > 0.0 ? high : low) = x;
    double step = error / at.density;
    step /= pack::max(1.0 - 0.5 * step * ((a - 1.0) / x - 1.0), 0.5);
    if (pack::abs(step) <= SETTLED * x) return 2.0 * (x - step);
    x -= step;
    if (!(low < x && x < high)) x = high == elementary::INF ? 2.0 * low : 0.5 * (low + high);
  }
  return 2.0 * x;
}

std::optional<Scale> estimate_scale(std::span<const double> squares, std::span<const double> dof,
                                    std::span<const double> medians) {
  std::vector<double> weights;
  std::vector<std::pair<double, double>> terms;  // ratio and weight
  for (std::size_t k = 0; k < dof.size(); k++)
    if (dof[k] >= 1.0) {
      weights.push_back(dof[k]);
      terms.emplace_back(squares[k] / medians[k], dof[k]);
    }
  if (terms.empty()) return {};
  std::stable_sort(terms.begin(), terms.end(),  // what is not a number comes last
                   [](const auto& a, const auto& b) { return a.first < b.first || (a.first == a.first && b.first != b.first); });
  const double total = linalg::pairwise_sum(weights), half = 0.5 * total;
  double sum = 0.0, middle = 0.0, ratio = terms[0].first;
  for (std::size_t k = 0; k < terms.size(); k++) {
    const auto [next_ratio, weight] = terms[k];
    sum += weight;
    const double next = sum - 0.5 * weight;
    if (half <= next) {
      if (k == 0 || half == next) return Scale{next_ratio, total};
      const double slope = (next_ratio - ratio) / (next - middle);
      return Scale{slope * (half - middle) + ratio, total};
    }
    middle = next;
    ratio = next_ratio;
  }
  return Scale{ratio, total};
}

}  // namespace teamslam::chi2
