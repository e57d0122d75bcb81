// Keyframes from a stream of odometry intervals and scans.
#pragma once

#include <deque>
#include <span>
#include <vector>

#include "measurements.hpp"
#include "motion.hpp"

namespace teamslam::motion {

using Nanoseconds = std::int64_t;

// An interval of odometry until end_ns: mean forward speed [m/s] and yaw rate [rad/s], or a reported motion
// Exp(twist), which has these speeds; covariance: reported, of the error in the tangent space of its end.
struct Interval {
  Nanoseconds end_ns = 0, duration_ns = 1;
  double forward = 0, yaw_rate = 0;
  std::optional<Motion> twist{};
  std::optional<Matrix3> covariance{};

  double seconds() const { return double(duration_ns) * 1e-9; }
  double speed() const;  // the velocity's magnitude [m/s]; without a reported motion, signed
  // The interval extrapolated to a later one at the same speeds.
  Interval gone_on(Nanoseconds end, Nanoseconds duration) const;
  // The motion of a part of the interval, rest before its end.
  Increment part(const Model& model, Nanoseconds duration, Nanoseconds rest) const;
};

// Odometry integrated since the places that matter to a window.
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

namespace teamslam::window {

using motion::Interval, motion::Nanoseconds;

// Numbers of team/rejection.py: BY_CORE.
enum class Verdict { TAKEN, NO_TIME, OLDER, TIME, SPEED, STEERING, RANGE, SENSOR_LIMITS };

// Of team/config.py: Bounds.
struct Bounds {
  Nanoseconds jump_ns;
  double interval_s, speed, yaw_rate, extent;
  std::array<double, 2> sigma_m, sigma_rad;
};

// Checks one incarnation of a sensor stream against the time of its last odometry.
//
// A stamp `jump_ns` ahead of the odometry is refused, even of odometry, until the next interval confirms
// that the clock has jumped.
class StreamJudge {
 public:
  explicit StreamJudge(const Bounds& bounds) : bounds_(bounds) {}

  void resume(Nanoseconds now_ns) { now_ns_ = now_ns; }

  // TAKEN, the reason why an interval is refused, or SPEED or STEERING where only its motion is.
  Verdict judge(const Interval& interval);
  bool is_ahead(Nanoseconds stamp_ns) const;
  // TAKEN, or the reason why a scan is refused; drops its measurements beyond the bounds.
  Verdict judge(Nanoseconds stamp_ns, Measurements& scan) const;

 private:
  bool is_sensible(const Interval& interval) const;
  std::vector<bool> within(const Measurements& scan) const;

  Bounds bounds_;
  std::optional<Nanoseconds> now_ns_, jumped_ns_;
};

// A scan at at_ns: its stamp, or the start of the odometry that covers it. motion: since the scan or
// keyframe before; back: the pose seen from the keyframe's end; both of a scan without identities.
struct TimedScan {
  Nanoseconds stamp_ns;
  Measurements seen;
  Nanoseconds at_ns = 0;
  std::optional<motion::Increment> motion{};
  std::optional<se2::Pose<double>> back{};
};

// The sensor's motion since the last keyframe, and the measurements at its end, accepted and calibrated.
//
// shift: of the motion by an error of the scale of speed, and seconds: that it lasted. looks: the scans
// without identities since the last keyframe; rest: the motion since the last of them. is_node: whether the
// pose is a pose node of the submap.
struct Keyframe {
  Nanoseconds stamp_ns;
  motion::Increment motion;
  Measurements seen{};
  std::vector<TimedScan> looks{};
  std::optional<motion::Increment> rest{};
  bool is_node = false;
  Motion shift{};
  double seconds = 0.0;

  Increment increment() const;
};

// Integrates odometry between keyframes; an observation splits an interval.
//
// With keyframe_ns = 0 every scan is a keyframe. Otherwise the scans within keyframe_ns are reduced to the
// median range and bearing per landmark, moved by the odometry to the end of the interval that closes the
// keyframe. Each pose node is a keyframe without measurements. Scans without identities are kept until the
// window's end.
class Segmenter {
 public:
  struct Settings {
    motion::Model model;
    std::optional<se2::Pose<double>> mount;
    models::Calibration calibration;
    double covariance_factor;  // on the covariances that measurements bring
    Nanoseconds keyframe_ns, window_ns;
    Bounds bounds;
  };

  static constexpr Nanoseconds NEVER = Nanoseconds(1) << 62;  // behind every stamp
  static constexpr int DUE = 8;

  explicit Segmenter(const Settings& settings)
      : settings_(settings), odometry_(settings.model, settings.mount), judge_(settings.bounds) {}

  // Begins a stream or a window at this team time; `resume`: behind an earlier window.
  void begin(Nanoseconds stamp_ns);
  void resume(Nanoseconds stamp_ns);

  // Keeps a scan until the odometry covers its time, or returns the reason to reject it.
  Verdict observe(Nanoseconds stamp_ns, Measurements scan);

  // Judges and integrates an odometry interval; returns the verdict, plus DUE where keyframes are made,
  // the window has lasted for window_ns, or the odometry stops at `stop_ns`.
  int drive(const Interval& interval);
  // Integrates an interval. An unmeasured motion has the last speeds, with standard deviations as large as
  // the motion, at least UNMEASURED, and below a full rotation in heading.
  int integrate(const Interval& interval, bool is_measured);

  // Stops at this team time, before the scans there, until `go_on`, which returns as `integrate`.
  void stop_at(Nanoseconds stop_ns) { stop_ns_ = stop_ns; }
  bool is_stopped() const { return is_stopped_; }
  int go_on();
  // Makes the stop a pose node, which is a keyframe without measurements; returns the motions since the marked
  // sightings, and forgets these.
  std::vector<motion::Increment> reach_node();

  std::vector<Keyframe> take_keyframes() { return std::exchange(keyframes_, {}); }

  // Closes the window: its last keyframe is made; returns the later motion, as one without measurements.
  Keyframe cut(Nanoseconds stamp_ns);
  // Drops the scans stamped behind the window and returns their number: their counters lie in the window's
  // interval of measurements, so a robot restarted behind it would lack them.
  std::size_t leave();
  std::size_t uncovered() const { return waiting_.size(); }  // scans that odometry does not cover yet

  motion::Odometry& odometry() { return odometry_; }
  StreamJudge& judge() { return judge_; }
  const Interval& interval() const { return over_; }
  std::optional<Nanoseconds> start_ns() const { return start_ns_; }
  std::optional<Nanoseconds> now_ns() const { return now_ns_; }
  double driven_m() const { return driven_m_; }  // since the window's start

 private:
  void take(TimedScan scan);
  Nanoseconds move_to(Nanoseconds stamp_ns);
  Keyframe end_keyframe(Nanoseconds stamp_ns);
  void close_keyframe(Nanoseconds stamp_ns);

  Settings settings_;
  motion::Odometry odometry_;
  StreamJudge judge_;
  std::deque<TimedScan> waiting_;     // by stamp
  std::vector<TimedScan> scans_;      // of the open keyframe
  std::vector<Keyframe> keyframes_;
  Interval over_, last_;              // the present one, and the last that was measured
  std::optional<motion::Odometry::Unmeasured> unmeasured_;
  std::optional<Nanoseconds> start_ns_, now_ns_;
  Nanoseconds here_ns_ = 0, keyframe_start_ns_ = 0, stop_ns_ = NEVER;
  double driven_m_ = 0.0;
  bool is_stopped_ = false;
};

}  // namespace teamslam::window
