// The window of a robot while it is open: its keyframes, and its particles behind a gate against outliers,
// with their random numbers.
#pragma once

#include "consensus.hpp"
#include "random.hpp"
#include "segmenter.hpp"

namespace teamslam::window {

class OpenWindow {
 public:
  // mount: the sensor's pose on the base. most_landmarks: of a submap.
  OpenWindow(const Settings& settings, Consensus gate, const random::Random& random, const se2::Pose<double>& mount,
             std::size_t most_landmarks);

  // Takes a keyframe with those of its measurements that agree with others of the window so far, and without
  // the farthest new landmarks beyond `most_landmarks`.
  //
  // If a measurement that was accepted before no longer agrees, the window is computed again.
  void advance(Keyframe keyframe);

  // Moves the particles by the motion after the last keyframe, without measurements.
  void move(const Keyframe& rest);

  // Compares all measurements of the window; returns whether other ones are accepted now.
  bool confirm() { return gate_.confirm(); }

  // The keyframes with their accepted measurements.
  std::vector<Keyframe> accepted() const;
  std::size_t rejected() const;

  // Computes the window again with these keyframes, so many particles and the first random numbers; the gate
  // stays. Throws MotionError.
  void restart(std::span<const Keyframe> keyframes, std::size_t particles);

  // Whether the window has a solution so far: no motion or measurement was refused.
  bool is_solvable() const { return is_solvable_; }
  void give_up() { is_solvable_ = false; }

  // The base's motion by odometry, over all keyframes and after them.
  motion::Increment base_motion() const;

  const std::vector<Keyframe>& keyframes() const { return keyframes_; }
  Window& window() { return window_; }
  random::Random& random() { return random_; }
  std::size_t restarts() const { return restarts_; }

  // The least number of effective particles after a keyframe since the beginning.
  double least_effective() const { return least_effective_; }

 private:
  void admit(const Keyframe& keyframe);
  void take(const Keyframe& keyframe);
  void keep_nearest(Keyframe& keyframe) const;
  std::vector<bool> accepted(std::size_t keyframe) const;

  Window window_;
  Consensus gate_;
  se2::Pose<double> mount_;
  std::size_t most_landmarks_, restarts_ = 0;
  std::vector<Keyframe> keyframes_;
  std::optional<motion::Increment> rest_;
  std::vector<std::size_t> begins_{0};  // the first measurement of each keyframe, and of the next one
  random::Random first_, random_;
  double least_effective_ = elementary::INF;
  bool is_solvable_ = true;
};

}  // namespace teamslam::window
