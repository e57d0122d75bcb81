#include "open_window.hpp"

#include <algorithm>

namespace teamslam::window {

OpenWindow::OpenWindow(const Settings& settings, Consensus gate, const random::Random& random)
    : window_(settings), gate_(std::move(gate)), first_(random), random_(random) {}

bool OpenWindow::admit(const Increment& increment, const Scan& scan, std::optional<std::int64_t> node_ns) {
  motion::Increment motion{{increment.mean.forward, increment.mean.left, increment.mean.turn}};
  std::copy(increment.covariance.begin(), increment.covariance.end(), motion.covariance.entries[0]);
  gate_.add(motion, scan);
  begins_.push_back(gate_.size());
  if (!gate_.accept()) return false;
  const std::optional<std::vector<bool>> accepted = this->accepted(begins_.size() - 2);
  if (!accepted) {
    take(increment, scan, node_ns);
    return true;
  }
  std::vector<std::uint32_t> ids;
  std::vector<double> ranges, bearings;
  std::vector<Claim> claims;
  for (std::size_t k = 0; k < scan.ids.size(); k++) {
    if (!(*accepted)[k]) continue;
    ids.push_back(scan.ids[k]);
    ranges.push_back(scan.ranges[k]);
    bearings.push_back(scan.bearings[k]);
    if (!scan.claims.empty()) claims.push_back(scan.claims[k]);
  }
  take(increment, {ids, ranges, bearings, claims}, node_ns);
  return true;
}

std::optional<std::vector<bool>> OpenWindow::accepted(std::size_t keyframe) const {
  if (keyframe >= begins_.size() - 1) throw std::invalid_argument("there is no such keyframe");
  const std::vector<bool>& all = gate_.accepted();
  const auto begin = all.begin() + std::ptrdiff_t(begins_[keyframe]), end = all.begin() + std::ptrdiff_t(begins_[keyframe + 1]);
  if (std::find(begin, end, false) == end) return std::nullopt;
  return std::vector<bool>(begin, end);
}

std::size_t OpenWindow::rejected() const {
  return std::size_t(std::count(gate_.accepted().begin(), gate_.accepted().end(), false));
}

void OpenWindow::begin(std::size_t particles) {
  Settings settings = window_.settings();
  settings.particles = particles;
  window_ = Window(settings);
  random_ = first_;
  least_effective_ = elementary::INF;
}

void OpenWindow::take(const Increment& increment, const Scan& scan, std::optional<std::int64_t> node_ns) {
  window_.advance(increment, scan, random_);
  least_effective_ = std::min(least_effective_, window_.effective());
  if (node_ns) window_.mark(*node_ns);
}

}  // namespace teamslam::window
