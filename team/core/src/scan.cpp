#include "scan.hpp"

#include <algorithm>

#include "linalg.hpp"

namespace teamslam::scan {

namespace {

double middle_of(const std::vector<double>& ordered) {
  return 0.5 * (ordered[(ordered.size() - 1) / 2] + ordered[ordered.size() / 2]);
}

double median(std::vector<double> values) {
  std::sort(values.begin(), values.end());
  return middle_of(values);
}

double chi2(const Observed& observed, std::size_t k, double x0, double y0) {
  const double x = observed.points[k][0] - x0, y = observed.points[k][1] - y0;
  const double *spread = observed.spread[k], xx = spread[0], xy = spread[1], yy = spread[2];
  const double found = (yy * x * x - 2.0 * xy * x * y + xx * y * y) / (xx * yy - xy * xy);
  return found > observed.most ? observed.most : found;
}

// Medians of the first 1, 2, … of some numbers.
class Running {
 public:
  double add(double value) {
    ordered_.insert(std::upper_bound(ordered_.begin(), ordered_.end(), value), value);
    return middle_of(ordered_);
  }

 private:
  std::vector<double> ordered_;
};

}  // namespace

std::vector<double> scatter(const Observed& observed, std::span<const Index> of, std::size_t count) {
  std::vector<std::vector<std::size_t>> own(count);
  for (std::size_t k = 0; k < of.size(); k++) own[of[k]].push_back(k);
  std::vector<double> found(count), x, y;
  for (std::size_t landmark = 0; landmark < count; landmark++) {
    if (own[landmark].empty()) continue;
    x.clear(), y.clear();
    for (const std::size_t k : own[landmark]) {
      x.push_back(observed.points[k][0]);
      y.push_back(observed.points[k][1]);
    }
    const double x0 = median(x), y0 = median(y);
    for (const std::size_t k : own[landmark]) found[landmark] += chi2(observed, k, x0, y0);
  }
  return found;
}

std::optional<Change> change(const Observed& observed, std::size_t least) {
  const std::size_t n = observed.points.rows;
  if (n < 2 * least) return {};
  std::vector<double> before_x(n), before_y(n), behind_x(n), behind_y(n), terms(n);
  Running first_x, first_y, last_x, last_y;
  for (std::size_t k = 0; k < n; k++) {
    const std::size_t back = n - 1 - k;
    before_x[k] = first_x.add(observed.points[k][0]);
    before_y[k] = first_y.add(observed.points[k][1]);
    behind_x[back] = last_x.add(observed.points[back][0]);
    behind_y[back] = last_y.add(observed.points[back][1]);
  }
  const auto sum = [&](std::size_t begin, std::size_t end, double x, double y) {
    for (std::size_t k = begin; k < end; k++) terms[k] = chi2(observed, k, x, y);
    return linalg::pairwise_sum(std::span(terms).subspan(begin, end - begin));
  };
  const double one = sum(0, n, before_x[n - 1], before_y[n - 1]);
  std::optional<Change> best;
  for (std::size_t at = least; at + least <= n; at++) {
    const double two = sum(0, at, before_x[at - 1], before_y[at - 1]) + sum(at, n, behind_x[at], behind_y[at]);
    if (!best || one - two > best->gain) best = {Index(at), one - two};
  }
  return best;
}

}  // namespace teamslam::scan
