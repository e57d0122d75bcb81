#include "open_window.hpp"

#include <algorithm>

namespace teamslam::window {

OpenWindow::OpenWindow(const Settings& settings, Consensus gate, const random::Random& random, const se2::Pose<double>& mount,
                       std::size_t most_landmarks)
    : window_(settings), gate_(std::move(gate)), mount_(mount), most_landmarks_(most_landmarks), first_(random), random_(random) {}

void OpenWindow::advance(Keyframe keyframe) {
  if (is_solvable_ && keyframe.seen.is_finite()) keep_nearest(keyframe);
  keyframes_.push_back(std::move(keyframe));
  if (!is_solvable_) return;
  try {
    admit(keyframes_.back());
  } catch (const MotionError&) {
    is_solvable_ = false;
  }
}

void OpenWindow::admit(const Keyframe& keyframe) {
  if (!keyframe.seen.is_finite()) throw MotionError("not finite");
  gate_.add(keyframe.motion, keyframe.seen.view());
  begins_.push_back(gate_.size());
  if (!gate_.accept()) return restart(accepted(), window_.settings().particles);
  const std::vector<bool> taken = accepted(begins_.size() - 2);
  if (std::find(taken.begin(), taken.end(), false) == taken.end()) return take(keyframe);
  Keyframe agreeing = keyframe;
  agreeing.seen = keyframe.seen.only(taken);
  take(agreeing);
}

// Drops the farthest new landmarks beyond a submap's limit.
void OpenWindow::keep_nearest(Keyframe& keyframe) const {
  const Measurements& seen = keyframe.seen;
  const std::vector<std::uint32_t>& known = window_.particles().ids;
  if (known.size() + seen.size() <= most_landmarks_) return;
  const auto is_in = [](const std::vector<std::uint32_t>& ids, std::uint32_t id) { return std::find(ids.begin(), ids.end(), id) != ids.end(); };
  std::map<std::uint32_t, double> range_of;  // of the first measurement of each new landmark
  for (std::size_t k = 0; k < seen.size(); k++)
    if (!is_in(known, seen.ids[k])) range_of.emplace(seen.ids[k], seen.ranges[k]);
  std::vector<std::uint32_t> nearest;
  for (const auto& [id, range] : range_of) nearest.push_back(id);
  std::stable_sort(nearest.begin(), nearest.end(), [&](std::uint32_t a, std::uint32_t b) { return range_of[a] < range_of[b]; });
  nearest.resize(std::min(nearest.size(), most_landmarks_ - std::min(most_landmarks_, known.size())));
  std::vector<bool> taken(seen.size());
  for (std::size_t k = 0; k < seen.size(); k++) taken[k] = is_in(known, seen.ids[k]) || is_in(nearest, seen.ids[k]);
  keyframe.seen = seen.only(taken);
}

void OpenWindow::move(const Keyframe& rest) {
  const auto is_zero = [](double x) { return x == 0.0; };
  const auto& [x, y, heading] = rest.motion.mean;
  const double* covariance = rest.motion.covariance.entries[0];
  if (is_zero(x) && is_zero(y) && is_zero(heading) && std::all_of(covariance, covariance + 9, is_zero)) return;
  rest_ = rest.motion;
  if (!is_solvable_) return;
  try {
    window_.move(rest.increment(), random_);
  } catch (const MotionError&) {
    is_solvable_ = false;
  }
}

std::vector<bool> OpenWindow::accepted(std::size_t keyframe) const {
  const auto begin = gate_.accepted().begin();
  return {begin + std::ptrdiff_t(begins_[keyframe]), begin + std::ptrdiff_t(begins_[keyframe + 1])};
}

std::vector<Keyframe> OpenWindow::accepted() const {
  std::vector<Keyframe> chosen(keyframes_.begin(), keyframes_.begin() + std::ptrdiff_t(begins_.size() - 1));
  for (std::size_t k = 0; k < chosen.size(); k++) chosen[k].seen = chosen[k].seen.only(accepted(k));
  return chosen;
}

std::size_t OpenWindow::rejected() const {
  return std::size_t(std::count(gate_.accepted().begin(), gate_.accepted().end(), false));
}

void OpenWindow::restart(std::span<const Keyframe> keyframes, std::size_t particles) {
  Settings settings = window_.settings();
  settings.particles = particles;
  window_ = Window(settings);
  random_ = first_;
  least_effective_ = elementary::INF;
  restarts_++;
  for (const Keyframe& each : keyframes) {
    if (!each.seen.is_finite()) throw MotionError("not finite");
    take(each);
  }
}

void OpenWindow::take(const Keyframe& keyframe) {
  window_.advance(keyframe.increment(), keyframe.seen.view(), random_);
  least_effective_ = std::min(least_effective_, window_.effective());
  if (keyframe.is_node) window_.mark(keyframe.stamp_ns);
}

motion::Increment OpenWindow::base_motion() const {
  const bool is_mounted = window_.settings().mount.is_mounted();
  motion::Increment whole;
  const auto append = [&](const motion::Increment& step) {
    whole = motion::compose(whole, motion::Step(is_mounted ? motion::of_sensor(step, se2::inverse(mount_)) : step));
  };
  for (const Keyframe& each : keyframes_) append(each.motion);
  if (rest_) append(*rest_);
  return whole;
}

}  // namespace teamslam::window
