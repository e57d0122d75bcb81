// Hash of odometry, reduced scans and h by angles: one number for every compiler and processor, as bits.cpp.
#include "bits.hpp"
#include "segmenter.hpp"

using namespace teamslam;

namespace {

using bits::add, bits::centred;

void add(const motion::Increment& of) {
  for (const double x : {of.mean.x, of.mean.y, of.mean.heading}) add(x);
  for (const auto& row : of.covariance.entries)
    for (const double x : row) add(x);
}

motion::Densities densities() { return {0.1 + 0.1 * centred(), 0.1 + 0.1 * centred(), 0.1 + 0.1 * centred()}; }

void run_odometry(bool turns_first, bool is_mounted) {
  motion::Model model;
  model.turns_first = turns_first;
  model.forward = densities(), model.turn = densities(), model.final_turn = densities(), model.lateral = densities();
  model.forward_scale = 1.03, model.yaw_scale = 0.97, model.yaw_rate_limit = 0.4, model.turn_drag = 0.02, model.veer = 0.01;
  model.slow_below = 0.1, model.slow_scale = 1.1, model.covariance_factor = 1.7;
  model.calibrated_speed = {0.1, 0.2};
  model.alphas = {0.01, 0.02, 0.03, 0.02, 0.01, 0.04};
  model.wheels = {0.3, 0.02, 0.03};
  model.shares = {0.1, 0.05, 0.02};
  std::optional<se2::Pose<double>> mount;
  if (is_mounted) mount = {0.2, -0.1, 0.7};
  motion::Odometry odometry(model, mount);
  for (int k = 0; k < 400; k++) {
    const motion::Odometry::Unmeasured spread = {0.2, 0.1, 0.3};
    const std::optional<motion::Odometry::Unmeasured> added = k % 11 ? std::nullopt : std::optional(spread);
    if (k % 3) {
      const double duration = 0.01 + 0.1 * (0.5 + centred()), forward = centred();
      odometry.drive(duration, forward, (k % 5 ? 2.0 : 1e-4) * centred(), added);
    } else {
      motion::Moved moved{{centred(), 0.3 * centred(), centred()}, 0.2, std::nullopt};
      if (k % 2) moved.covariance = {{{0.2, 0.01, 0.0}, {0.01, 0.3, 0.02}, {0.0, 0.02, 0.1}}};
      odometry.drive(moved, 0.1, 0.5, 0.25, added);
    }
    if (k % 4 == 0) odometry.mark_scan();
    if (k % 5 == 0) odometry.mark_sighting();
    if (k % 9 == 0) add(odometry.pass_unnamed_scan());
    if (k % 7 == 0) {
      const auto [motion, shift, seconds, rest] = odometry.end_keyframe();
      add(motion);
      for (const double x : {shift.forward, shift.left, shift.turn, seconds}) add(x);
      if (rest) add(*rest);
    }
    if (k % 13 == 0) {
      add(odometry.since_node());
      for (const motion::Increment& each : odometry.reach_node()) add(each);
      for (const se2::Pose<double>& each : odometry.end_scans())
        for (const double x : {each.x, each.y, each.heading}) add(x);
    }
  }
}

void run_scans(bool with_claims) {
  std::vector<std::uint32_t> ids;
  std::vector<double> ranges, bearings;
  std::vector<models::Claim> claims;
  const models::Calibration calibration{0.1, 1.02, 0.05, {{0.01, 0.02, 0.03}}, 0.2, 0.5, 5.0, 1.0};
  for (std::uint32_t k = 0; k < 30; k++) {
    const double raw = 3.0 + 5.0 * centred();
    const auto [range, bearing, is_accepted] = calibration.correct(raw, 3.0 * centred());
    add(range), add(bearing), add(double(is_accepted));
    ids.push_back(k * 7 % 5);
    ranges.push_back(3.0 + centred()), bearings.push_back(6.0 * centred());
    claims.push_back({0.1 + 0.1 * centred(), 0.02 * centred(), 0.1 + 0.1 * centred(), double(k % 3) - 1.0});
  }
  std::vector<window::Scan> scans;
  std::vector<se2::Pose<double>> poses;
  for (std::size_t k = 0; k < 5; k++) {
    const auto part = [&](auto& of) { return std::span(of).subspan(6 * k, 6); };
    scans.push_back({part(ids), part(ranges), part(bearings), {}});
    if (with_claims && k % 2) scans.back().claims = part(claims);
    poses.push_back({centred(), centred(), 7.0 * centred()});
  }
  const window::Measurements found = window::reduce(scans, poses);
  for (std::size_t k = 0; k < found.ids.size(); k++) {
    add(double(found.ids[k])), add(found.ranges[k]), add(found.bearings[k]);
    if (with_claims)
      for (const double x : {found.claims[k].rr, found.claims[k].rb, found.claims[k].bb, found.claims[k].form}) add(x);
  }
}

void run_models() {
  for (int k = 0; k < 300; k++) {
    const se2::Pose<double> pose{9.0 * centred(), centred(), 7.0 * centred()};
    const models::Claim claim{0.1, 0.02, 0.2, double(k % 3) - 1.0};
    const double range = 3.0 + centred();
    const models::Reading z = models::reading_of(range, 6.0 * centred(), {0.1, 0.01, 1.0, 0.2, 1.0}, claim);
    const auto placed = models::place(pose, z);
    for (const double x : {placed.x, placed.y, placed.xx, placed.xy, placed.yy}) add(x);
    const models::Polar seen = models::polar(pose, {centred(), 4.0 * centred()});
    const auto innovation = models::innovation_of(z, seen);
    for (const double x : {innovation.of_range, innovation.of_bearing, innovation.rr, innovation.rb, innovation.bb}) add(x);
    for (const auto& row : models::pose_jacobian(seen.range, seen.bearing))
      for (const double x : row) add(x);
    for (const auto& row : models::landmark_jacobian(seen.range, pose.heading + seen.bearing))
      for (const double x : row) add(x);
  }
}

}  // namespace

int main() {
  bits::state = 20260917;
  for (const bool turns_first : {false, true})
    for (const bool is_mounted : {false, true}) run_odometry(turns_first, is_mounted);
  for (int k = 0; k < 50; k++) run_scans(k % 2);
  run_models();
  bits::print();
}
