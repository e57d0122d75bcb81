// Bindings of odometry: motions of an interval, and their composition.
#include <nanobind/stl/vector.h>

#include "binding_scan.hpp"
#include "odometry.hpp"

namespace teamslam::binding {

using motion::Densities, motion::Model, motion::Odometry;

namespace {

using Pose = se2::Pose<double>;
using Mean = const Pose&;
using Covariance = const linalg::Matrix3&;
using MadeIncrement = std::tuple<Pose, linalg::Matrix3>;
using Three = std::array<double, 3>;

MadeIncrement made_increment(const motion::Increment& of) { return {of.mean, of.covariance}; }

void bind_model(nb::module_& m) {
  nb::class_<Model>(m, "MotionModel", "The parameters of a motion model, as of `teamslam.team.config.MotionModel`.")
      .def(
          "__init__",
          [](Model* self, bool turns_first, const Three& forward, const Three& turn, const Three& final_turn, const Three& lateral,
             double forward_scale, double yaw_scale, double yaw_rate_limit, double turn_drag, double veer, double slow_below,
             double slow_scale, double covariance_factor, const std::optional<std::array<double, 2>>& calibrated_speed,
             const std::optional<std::array<double, 6>>& alphas, double alpha_interval_s, const std::optional<Three>& wheels,
             const std::optional<Three>& shares, double shares_interval_s) {
            const auto densities = [](const Three& of) { return Densities{of[0], of[1], of[2]}; };
            new (self) Model{turns_first, densities(forward), densities(turn), densities(final_turn), densities(lateral),
                             forward_scale, yaw_scale, yaw_rate_limit, turn_drag, veer, slow_below, slow_scale, covariance_factor,
                             calibrated_speed, alphas, alpha_interval_s, wheels, shares, shares_interval_s};
          },
          nb::kw_only(), "turns_first"_a, "forward"_a, "turn"_a, "final_turn"_a, "lateral"_a, "forward_scale"_a, "yaw_scale"_a,
          "yaw_rate_limit"_a, "turn_drag"_a, "veer"_a, "slow_below"_a, "slow_scale"_a, "covariance_factor"_a,
          "calibrated_speed"_a.none(), "alphas"_a.none(), "alpha_interval_s"_a, "wheels"_a.none(), "shares"_a.none(),
          "shares_interval_s"_a,
          "Noises are (per_s, per_m, per_rad); wheels: their distance, and the noise of the left and of the right one.")
      .def(
          "increment",
          [](const Model& self, double duration_s, double forward, double yaw_rate) {
            return made_increment(motion::increment_of(self, duration_s, forward, yaw_rate));
          },
          "duration_s"_a, "forward"_a, "yaw_rate"_a,
          "Compute the motion of one odometry interval: `forward` [m/s] and `yaw_rate` [rad/s] held for `duration_s`.\n\n"
          "With v = forward_scale forward (slow_scale forward where |forward| < slow_below),\n"
          "w = clip(yaw_scale yaw_rate, +-yaw_rate_limit), the path length d = sign(v) max(|v| - turn_drag |w|, 0) t,\n"
          "the turn p = w t + veer d and the noises a (forward, on d), b (turn, on p), c (final turn), l (lateral), the\n"
          "motion is\n\n"
          "- \"turn-then-drive\": turn p + b, drive d + a, then (0, l, c): the thesis, section 4.3.1;\n"
          "- all others: Exp(d + a, 0, p + b), then (0, l, c): the arc of Thrun et al. table 5.3 and Ma & Ma eq. 1-4.\n\n"
          "Returns mean and covariance.")
      .def(
          "part",
          [](const Model& self, const se2::Motion& twist, const std::optional<linalg::Matrix3>& covariance, double duration_s,
             double share, double rest) {
            return made_increment(motion::part_of(self, {twist, duration_s, covariance}, share, rest));
          },
          "twist"_a, "covariance"_a.none(), "duration_s"_a, "share"_a, "rest"_a,
          "Compute a share of a measured motion Exp(twist) at constant twist, followed by the share `rest`.\n\n"
          "covariance: the source's own of the whole interval, in the tangent space of its end; without it the noise is\n"
          "the model's. A share f of it is f Ad C Ad', with Ad of the motion that follows, so that parts compose to C.");
}

}  // namespace

void bind_motion(nb::module_& m) {
  bind_model(m);
  m.def(
      "compose_motions",
      [](Mean mean, Covariance covariance, Mean then, Covariance added) {
        return made_increment(motion::compose({mean, covariance}, motion::Step({then, added})));
      },
      "mean"_a, "covariance"_a, "then"_a, "added"_a,
      "Compose two motions: mean o then, with Ad C Ad' + added, Ad = Ad(then^-1), to first order in the noise.");
  m.def(
      "motion_of_sensor",
      [](Mean mean, Covariance covariance, const Pose& mount) {
        return made_increment(motion::of_sensor({mean, covariance}, mount));
      },
      "mean"_a, "covariance"_a, "mount"_a, "Convert a motion T of the base to the sensor's at m: T Exp(xi) m = m (m^-1 T m) Exp(Ad(m^-1) xi).");

  nb::class_<Odometry>(m, "Odometry",
                       "Odometry integrated since the places that matter to a window.\n\n"
                       "With a mount the motions since a keyframe and a scan are the sensor's; those since a pose node and an\n"
                       "inter-robot measurement are the base's. A motion is (mean, covariance).")
      .def(
          "__init__",
          [](Odometry* self, const Model& model, const std::optional<Three>& mount) {
            std::optional<Pose> at;
            if (mount) at = {(*mount)[0], (*mount)[1], (*mount)[2]};
            new (self) Odometry(model, at);
          },
          "model"_a, "mount"_a.none(), "mount: the sensor's pose on the base; None where it is at the base's origin.")
      .def("drive", nb::overload_cast<double, double, double, const std::optional<Odometry::Unmeasured>&>(&Odometry::drive),
           "duration_s"_a, "forward"_a, "yaw_rate"_a, "added"_a.none(),
           "Integrate a part of an interval whose speeds were measured.\n\nadded: variances per second, in addition to the noise.")
      .def(
          "move",
          [](Odometry& self, const se2::Motion& twist, const std::optional<linalg::Matrix3>& covariance, double interval_s,
             double duration_s, double share, double rest, const std::optional<Odometry::Unmeasured>& added) {
            self.drive({twist, interval_s, covariance}, duration_s, share, rest, added);
          },
          "twist"_a, "covariance"_a.none(), "interval_s"_a, "duration_s"_a, "share"_a, "rest"_a, "added"_a.none(),
          "Integrate a part of an interval whose motion was measured, as `MotionModel.part`.")
      .def(
          "end_keyframe",
          [](Odometry& self) {
            const auto [motion, shift, seconds, rest] = self.end_keyframe();
            std::optional<MadeIncrement> since_unnamed;
            if (rest) since_unnamed = made_increment(*rest);
            return std::tuple(made_increment(motion), std::vector{shift.forward, shift.left, shift.turn, seconds}, since_unnamed);
          },
          "End the motion since the last keyframe here.\n\n"
          "Returns it; its shift (forward, left, turn) by an error of the scale of speed, with its duration [s]; and the\n"
          "motion since the last scan without identities, if there was one.")
      .def("pass_unnamed_scan", [](Odometry& self) { return made_increment(self.pass_unnamed_scan()); },
           "Return the motion since the last scan without identities or keyframe, and begin anew here.")
      .def("mark_scan", &Odometry::mark_scan, "Mark a scan here, of a keyframe of several scans.")
      .def(
          "end_scans",
          [](Odometry& self) {
            const std::vector<Pose> scans = self.end_scans();
            dense::Matrix poses(scans.size(), 3);
            for (std::size_t k = 0; k < scans.size(); k++) {
              const auto& [x, y, heading] = scans[k];
              poses[k][0] = x, poses[k][1] = y, poses[k][2] = heading;
            }
            return poses;
          },
          "Return the poses (m, 3) at the marked scans, seen from here, where the next keyframe's scans begin.")
      .def("since_node", [](const Odometry& self) { return made_increment(self.since_node()); }, "The motion since the last pose node.")
      .def(
          "reach_node",
          [](Odometry& self) {
            std::vector<MadeIncrement> since;
            for (const motion::Increment& each : self.reach_node()) since.push_back(made_increment(each));
            return since;
          },
          "Begin the motion since the last pose node here; return the motions since the marked sightings, and forget these.")
      .def("mark_sighting", &Odometry::mark_sighting, "Mark an inter-robot measurement here, for the next pose node.")
      .def("forget_sightings", &Odometry::forget_sightings, "Forget the marked sightings.");
}

}  // namespace teamslam::binding
