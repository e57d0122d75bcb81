#include "window.hpp"

namespace teamslam::window {

namespace {

Lower3 factor_of(const Increment& increment) {
  const auto& [mean, covariance, shift, seconds] = increment;
  const Lower3 L = linalg::semidefinite_factor(covariance);
  if (!L.is_finite()) throw MotionError("not positive semi-definite");
  if (!std::isfinite(mean.forward) || !std::isfinite(mean.left) || !std::isfinite(mean.turn))
    throw MotionError("not finite");
  return L;
}

// Poses of the sensor become those of the base, in place; three rows each.
void move_poses(const se2::Mount& mount, Rows& poses) {
  for (std::size_t j = 0; j < poses.rows(); j += 3)
    for (std::size_t i = 0; i < poses.stride(); i++) {
      const auto [x, y, heading] = mount.base_pose({poses[j][i], poses[j + 1][i], poses[j + 2][i]});
      poses[j][i] = x;
      poses[j + 1][i] = y;
      poses[j + 2][i] = heading;
    }
}

// Landmarks from the sensor's start become those from the base's, in place; five rows each.
void move_landmarks(const se2::Mount& mount, Rows& map) {
  for (std::size_t j = 0; j < map.rows(); j += 5)
    for (std::size_t i = 0; i < map.stride(); i++) {
      const auto [x, y] = mount.base_point({map[j][i], map[j + 1][i]});
      const auto [xx, xy, yy] = mount.base_spread({map[j + 2][i], map[j + 3][i], map[j + 4][i]});
      map[j][i] = x;
      map[j + 1][i] = y;
      map[j + 2][i] = xx;
      map[j + 3][i] = xy;
      map[j + 4][i] = yy;
    }
}

}  // namespace

Window::Window(const Settings& settings)
    : settings_(settings),
      particles_(settings.particles),
      path_(settings.particles),
      solved_(settings.particles),
      effective_(effective_sample_size({particles_.log_weights.data(), settings.particles})) {}

std::vector<Reading> Window::readings_of(const Scan& scan) const {
  check_of_sensor();
  std::vector<Reading> readings;
  readings.reserve(scan.ids.size());
  for (std::size_t k = 0; k < scan.ids.size(); k++)
    readings.push_back(models::reading_of(scan.ranges[k], scan.bearings[k], settings_.noise, scan.claim(k)));
  return readings;
}

std::vector<std::size_t> Window::slots_of(const Scan& scan) const {
  std::vector<std::size_t> slots;
  slots.reserve(scan.ids.size());
  for (const std::uint32_t id : scan.ids) slots.push_back(particles_.slot_of(id));
  return slots;
}

Innovation Window::innovation(const Increment& increment, const Scan& scan) const {
  const Lower3 L = factor_of(increment);
  return innovation_of(particles_, increment.mean, L, slots_of(scan), readings_of(scan));
}

Step Window::advance(const Increment& increment, const Scan& scan, double uniform, std::span<const double> normals) {
  const Lower3 L = factor_of(increment);
  const std::vector<Reading> readings = readings_of(scan);
  const Innovation innovation = innovation_of(particles_, increment.mean, L, slots_of(scan), readings);
  if (uniform >= 0.0) particles_.resample(uniform, {&path_, &solved_});
  const double log_evidence = take(increment, L, scan, readings, normals);
  return {effective_, log_evidence, innovation.squared, innovation.error.size()};
}

Step Window::advance(const Increment& increment, const Scan& scan, random::Random& random) {
  const bool is_thin = effective_ < settings_.resample_below * double(settings_.particles);
  const double uniform = is_thin ? random.uniform() : NO_RESAMPLING;
  const Step step = advance(increment, scan, uniform, random.normals(3 * settings_.particles));
  if (std::isfinite(step.squared)) {
    innovated_.squared += step.squared;
    innovated_.dof += step.dof;
  }
  return step;
}

double Window::step(const Increment& increment, const Scan& scan, std::span<const double> normals) {
  return take(increment, factor_of(increment), scan, readings_of(scan), normals);
}

void Window::keep(const Increment& increment) {
  WindowMotion& motion = motions_.emplace_back();
  for (std::size_t i = 0; i < 9; i++) motion.covariance[i / 3][i % 3] = increment.covariance[i];
  motion.shift = increment.shift;
  motion.seconds = increment.seconds;
}

double Window::take(const Increment& increment, const Lower3& L, const Scan& scan, std::span<const Reading> readings,
                    std::span<const double> normals) {
  particles_.step(increment.mean, L, settings_.is_improved, particles_.find(scan.ids, readings), normals);
  const std::span<double> log_weights(particles_.log_weights.data(), particles_.count());
  const double log_evidence = normalise(log_weights);
  effective_ = effective_sample_size(log_weights);
  is_solved_.resize(particles_.landmarks());
  for (std::size_t k = 0; k < scan.ids.size(); k++) {
    measurements_.push_back({scan.ids[k], keyframes(), scan.ranges[k], scan.bearings[k], scan.claim(k)});
    is_solved_[particles_.slot_of(scan.ids[k])] = false;
  }
  path_.append(particles_.pose);
  keep(increment);
  return log_evidence;
}

void Window::move(const Increment& increment, std::span<const double> normals) {
  const Lower3 L = factor_of(increment);
  const std::vector<double> log_weights = particles_.log_weights;
  particles_.step(increment.mean, L, false, {}, normals);
  particles_.log_weights = log_weights;
  keep(increment);
}

void Window::mark(std::int64_t stamp_ns) {
  if (!keyframes()) throw std::out_of_range("a pose node needs a keyframe");
  nodes_.push_back(keyframes() - 1);
  node_stamps_.push_back(stamp_ns);
}

std::vector<se2::Pose<double>> Window::mean_path() const {
  const std::vector<double> weights = weights_of({particles_.log_weights.data(), particles_.count()});
  std::vector<se2::Pose<double>> found;
  for (std::size_t k = 0; k < keyframes(); k++) found.push_back(mean_pose(path_, 3 * k, weights));
  return found;
}

void Window::replace(Particles particles, Rows path) {
  particles_ = std::move(particles);
  path_ = std::move(path);
  is_solved_.assign(particles_.landmarks(), false);
  effective_ = effective_sample_size({particles_.log_weights.data(), particles_.count()});
}

void Window::check_of_sensor() const {
  if (is_of_base_) throw std::invalid_argument("the window of a base has no measurements of its own");
}

Window Window::of_base() const {
  Window based = *this;
  if (settings_.mount.is_mounted()) {
    move_poses(settings_.mount, based.particles_.pose);
    move_poses(settings_.mount, based.path_);
    move_landmarks(settings_.mount, based.particles_.map);
    based.settings_.mount = {};
    based.is_of_base_ = true;
  }
  return based;
}

const Rows& Window::solve_landmarks() {
  check_of_sensor();
  solved_.resize(particles_.map.rows());
  for (std::size_t slot = 0; slot < particles_.landmarks(); slot++) {
    if (!is_solved_[slot])
      solve_along_paths(particles_.ids[slot], slot, particles_.map, path_, measurements_, settings_.noise, solved_);
    is_solved_[slot] = true;
  }
  return solved_;
}

Gaussian Window::run() { return gaussian(false, settings_.noise.is_white() ? particles_.map : solve_landmarks()); }

Gaussian Window::gaussian(bool with_nodes, const Rows& landmarks) const {
  check_of_sensor();
  Rows poses = particles_.pose;
  if (with_nodes)
    for (const std::size_t keyframe : nodes_) {
      Rows node(poses.count(), 3);
      for (std::size_t k = 0; k < 3; k++) node.set(k, path_[3 * keyframe + k], 1);
      poses.append(node);
    }
  const std::span<const double> log_weights(particles_.log_weights.data(), particles_.count());
  if (!settings_.mount.is_mounted()) return submap_moments(poses, log_weights, particles_.ids, landmarks);
  Rows of_base = landmarks;
  move_poses(settings_.mount, poses);
  move_landmarks(settings_.mount, of_base);
  return submap_moments(poses, log_weights, particles_.ids, of_base);
}

}  // namespace teamslam::window
