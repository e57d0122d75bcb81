#include "window.hpp"

namespace teamslam::window {

namespace {

Lower3 factor_of(const Increment& increment) {
  const auto& [mean, covariance] = increment;
  const Lower3 L = linalg::semidefinite_factor(covariance);
  if (!L.is_finite()) throw MotionError("not positive semi-definite");
  if (!std::isfinite(mean.forward) || !std::isfinite(mean.left) || !std::isfinite(mean.turn))
    throw MotionError("not finite");
  return L;
}

}  // namespace

Window::Window(const Settings& settings)
    : settings_(settings),
      particles_(settings.particles),
      path_(settings.particles),
      effective_(effective_sample_size({particles_.log_weights.data(), settings.particles})) {}

std::vector<Reading> Window::readings_of(const Scan& scan) const {
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
  if (uniform >= 0.0) particles_.resample(uniform, path_);
  const std::vector<Sighting> found = particles_.find(scan.ids, readings);
  particles_.step(increment.mean, L, settings_.is_improved, found, normals);
  const std::span<double> log_weights(particles_.log_weights.data(), particles_.count());
  const double log_evidence = normalise(log_weights);
  effective_ = effective_sample_size(log_weights);
  for (std::size_t k = 0; k < scan.ids.size(); k++)
    sights_.push_back({scan.ids[k], keyframes(), scan.ranges[k], scan.bearings[k], scan.claim(k)});
  path_.append(particles_.pose);
  return {effective_, log_evidence, innovation.squared, innovation.error.size()};
}

void Window::move(const Increment& increment, std::span<const double> normals) {
  const Lower3 L = factor_of(increment);
  const std::vector<double> log_weights = particles_.log_weights;
  particles_.step(increment.mean, L, false, {}, normals);
  particles_.log_weights = log_weights;
}

void Window::mark() {
  if (!keyframes()) throw std::out_of_range("a pose node needs a keyframe");
  nodes_.push_back(keyframes() - 1);
}

void Window::replace(Particles particles, Rows path) {
  particles_ = std::move(particles);
  path_ = std::move(path);
  effective_ = effective_sample_size({particles_.log_weights.data(), particles_.count()});
}

Rows Window::solved_landmarks() const {
  return landmarks_along_paths(particles_.ids, particles_.map, path_, sights_, settings_.noise);
}

Gaussian Window::run() const { return gaussian(false, settings_.noise.is_white() ? particles_.map : solved_landmarks()); }

Gaussian Window::gaussian(bool with_nodes, Rows landmarks) const {
  Rows poses = particles_.pose;
  if (with_nodes)
    for (const std::size_t keyframe : nodes_) {
      Rows node(poses.count(), 3);
      for (std::size_t k = 0; k < 3; k++) node.set(k, path_[3 * keyframe + k], 1);
      poses.append(node);
    }
  const se2::Mount& mount = settings_.mount;
  if (mount.is_mounted()) {
    for (std::size_t j = 0; j < poses.rows(); j += 3)
      for (std::size_t i = 0; i < poses.stride(); i++) {
        const auto [x, y, heading] = mount.base_pose({poses[j][i], poses[j + 1][i], poses[j + 2][i]});
        poses[j][i] = x;
        poses[j + 1][i] = y;
        poses[j + 2][i] = heading;
      }
    for (std::size_t j = 0; j < landmarks.rows(); j += 5)
      for (std::size_t i = 0; i < landmarks.stride(); i++) {
        const auto [x, y] = mount.base_point({landmarks[j][i], landmarks[j + 1][i]});
        const auto [xx, xy, yy] = mount.base_spread({landmarks[j + 2][i], landmarks[j + 3][i], landmarks[j + 4][i]});
        landmarks[j][i] = x;
        landmarks[j + 1][i] = y;
        landmarks[j + 2][i] = xx;
        landmarks[j + 3][i] = xy;
        landmarks[j + 4][i] = yy;
      }
  }
  return submap_moments(poses, {particles_.log_weights.data(), particles_.count()}, particles_.ids, landmarks);
}

}  // namespace teamslam::window
