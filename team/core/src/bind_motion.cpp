// Bindings of odometry: motions of an interval, and their composition.
#include "binding_scan.hpp"

namespace teamslam::binding {

using motion::Densities, motion::Interval, motion::Model, motion::Nanoseconds;

namespace {

using Pose = se2::Pose<double>;
using Mean = const Pose&;
using Covariance = const linalg::Matrix3&;
using Three = std::array<double, 3>;

void bind_model(nb::module_& m) {
  nb::class_<Model>(m, "MotionModel", "Parameters of a motion model, as of `teamslam.team.config.MotionModel`.")
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

  nb::class_<Interval>(m, "OdometryInterval",
                       "An odometry interval until end_ns: mean forward speed [m/s] and yaw rate [rad/s].\n\n"
                       "twist: (forward [m], left [m], turn [rad]) of a reported motion Exp(twist), which has these speeds; covariance:\n"
                       "reported, of the error in the tangent space of its end.")
      .def(
          "__init__",
          [](Interval* self, Nanoseconds end_ns, Nanoseconds duration_ns, double forward, double yaw_rate,
             const std::optional<se2::Motion>& twist, const std::optional<linalg::Matrix3>& covariance) {
            new (self) Interval(checked({end_ns, duration_ns, forward, yaw_rate, twist, covariance}));
          },
          "end_ns"_a, "duration_ns"_a, "forward"_a, "yaw_rate"_a, "twist"_a = nb::none(), "covariance"_a = nb::none())
      .def_ro("end_ns", &Interval::end_ns)
      .def_ro("duration_ns", &Interval::duration_ns)
      .def_ro("forward", &Interval::forward)
      .def_ro("yaw_rate", &Interval::yaw_rate)
      .def_ro("twist", &Interval::twist)
      .def_ro("covariance", &Interval::covariance)
      .def_prop_ro("speed", &Interval::speed, "Magnitude of the velocity [m/s]; without a reported motion, signed.")
      .def(
          "gone_on",
          [](const Interval& self, Nanoseconds end_ns, Nanoseconds duration_ns) {
            return checked(checked(self).gone_on(end_ns, duration_ns));
          },
          "end_ns"_a, "duration_ns"_a, "Extrapolate to a later interval at the same speeds.")
      .def(
          "part",
          [](const Interval& self, const Model& model, Nanoseconds duration_ns, Nanoseconds rest_ns) {
            return made_increment(self.part(model, duration_ns, rest_ns));
          },
          "model"_a, "duration_ns"_a, "rest_ns"_a,
          "Compute the motion of a part of the interval, rest_ns before its end, as `MotionModel.part`.");
}

}  // namespace teamslam::binding
