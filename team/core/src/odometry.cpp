#include "odometry.hpp"

#include <utility>

namespace teamslam::motion {

void Odometry::drive(double duration_s, double forward, double yaw_rate, const std::optional<Unmeasured>& added) {
  integrate(increment_of(model_, duration_s, forward, yaw_rate), forward_column(model_, duration_s, forward, yaw_rate), duration_s,
        added);
}

void Odometry::drive(const Moved& moved, double duration_s, double share, double rest, const std::optional<Unmeasured>& added) {
  integrate(part_of(model_, moved, share, rest), forward_column(model_, moved, share), duration_s, added);
}

void Odometry::integrate(Increment step, Point<double> column, double duration_s, const std::optional<Unmeasured>& added) {
  if (added)
    for (int i = 0; i < 3; i++) step.covariance[i][i] += duration_s * (*added)[i];
  Motion shift{column.x, column.y, 0.0};
  const Step of_base(step);
  since_node_ = compose(since_node_, of_base);
  for (Increment& each : since_sightings_) each = compose(each, of_base);
  if (mount_) {
    step = of_sensor(step, *mount_);
    const Matrix3 Ad = se2::adjoint(se2::inverse(*mount_));
    shift = {Ad[0][0] * column.x + Ad[0][1] * column.y, Ad[1][0] * column.x + Ad[1][1] * column.y, 0.0};
  }
  const Step of_scanner = mount_ ? Step(step) : of_base;
  since_keyframe_ = compose(since_keyframe_, of_scanner);
  if (since_unnamed_) since_unnamed_ = compose(*since_unnamed_, of_scanner);
  in_keyframe_ = se2::compose(in_keyframe_, step.mean);
  const Motion carried = shift_after(shift_, step.mean);
  shift_ = {carried.forward + shift.forward, carried.left + shift.left, carried.turn + shift.turn};
  seconds_ += duration_s;
}

Odometry::Keyframe Odometry::end_keyframe() {
  return {std::exchange(since_keyframe_, {}), std::exchange(shift_, {}), std::exchange(seconds_, 0.0),
          std::exchange(since_unnamed_, std::nullopt)};
}

Increment Odometry::pass_unnamed_scan() {
  const std::optional<Increment> before = std::exchange(since_unnamed_, Increment{});
  return before.value_or(since_keyframe_);
}

std::vector<Pose<double>> Odometry::end_scans() {
  std::vector<Pose<double>> seen = std::exchange(scans_, {});
  for (Pose<double>& each : seen) each = se2::between(in_keyframe_, each);
  in_keyframe_ = {};
  return seen;
}

std::vector<Increment> Odometry::reach_node() {
  since_node_ = {};
  return std::exchange(since_sightings_, {});
}

}  // namespace teamslam::motion
