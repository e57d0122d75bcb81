// Odometry integrated since the places that matter to a window.
#pragma once

#include <span>
#include <vector>

#include "motion.hpp"

namespace teamslam::motion {

class Odometry {
 public:
  // Variances of a motion per second, in addition to its noise.
  using Unmeasured = std::array<double, 3>;

  // mount: the sensor's pose on the base; none where it is at the base's origin. The motions since a
  // keyframe and a scan are the sensor's, those since a pose node the base's.
  Odometry(const Model& model, const std::optional<Pose<double>>& mount) : model_(model), mount_(mount) {}

  // Integrates a part of an interval whose speeds were measured, or whose motion was, as in `part_of`.
  void drive(double duration_s, double forward, double yaw_rate, const std::optional<Unmeasured>& added);
  void drive(const Moved& moved, double duration_s, double share, double rest, const std::optional<Unmeasured>& added);

  struct Keyframe {
    Increment motion;
    Motion shift;                   // of the motion by an error of the scale of speed
    double seconds;                 // that the motion lasted
    std::optional<Increment> rest;  // the motion since the last scan without identities
  };
  // Ends the motion since the last keyframe here.
  Keyframe end_keyframe();

  // Returns the motion since the last scan without identities or the last keyframe, and begins anew here.
  Increment pass_unnamed_scan();

  // Marks a scan here, of a keyframe of several scans.
  void mark_scan() { scans_.push_back(in_keyframe_); }
  // The poses at these scans, seen from here; further scans are those of the next keyframe.
  std::vector<Pose<double>> end_scans();

  // The motion since the last pose node.
  const Increment& since_node() const { return since_node_; }
  // Begins the motion since the last pose node here; returns the motions since the marked sightings, and
  // forgets these.
  std::vector<Increment> reach_node();
  // Marks an inter-robot measurement here, for the next pose node.
  void mark_sighting() { since_sightings_.emplace_back(); }
  void forget_sightings() { since_sightings_.clear(); }

 private:
  void integrate(Increment step, Point<double> column, double duration_s, const std::optional<Unmeasured>& added);

  Model model_;
  std::optional<Pose<double>> mount_;
  Increment since_keyframe_, since_node_;
  Motion shift_{};
  double seconds_ = 0.0;
  std::optional<Increment> since_unnamed_;
  Pose<double> in_keyframe_{};  // since the end of the last keyframe of several scans
  std::vector<Pose<double>> scans_;
  std::vector<Increment> since_sightings_;
};

}  // namespace teamslam::motion
