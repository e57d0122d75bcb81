// The window of a robot while it is open: its particles behind a gate against outliers, and their random
// numbers.
#pragma once

#include <optional>

#include "consensus.hpp"
#include "random.hpp"

namespace teamslam::window {

class OpenWindow {
 public:
  OpenWindow(const Settings& settings, Consensus gate, const random::Random& random);

  // Takes a keyframe with those of its measurements that agree with others of the window so far.
  //
  // False if one that was accepted before no longer agrees: the particles are then unchanged, and must be
  // restarted (`begin`) with the accepted measurements of all keyframes. node_ns: the team time,
  // where the keyframe is a pose node. Throws MotionError.
  bool admit(const Increment& increment, const Scan& scan, std::optional<std::int64_t> node_ns);

  // Compares all measurements of the window; returns whether other ones are accepted now.
  bool confirm() { return gate_.confirm(); }

  // Marks each accepted measurement of a keyframe; none where all are.
  std::optional<std::vector<bool>> accepted(std::size_t keyframe) const;
  std::size_t rejected() const;

  // Restarts with so many particles and the first random number; the gate stays.
  void begin(std::size_t particles);

  // Takes a keyframe past the gate. Throws MotionError.
  void take(const Increment& increment, const Scan& scan, std::optional<std::int64_t> node_ns);

  // Moves the particles without a keyframe. Throws MotionError.
  void move(const Increment& increment) { window_.move(increment, random_); }

  Window& window() { return window_; }
  random::Random& random() { return random_; }

  // The least number of effective particles after a keyframe since the beginning.
  double least_effective() const { return least_effective_; }

 private:
  Window window_;
  Consensus gate_;
  std::vector<std::size_t> begins_{0};  // the first measurement of each keyframe, and of the next one
  random::Random first_, random_;
  double least_effective_ = elementary::INF;
};

}  // namespace teamslam::window
