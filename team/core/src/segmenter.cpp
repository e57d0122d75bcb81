#include "segmenter.hpp"

#include <algorithm>
#include <utility>

namespace teamslam::motion {

double Interval::speed() const {
  return twist ? elementary::hypot(twist->forward, twist->left) / seconds() : forward;
}

Interval Interval::gone_on(Nanoseconds end, Nanoseconds duration) const {
  Interval later{end, duration, forward, yaw_rate};
  if (twist) {
    const double share = double(duration) / double(duration_ns);
    later.twist = {twist->forward * share, twist->left * share, twist->turn * share};
  }
  return later;
}

Increment Interval::part(const Model& model, Nanoseconds duration, Nanoseconds rest) const {
  if (!twist) return increment_of(model, double(duration) * 1e-9, forward, yaw_rate);
  return part_of(model, {*twist, seconds(), covariance}, double(duration) / double(duration_ns), double(rest) / double(duration_ns));
}

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

namespace teamslam::window {

namespace {

// Least standard deviation [m/s, rad/s] of a motion that was not measured; otherwise it is as large as the
// motion itself.
constexpr double UNMEASURED_SPEED = 1.0, UNMEASURED_RATE = 0.5;

// Variances per second of an unmeasured motion; errors of the speeds sum up.
motion::Odometry::Unmeasured unmeasured(double duration_s, double forward, double yaw_rate) {
  const double way = pack::max(pack::abs(forward), UNMEASURED_SPEED) * duration_s;
  const double turn = pack::min(pack::max(pack::abs(yaw_rate), UNMEASURED_RATE) * duration_s, elementary::PI);
  return {way * way / duration_s, 0.01 * way * way / duration_s, turn * turn / duration_s};
}

// a − b, within the numbers.
Nanoseconds difference(Nanoseconds a, Nanoseconds b) {
  Nanoseconds found;
  if (!__builtin_sub_overflow(a, b, &found)) return found;
  return a > b ? std::numeric_limits<Nanoseconds>::max() : std::numeric_limits<Nanoseconds>::min();
}

bool is_within(double x, const std::array<double, 2>& limits) { return limits[0] <= x && x <= limits[1]; }

}  // namespace

Increment Keyframe::increment() const {
  const auto& [x, y, heading] = motion.mean;
  const std::span<const double, 9> covariance(motion.covariance.entries[0], 9);
  return {{x, y, heading}, covariance, {shift.forward, shift.left, shift.turn}, seconds};
}

Verdict StreamJudge::judge(const Interval& interval) {
  if (interval.duration_ns == 0) return Verdict::NO_TIME;
  if (now_ns_) {
    const Nanoseconds ahead_ns = difference(interval.end_ns, *now_ns_);
    if (ahead_ns <= 0) return Verdict::OLDER;
    if (ahead_ns > bounds_.jump_ns) {
      const Nanoseconds further_ns = difference(interval.end_ns, jumped_ns_.value_or(*now_ns_));
      if (further_ns <= 0 || further_ns > bounds_.jump_ns) {
        jumped_ns_ = interval.end_ns;
        return Verdict::TIME;
      }
    }
  }
  now_ns_ = interval.end_ns;
  jumped_ns_.reset();
  if (std::isnan(interval.forward)) return Verdict::STEERING;
  return is_sensible(interval) ? Verdict::TAKEN : Verdict::SPEED;
}

bool StreamJudge::is_sensible(const Interval& interval) const {
  if (!(double(interval.duration_ns) <= bounds_.interval_s * 1e9 && pack::abs(interval.speed()) <= bounds_.speed &&
        pack::abs(interval.yaw_rate) <= bounds_.yaw_rate))
    return false;
  if (!interval.covariance) return true;
  const linalg::Matrix3& C = *interval.covariance;
  return std::sqrt(C[0][0]) <= bounds_.sigma_m[1] && std::sqrt(C[1][1]) <= bounds_.sigma_m[1] &&
         std::sqrt(C[2][2]) <= bounds_.sigma_rad[1];
}

bool StreamJudge::is_ahead(Nanoseconds stamp_ns) const { return now_ns_ && difference(stamp_ns, *now_ns_) > bounds_.jump_ns; }

Verdict StreamJudge::judge(Nanoseconds stamp_ns, Measurements& scan) const {
  if (is_ahead(stamp_ns)) return Verdict::TIME;
  const std::vector<bool> near = within(scan);
  const auto kept = std::size_t(std::count(near.begin(), near.end(), true));
  if (kept == scan.size()) return Verdict::TAKEN;
  if (kept == 0) return Verdict::RANGE;
  scan = scan.only(near);
  return Verdict::TAKEN;
}

std::vector<bool> StreamJudge::within(const Measurements& scan) const {
  std::vector<bool> near(scan.size());
  for (std::size_t k = 0; k < scan.size(); k++) {
    near[k] = scan.ranges[k] <= bounds_.extent;
    if (scan.claims.empty()) continue;
    const Claim& claim = scan.claims[k];
    const double r = std::sqrt(claim.rr), b = std::sqrt(claim.bb);
    const bool is_sensible = claim.is_of_point() ? is_within(b * pack::max(scan.ranges[k], models::NEAREST_M), bounds_.sigma_m)
                                                 : is_within(b, bounds_.sigma_rad);
    near[k] = near[k] && is_within(r, bounds_.sigma_m) && is_sensible;
  }
  return near;
}

void Segmenter::begin(Nanoseconds stamp_ns) {
  start_ns_ = now_ns_ = keyframe_start_ns_ = stamp_ns;
  last_ = {};  // a submap depends on its window's measurements alone
  driven_m_ = 0.0;
  odometry_.forget_sightings();
}

void Segmenter::resume(Nanoseconds stamp_ns) {
  begin(stamp_ns);
  judge_.resume(stamp_ns);
}

Verdict Segmenter::observe(Nanoseconds stamp_ns, Measurements scan) {
  if (const Verdict verdict = judge_.judge(stamp_ns, scan); verdict != Verdict::TAKEN) return verdict;
  if (now_ns_ && stamp_ns < *now_ns_) return Verdict::OLDER;
  std::vector<bool> accepted(scan.size());
  for (std::size_t k = 0; k < scan.size(); k++) {
    const auto [range, bearing, is_accepted] = settings_.calibration.correct(scan.ranges[k], scan.bearings[k]);
    scan.ranges[k] = range, scan.bearings[k] = bearing, accepted[k] = is_accepted;
  }
  const auto kept = std::size_t(std::count(accepted.begin(), accepted.end(), true));
  if (kept == 0 && scan.size() > 0) return Verdict::SENSOR_LIMITS;
  if (kept < scan.size()) scan = scan.only(accepted);
  const double scale = settings_.calibration.range_scale, factor = settings_.covariance_factor;
  if (scale != 1.0 || factor != 1.0)
    for (Claim& each : scan.claims) each = {each.rr * (factor / (scale * scale)), each.rb * (factor / scale), each.bb * factor, each.form};
  const auto later = [](Nanoseconds stamp, const TimedScan& each) { return stamp < each.stamp_ns; };
  waiting_.insert(std::upper_bound(waiting_.begin(), waiting_.end(), stamp_ns, later), {stamp_ns, std::move(scan)});
  return Verdict::TAKEN;
}

int Segmenter::drive(const Interval& interval) {
  const Verdict verdict = judge_.judge(interval);
  const bool is_measured = verdict == Verdict::TAKEN;
  if (!is_measured && verdict != Verdict::SPEED && verdict != Verdict::STEERING) return int(verdict);
  return int(verdict) + integrate(interval, is_measured);
}

int Segmenter::integrate(const Interval& interval, bool is_measured) {
  here_ns_ = difference(interval.end_ns, interval.duration_ns);
  if (!start_ns_) begin(here_ns_);
  driven_m_ += pack::abs(interval.speed()) * double(interval.duration_ns) * 1e-9;
  unmeasured_.reset();
  if (is_measured) {
    over_ = last_ = interval;
  } else {
    over_ = last_.gone_on(interval.end_ns, interval.duration_ns);
    unmeasured_ = unmeasured(over_.seconds(), over_.speed(), over_.yaw_rate);
  }
  return go_on();
}

std::vector<motion::Increment> Segmenter::reach_node() {
  keyframes_.push_back(end_keyframe(stop_ns_));
  keyframes_.back().is_node = true;
  return odometry_.reach_node();
}

int Segmenter::go_on() {
  if (!start_ns_) throw std::invalid_argument("the stream has not begun");
  while (true) {
    const bool has_scan = !waiting_.empty() && waiting_.front().stamp_ns <= over_.end_ns;
    if (stop_ns_ <= (has_scan ? waiting_.front().stamp_ns - 1 : over_.end_ns)) {
      move_to(stop_ns_);
      is_stopped_ = true;
      return DUE;
    }
    if (!has_scan) break;
    TimedScan scan = std::move(waiting_.front());
    waiting_.pop_front();
    take(std::move(scan));
  }
  is_stopped_ = false;
  move_to(over_.end_ns);
  now_ns_ = over_.end_ns;
  if (!scans_.empty() && difference(*now_ns_, keyframe_start_ns_) >= settings_.keyframe_ns) close_keyframe(*now_ns_);
  return !keyframes_.empty() || difference(*now_ns_, *start_ns_) >= settings_.window_ns ? DUE : 0;
}

void Segmenter::take(TimedScan scan) {
  const Nanoseconds at_ns = move_to(scan.stamp_ns);
  const bool is_unnamed = scan.seen.is_unnamed();
  if (is_unnamed) {
    scan.at_ns = at_ns;
    scan.motion = odometry_.pass_unnamed_scan();
  }
  if (settings_.keyframe_ns) {
    scans_.push_back(std::move(scan));
    odometry_.mark_scan();
    return;
  }
  keyframes_.push_back(end_keyframe(at_ns));
  if (is_unnamed)
    keyframes_.back().looks.push_back(std::move(scan));
  else
    keyframes_.back().seen = std::move(scan.seen);
}

Nanoseconds Segmenter::move_to(Nanoseconds stamp_ns) {
  const Nanoseconds duration_ns = difference(stamp_ns, here_ns_);
  if (duration_ns <= 0) return here_ns_;
  here_ns_ = stamp_ns;
  const double part_s = double(duration_ns) * 1e-9;
  if (!over_.twist) {
    odometry_.drive(part_s, over_.forward, over_.yaw_rate, unmeasured_);
    return stamp_ns;
  }
  const double whole = double(over_.duration_ns), share = double(duration_ns) / whole;
  const double rest = double(difference(over_.end_ns, stamp_ns)) / whole;
  odometry_.drive({*over_.twist, over_.seconds(), over_.covariance}, part_s, share, rest, unmeasured_);
  return stamp_ns;
}

Keyframe Segmenter::end_keyframe(Nanoseconds stamp_ns) {
  auto [motion, shift, seconds, rest] = odometry_.end_keyframe();
  return {stamp_ns, motion, {}, {}, rest, false, shift, seconds};
}

void Segmenter::close_keyframe(Nanoseconds stamp_ns) {
  std::vector<TimedScan> scans = std::exchange(scans_, {});
  const std::vector<se2::Pose<double>> seen_from = odometry_.end_scans();
  std::vector<Scan> named;
  std::vector<se2::Pose<double>> poses;
  Keyframe keyframe = end_keyframe(stamp_ns);
  for (std::size_t k = 0; k < scans.size(); k++) {
    if (!scans[k].motion) {
      named.push_back(scans[k].seen.view());
      poses.push_back(seen_from[k]);
    }
  }
  keyframe.seen = reduce(named, poses);
  for (std::size_t k = 0; k < scans.size(); k++) {
    if (!scans[k].motion) continue;
    scans[k].back = seen_from[k];
    keyframe.looks.push_back(std::move(scans[k]));
  }
  keyframe_start_ns_ = stamp_ns;
  keyframes_.push_back(std::move(keyframe));
}

Keyframe Segmenter::cut(Nanoseconds stamp_ns) {
  if (!scans_.empty()) close_keyframe(stamp_ns);
  Keyframe rest = end_keyframe(stamp_ns);
  odometry_.end_scans();
  keyframe_start_ns_ = stamp_ns;
  return rest;
}

std::size_t Segmenter::leave() {
  const std::size_t left = waiting_.size();
  waiting_.clear();
  return left;
}

}  // namespace teamslam::window
