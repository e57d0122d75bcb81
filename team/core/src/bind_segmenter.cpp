// Bindings of the front end: scans, the segmenter and the open window.
#include <cstring>

#include <nanobind/stl/vector.h>

#include "binding_scan.hpp"
#include "open_window.hpp"

namespace teamslam::binding {

using motion::Interval, motion::Nanoseconds;
using window::Bounds, window::Keyframe, window::Measurements, window::OpenWindow, window::Segmenter, window::StreamJudge, window::TimedScan,
    window::Window;

namespace {

using Pose = se2::Pose<double>;

// The numbers in bytes of a message, little-endian, which need not be aligned.
template <class T>
std::vector<T> numbers_in(const nb::bytes& data) {
  check(data.size() % sizeof(T) == 0, "the bytes are not of whole numbers");
  std::vector<T> numbers(data.size() / sizeof(T));
  if (!numbers.empty()) std::memcpy(numbers.data(), data.c_str(), data.size());
  return numbers;
}

Measurements polar_scan(std::vector<std::uint32_t> ids, const nb::bytes& ranges, const nb::bytes& bearings, const nb::bytes& covariances) {
  Measurements scan{std::move(ids), numbers_in<double>(ranges), numbers_in<double>(bearings), {}};
  const auto own = numbers_in<std::array<double, 3>>(covariances);
  check(scan.ranges.size() == scan.size() && scan.bearings.size() == scan.size() && (own.empty() || own.size() == scan.size()),
        "ids, ranges, bearings and covariances must be of as many landmarks");
  for (const auto& [rr, rb, bb] : own) scan.claims.push_back({rr, rb, bb, 0.0});
  return scan;
}

Measurements points_scan(const nb::bytes& ids, const nb::bytes& positions, const nb::bytes& covariances) {
  const auto points = numbers_in<se2::Point<double>>(positions);
  const auto own = numbers_in<std::array<double, 3>>(covariances);
  auto named = numbers_in<std::uint32_t>(ids);
  check(points.size() == named.size() && (own.empty() || own.size() == named.size()),
        "ids, positions and covariances must be of as many landmarks");
  return window::of_points(std::move(named), points, own);
}

Measurements unnamed_scan(const nb::bytes& ranges, const nb::bytes& bearings, const nb::bytes& covariances) {
  std::vector<std::uint32_t> ids(std::min<std::size_t>(ranges.size() / sizeof(double), window::UNNAMED));
  for (std::size_t k = 0; k < ids.size(); k++) ids[k] = window::UNNAMED + std::uint32_t(k);
  return polar_scan(std::move(ids), ranges, bearings, covariances);
}

// (n, 4) of claims, or (n, 0) without any.
dense::Matrix made_claims(const Measurements& of) {
  dense::Matrix own(of.size(), of.claims.empty() ? 0 : 4);
  for (std::size_t k = 0; k < of.claims.size(); k++) {
    const auto [rr, rb, bb, form] = of.claims[k];
    own[k][0] = rr, own[k][1] = rb, own[k][2] = bb, own[k][3] = form;
  }
  return own;
}

std::optional<motion::Increment> given_increment(const std::optional<MadeIncrement>& given) {
  if (!given) return {};
  return motion::Increment{std::get<0>(*given), std::get<1>(*given)};
}

std::optional<MadeIncrement> made_optional(const std::optional<motion::Increment>& of) {
  if (!of) return {};
  return made_increment(*of);
}

std::vector<MadeIncrement> made_increments(const std::vector<motion::Increment>& of) {
  std::vector<MadeIncrement> increments;
  for (const motion::Increment& each : of) increments.push_back(made_increment(each));
  return increments;
}

void bind_scans(nb::module_& m) {
  nb::class_<Measurements>(m, "Scan", "Measurements of landmarks: ids, ranges [m] and bearings [rad], relative to the sensor.")
      .def(
          "__init__",
          [](Measurements* self, const Ids& ids, const Numbers& ranges, const Numbers& bearings, const std::optional<Table>& own) {
            const std::size_t n = ids.size();
            check(ranges.size() == n && bearings.size() == n, "ids, ranges and bearings must have one length");
            Measurements scan;
            set(scan.ids, ids), set(scan.ranges, ranges), set(scan.bearings, bearings);
            if (own) {
              const std::span<const models::Claim> claims = claims_of(*own, n);
              scan.claims.assign(claims.begin(), claims.end());
            }
            new (self) Measurements(std::move(scan));
          },
          "ids"_a.noconvert(), "ranges"_a, "bearings"_a, "own"_a = nb::none(),
          "own: (n, 4) covariances of the measurements, as of `teamslam.team.estimation.models`; (n, 0) or None: none.")
      .def_static(
          "polar",
          [](const nb::bytes& ids, const nb::bytes& ranges, const nb::bytes& bearings, const nb::bytes& covariances) {
            return polar_scan(numbers_in<std::uint32_t>(ids), ranges, bearings, covariances);
          },
          "ids"_a, "ranges"_a, "bearings"_a, "covariances"_a = nb::bytes("", 0),
          "Make a scan of a message's bytes; covariances: (rr, rb, bb) of each, or empty.")
      .def_static("points", &points_scan, "ids"_a, "positions"_a, "covariances"_a = nb::bytes("", 0),
                  "Make a scan of points (x, y) in the sensor's frame; covariances: (xx, xy, yy) of each, or empty.\n\n"
                  "(r, b) = (|p|, atan2(y, x)) and J S J' with J = d(r, b)/dp.")
      .def_static("unnamed", &unnamed_scan, "ranges"_a, "bearings"_a, "covariances"_a = nb::bytes("", 0),
                  "Make a scan of landmarks without identities, numbered from 2^31 on.")
      .def_prop_ro("ids", [](const Measurements& self) {
        return made<std::uint32_t, nb::ndim<1>>(std::vector<std::uint32_t>(self.ids), {self.size()});
      }, nb::rv_policy::move)
      .def_prop_ro("ranges", [](const Measurements& self) { return self.ranges; })
      .def_prop_ro("bearings", [](const Measurements& self) { return self.bearings; })
      .def_prop_ro("own", &made_claims, "Covariances (n, 4) of the measurements, or (n, 0).")
      .def_prop_ro("is_unnamed", &Measurements::is_unnamed, "Whether the landmarks have no identities.")
      .def("__len__", &Measurements::size)
      .def(
          "only",
          [](const Measurements& self, const std::vector<bool>& taken) {
            check(taken.size() == self.size(), "taken must have the scan's length");
            return self.only(taken);
          },
          "taken"_a, "Select measurements.")
      .def("together", &Measurements::with, "more"_a,
           "Append further measurements; if only one part has covariances, the others have the sensor's noise.");
  m.def(
      "reduce_scans",
      [](const std::vector<Measurements>& scans, const Table& poses) {
        check(poses.shape(0) == scans.size() && (poses.shape(1) == 3 || scans.empty()), "poses must be (m, 3), one of each scan");
        finite(poses, "poses");
        std::vector<window::Scan> views;
        std::vector<Pose> from;
        for (std::size_t i = 0; i < scans.size(); i++) {
          if (!scans[i].is_finite()) throw NotFiniteError("measurements must be finite");
          views.push_back(scans[i].view());
          from.push_back({poses(i, 0), poses(i, 1), poses(i, 2)});
        }
        return window::reduce(views, from);
      },
      "scans"_a, "poses"_a,
      "Reduce scans to one measurement per landmark, by ascending id.\n\n"
      "poses: (m, 3), of each scan relative to the keyframe's end. A measurement is the median of range and bearing,\n"
      "moved to the keyframe's end; its covariance is the mean of those of its measurements.");

  nb::class_<TimedScan>(m, "TimedScan",
                        "A scan without identities, at at_ns: its stamp, or the start of the odometry that covers it.")
      .def(
          "__init__",
          [](TimedScan* self, Nanoseconds stamp_ns, const Measurements& scan, Nanoseconds at_ns, const std::optional<MadeIncrement>& motion) {
            new (self) TimedScan{stamp_ns, scan, at_ns, given_increment(motion), {}};
          },
          "stamp_ns"_a, "scan"_a, "at_ns"_a, "motion"_a.none())
      .def_ro("stamp_ns", &TimedScan::stamp_ns)
      .def_ro("at_ns", &TimedScan::at_ns)
      .def_ro("scan", &TimedScan::seen)
      .def_prop_ro("motion", [](const TimedScan& self) { return made_optional(self.motion); }, "Motion since the scan or keyframe before.")
      .def_ro("back", &TimedScan::back, "Pose relative to the keyframe's end, if that is another.");

  nb::class_<Keyframe>(m, "Keyframe",
                       "The sensor's motion since the last keyframe, and the measurements at its end, accepted and calibrated.\n\n"
                       "looks: the scans without identities since the last keyframe; rest: the motion since the last of them. is_node:\n"
                       "the pose is a pose node of the submap. shift: of the motion, (forward, left, turn), by an error of the scale of\n"
                       "speed, and the motion's duration [s]. A motion is (mean, covariance).")
      .def(
          "__init__",
          [](Keyframe* self, Nanoseconds stamp_ns, const MadeIncrement& motion, const std::optional<Measurements>& scan,
             const std::vector<TimedScan>& looks, const std::optional<MadeIncrement>& rest, bool is_node,
             const std::array<double, 4>& shift) {
            new (self) Keyframe{stamp_ns, *given_increment(motion), scan.value_or(Measurements{}), looks, given_increment(rest), is_node,
                                {shift[0], shift[1], shift[2]}, shift[3]};
          },
          "stamp_ns"_a, "motion"_a, "scan"_a = nb::none(), "looks"_a = std::vector<TimedScan>{}, "rest"_a = nb::none(), "is_node"_a = false,
          "shift"_a = std::array<double, 4>{0.0, 0.0, 0.0, 0.0})
      .def_ro("stamp_ns", &Keyframe::stamp_ns)
      .def_prop_ro("motion", [](const Keyframe& self) { return made_increment(self.motion); })
      .def_ro("scan", &Keyframe::seen)
      .def_ro("looks", &Keyframe::looks)
      .def_prop_ro("rest", [](const Keyframe& self) { return made_optional(self.rest); })
      .def_ro("is_node", &Keyframe::is_node)
      .def_prop_ro("shift", [](const Keyframe& self) {
        return std::array<double, 4>{self.shift.forward, self.shift.left, self.shift.turn, self.seconds};
      });
}

void bind_judge(nb::module_& m) {
  nb::class_<Bounds>(m, "StreamBounds", "Bounds of a sensor stream, as of `teamslam.team.config.Bounds`.")
      .def(nb::init<Nanoseconds, double, double, double, double, std::array<double, 2>, std::array<double, 2>>(), "jump_ns"_a,
           "interval_s"_a, "speed_m_s"_a, "yaw_rate_rad_s"_a, "extent_m"_a, "sigma_m"_a, "sigma_rad"_a);
  nb::class_<StreamJudge>(m, "StreamJudge",
                          "Checks one incarnation of a sensor stream against the time of its last odometry.\n\n"
                          "A stamp `jump_ns` ahead of the odometry is refused, even of odometry, until the next interval confirms that the\n"
                          "clock has jumped. A verdict is an index of `teamslam.team.rejection.BY_CORE`.")
      .def(nb::init<const Bounds&>(), "bounds"_a)
      .def("judge", [](StreamJudge& self, const Interval& interval) { return int(self.judge(interval)); }, "interval"_a,
           "Judge an interval; for SPEED and STEERING only its motion is refused.")
      .def("is_ahead", [](const StreamJudge& self, Nanoseconds stamp_ns) { return self.is_ahead(checked_ns(stamp_ns)); }, "stamp_ns"_a,
           "Whether a measurement is too far ahead of the odometry.")
      .def(
          "judge_scan",
          [](const StreamJudge& self, Nanoseconds stamp_ns, Measurements& scan) { return int(self.judge(checked_ns(stamp_ns), scan)); },
          "stamp_ns"_a, "scan"_a, "Judge a scan, and drop its measurements beyond the bounds.");
}

}  // namespace

void bind_segmenter(nb::module_& m) {
  bind_scans(m);
  bind_judge(m);
  nb::class_<Segmenter>(m, "Segmenter",
                        "Integrates odometry between keyframes; an observation splits an interval.\n\n"
                        "With keyframe_ns = 0 every scan is a keyframe. Otherwise the scans within keyframe_ns are reduced to the\n"
                        "median range and bearing per landmark, moved by the odometry to the end of the interval that closes the\n"
                        "keyframe. Each pose node is a keyframe without measurements. Scans without identities are stored until the\n"
                        "window's end. Motions are the sensor's; those since a pose node and an inter-robot measurement are the base's.\n"
                        "A verdict is an index of `teamslam.team.rejection.BY_CORE`.")
      .def(
          "__init__",
          [](Segmenter* self, const motion::Model& model, const std::optional<Pose>& mount, const models::Calibration& calibration,
             double covariance_factor, Nanoseconds keyframe_ns, Nanoseconds window_ns, const Bounds& bounds) {
            new (self) Segmenter({model, mount, calibration, covariance_factor, keyframe_ns, window_ns, bounds});
          },
          "model"_a, "mount"_a.none(), "calibration"_a, "covariance_factor"_a, "keyframe_ns"_a, "window_ns"_a, "bounds"_a,
          "mount: the sensor's pose on the base; None at the base's origin. covariance_factor: on the\n"
          "measurements' own covariances. window_ns: planned length of a window.")
      .def("begin", [](Segmenter& self, Nanoseconds stamp_ns) { self.begin(checked_ns(stamp_ns)); }, "stamp_ns"_a,
           "Begin a stream or a window at this team time.")
      .def("resume", [](Segmenter& self, Nanoseconds stamp_ns) { self.resume(checked_ns(stamp_ns)); }, "stamp_ns"_a,
           "Begin after a window whose odometry ended at this team time.")
      .def(
          "observe",
          [](Segmenter& self, Nanoseconds stamp_ns, const Measurements& scan) { return int(self.observe(checked_ns(stamp_ns), scan)); },
          "stamp_ns"_a, "scan"_a, "Store a scan until the odometry covers its time; return the verdict.")
      .def(
          "drive",
          [](Segmenter& self, Nanoseconds end_ns, Nanoseconds duration_ns, double forward, double yaw_rate) {
            return self.drive(checked({end_ns, duration_ns, forward, yaw_rate}));
          },
          "end_ns"_a, "duration_ns"_a, "forward"_a, "yaw_rate"_a)
      .def("drive", &Segmenter::drive, "interval"_a,
           "Judge and integrate an odometry interval.\n\n"
           "Returns the verdict, plus DUE where keyframes are made, the window has lasted for window_ns, or the odometry\n"
           "stops at `stop_at`.")
      .def("integrate", &Segmenter::integrate, "interval"_a, "is_measured"_a,
           "Integrate an interval past the judge; returns DUE or 0.\n\n"
           "An unmeasured motion has the last speeds, with standard deviations as large as the motion, at least 1 m/s and\n"
           "0.5 rad/s, and below a full rotation in heading.")
      .def("stop_at", [](Segmenter& self, Nanoseconds stop_ns) { self.stop_at(checked_ns(stop_ns)); }, "stop_ns"_a,
           "Stop the odometry at this team time, before the scans there, until `go_on`; 2^62: never.")
      .def("go_on", &Segmenter::go_on, "Integrate the rest of the interval; returns DUE or 0.")
      .def("take_keyframes", &Segmenter::take_keyframes, "Remove and return the keyframes made.")
      .def("cut", [](Segmenter& self, Nanoseconds stamp_ns) { return self.cut(checked_ns(stamp_ns)); }, "stamp_ns"_a,
           "Close the window: make its last keyframe; return the later motion, as a keyframe without measurements.")
      .def("leave", &Segmenter::leave,
           "Drop the scans stamped after the window; return their number.\n\n"
           "Their counters lie in the window's interval of measurements: a robot restarted behind it would lack them.")
      .def("mark_sighting", [](Segmenter& self) { self.odometry().mark_sighting(); }, "Mark an inter-robot measurement here, for the next pose node.")
      .def("since_node", [](Segmenter& self) { return made_increment(self.odometry().since_node()); }, "Return the motion since the last pose node.")
      .def("reach_node", [](Segmenter& self) { return made_increments(self.reach_node()); },
           "Make the stop a pose node; return the motions since the marked sightings, and clear these.")
      .def_prop_ro("is_stopped", &Segmenter::is_stopped, "Whether the odometry has stopped within the interval.")
      .def_prop_ro("interval", [](const Segmenter& self) { return self.interval(); }, "The present interval; of an unmeasured motion, with the last speeds.")
      .def_prop_ro("judge", &Segmenter::judge, nb::rv_policy::reference_internal)
      .def_prop_ro("uncovered", &Segmenter::uncovered, "Number of scans whose time odometry has not covered.")
      .def_prop_ro("start_ns", &Segmenter::start_ns, "Begin of the window; None before the stream's.")
      .def_prop_ro("now_ns", &Segmenter::now_ns, "End of the odometry; None before the stream's begin.")
      .def_prop_ro("driven_m", &Segmenter::driven_m, "Path length [m] since the window's start.")
      .def_prop_ro_static("DUE", [](nb::handle) { return Segmenter::DUE; });

  nb::class_<OpenWindow>(m, "OpenWindow",
                         "A window while it is open: its keyframes, and its particles behind a gate against outliers, with their random\n"
                         "numbers. A motion or measurement that is not finite leaves it without a solution.")
      .def(
          "__init__",
          [](OpenWindow* self, std::size_t particles, const std::array<double, 5>& noise, bool improved,
             const std::array<double, 3>& mount, double resample_below, double max_range, double field_of_view, double outlier_share,
             const random::Random& random, std::size_t most_landmarks) {
            new (self) OpenWindow(settings_of(particles, noise, improved, mount, resample_below),
                                  gate_of(noise, max_range, field_of_view, outlier_share), random, {mount[0], mount[1], mount[2]},
                                  most_landmarks);
          },
          "particles"_a, "noise"_a, "improved"_a, "mount"_a, "resample_below"_a, "max_range"_a, "field_of_view"_a, "outlier_share"_a,
          "random"_a, "most_landmarks"_a,
          "Open a window: arguments as of `Window` and `Consensus`. random: copied, where it is. most_landmarks: beyond them\n"
          "the farthest new landmarks of a keyframe are dropped.")
      .def("advance", &OpenWindow::advance, "keyframe"_a,
           "Add a keyframe with those of its measurements that agree with others of the window so far.\n\n"
           "If a measurement that was accepted before no longer agrees, the window is computed again.")
      .def(
          "advance_by",
          [](OpenWindow& self, Segmenter& segmenter) {
            for (Keyframe& each : segmenter.take_keyframes()) self.advance(std::move(each));
          },
          "segmenter"_a, "Add the keyframes that a segmenter has made.")
      .def("move", &OpenWindow::move, "rest"_a, "Move the particles by the motion after the last keyframe.")
      .def("confirm", &OpenWindow::confirm, "Compare all measurements of the window; return whether others are accepted now.")
      .def("accepted", nb::overload_cast<>(&OpenWindow::accepted, nb::const_), "Copy the keyframes with their accepted measurements.")
      .def(
          "restart",
          [](OpenWindow& self, const std::vector<Keyframe>& keyframes, std::size_t particles) {
            check(particles > 0 && particles <= MOST_PARTICLES, "particles must be in 1 ... 10,000,000");
            self.restart(keyframes, particles);
          },
          "keyframes"_a, "particles"_a,
          "Compute the window again with these keyframes, so many particles and the first random numbers; the gate stays.\n\n"
          "Raises MotionError.")
      .def("give_up", &OpenWindow::give_up, "Leave the window without a solution.")
      .def("base_motion", [](const OpenWindow& self) { return made_increment(self.base_motion()); },
           "Compute the base's motion by odometry alone.")
      .def_prop_ro("is_solvable", &OpenWindow::is_solvable, "Whether no motion and no measurement was refused.")
      .def_prop_ro("keyframes_ns", [](const OpenWindow& self) {
        std::vector<Nanoseconds> stamps;
        for (const Keyframe& each : self.keyframes()) stamps.push_back(each.stamp_ns);
        return stamps;
      }, "Team time [ns] of each keyframe.")
      .def_prop_ro("last_keyframe_ns", [](const OpenWindow& self) {
        return self.keyframes().empty() ? std::nullopt : std::optional(self.keyframes().back().stamp_ns);
      }, "Team time [ns] of the last keyframe; None without any.")
      .def_prop_ro("has_unnamed", [](const OpenWindow& self) {
        return std::any_of(self.keyframes().begin(), self.keyframes().end(), [](const Keyframe& each) { return !each.looks.empty(); });
      }, "Whether a keyframe has scans without identities.")
      .def_prop_ro("window", &OpenWindow::window, nb::rv_policy::reference_internal, "The particles.")
      .def_prop_ro("random", &OpenWindow::random, nb::rv_policy::reference_internal, "The random numbers.")
      .def_prop_ro("rejected", &OpenWindow::rejected, "Number of measurements that are not accepted.")
      .def_prop_ro("restarts", &OpenWindow::restarts, "Number of times that the window was computed again.")
      .def_prop_ro("least_effective", &OpenWindow::least_effective,
                   "Least number of effective particles after a keyframe since the beginning.");
}

}  // namespace teamslam::binding
