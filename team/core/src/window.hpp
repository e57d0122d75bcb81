// One window of Hybrid-SLAM: particles that start at zero, and the one Gaussian they become.
//
// Poses are of the sensor, relative to the sensor's pose at the window's start; a Gaussian is of the
// base, relative to the base's pose there. Brooks and Bailey 2009, HybridSLAM.
#pragma once

#include <stdexcept>

#include "along_path.hpp"
#include "innovation.hpp"
#include "moments.hpp"
#include "random.hpp"

namespace teamslam::window {

struct Settings {
  std::size_t particles;
  bool is_improved;  // the proposal of FastSLAM 2.0
  Noise noise;
  se2::Mount mount;
  double resample_below = 0.0;  // the share of effective particles below which they are resampled
};

// The motion since the last keyframe, which lasted `seconds`; its covariance, and its shift by an error of
// the scale of speed, in the tangent space of its end.
struct Increment {
  Motion mean;
  std::span<const double, 9> covariance;
  std::array<double, 3> shift{};
  double seconds = 0.0;
};

// The motion to a keyframe, or after the last one: its noise, its shift and its duration.
struct WindowMotion {
  linalg::Matrix3 covariance;
  std::array<double, 3> shift;
  double seconds;
};

// Measurements of landmarks, corrected by the calibration; an id may occur twice. claims: the
// covariances that they bring, none where empty.
struct Scan {
  std::span<const std::uint32_t> ids;
  std::span<const double> ranges, bearings;
  std::span<const Claim> claims;

  Claim claim(std::size_t k) const { return claims.empty() ? models::OF_SENSOR : claims[k]; }
};

// effective: number of effective particles after the step; log_evidence: log p(z | earlier z) by the
// particles; squared, dof: of the innovation, as of `Innovation`.
struct Step {
  double effective, log_evidence, squared;
  std::size_t dof;
};

// Sums of the innovations of several keyframes.
struct Innovated {
  double squared = 0.0;
  std::size_t dof = 0;
};

// A motion whose mean or covariance is not finite, or whose covariance is indefinite.
struct MotionError : std::domain_error {
  using std::domain_error::domain_error;
};

inline constexpr double NO_RESAMPLING = -1.0;

class Window {
 public:
  explicit Window(const Settings& settings);

  // One keyframe: the innovation of its measurements, resampling where uniform is not NO_RESAMPLING,
  // and the step of the particles. Throws MotionError, and is then as it was.
  Step advance(const Increment& increment, const Scan& scan, double uniform, std::span<const double> normals);

  // The same by numbers drawn here: a uniform one where the particles are to be resampled, then three
  // normal ones for each. `innovated` counts the innovation, unless its covariance is singular.
  Step advance(const Increment& increment, const Scan& scan, random::Random& random);

  // A keyframe without resampling, whose innovation is not asked for; returns its log evidence.
  double step(const Increment& increment, const Scan& scan, std::span<const double> normals);

  // Moves the particles without a keyframe; the weights stay. Throws MotionError.
  void move(const Increment& increment, std::span<const double> normals);
  void move(const Increment& increment, random::Random& random) { move(increment, random.normals(3 * settings_.particles)); }

  // Makes the poses at the last keyframe a pose node at this team time.
  void mark(std::int64_t stamp_ns);

  Innovation innovation(const Increment& increment, const Scan& scan) const;

  // The Gaussian of (end pose, pose nodes, landmarks by ascending id), landmarks solved again along
  // the paths.
  Gaussian close() { return gaussian(true, solve_landmarks()); }

  // The Gaussian of (end pose, landmarks) so far, which is not fused. Where all of the sensor's
  // errors are white the landmarks are those that the particles hold: solving them at every keyframe
  // moves that pose by a hundredth and costs a third of the time.
  Gaussian run();

  // The landmarks of each particle solved over all measurements, rows in order of first sight. One that
  // was solved before is solved again only if it was measured since: the rest of its path is the same.
  const Rows& solve_landmarks();

  // Poses and landmarks in the frame of the base's start. The measurements stay the sensor's, so this
  // window neither advances nor closes: `check_of_sensor` throws std::invalid_argument.
  Window of_base() const;
  void check_of_sensor() const;

  // The weighted mean of the poses at each keyframe, headings on the circle.
  std::vector<se2::Pose<double>> mean_path() const;

  // Replaces the paths of the particles, and what follows from them.
  void replace(Particles particles, Rows path);

  const Settings& settings() const { return settings_; }
  const Particles& particles() const { return particles_; }
  const Rows& path() const { return path_; }
  std::size_t keyframes() const { return path_.rows() / 3; }
  std::span<const WindowMeasurement> measurements() const { return measurements_; }
  std::span<const WindowMotion> motions() const { return motions_; }
  std::span<const std::size_t> nodes() const { return nodes_; }
  std::span<const std::int64_t> node_stamps() const { return node_stamps_; }
  const Innovated& innovated() const { return innovated_; }
  double effective() const { return effective_; }

 private:
  Gaussian gaussian(bool with_nodes, const Rows& landmarks) const;
  void keep(const Increment& increment);
  double take(const Increment& increment, const Lower3& L, const Scan& scan, std::span<const Reading> readings,
              std::span<const double> normals);
  std::vector<Reading> readings_of(const Scan& scan) const;
  std::vector<std::size_t> slots_of(const Scan& scan) const;

  Settings settings_;
  Particles particles_;
  Rows path_;  // x, y, heading of each keyframe, along each particle's line of descent
  std::vector<WindowMeasurement> measurements_;
  std::vector<WindowMotion> motions_;
  std::vector<std::size_t> nodes_;  // the keyframe of each pose node
  std::vector<std::int64_t> node_stamps_;
  Innovated innovated_;
  Rows solved_;                     // the landmarks along the paths, as of `Particles::map`
  std::vector<bool> is_solved_;     // of each landmark, since its last measurement
  double effective_;
  bool is_of_base_ = false;
};

}  // namespace teamslam::window
