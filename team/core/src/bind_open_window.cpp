// Bindings of the open window.
#include "binding_scan.hpp"
#include "open_window.hpp"

namespace teamslam::binding {

using window::OpenWindow, window::Window;

namespace {

// A method that takes a keyframe as the window and the gate do.
template <auto METHOD>
auto take_keyframe(OpenWindow& self, const Triple& motion, const Matrix3& covariance, const Quadruple& shift, const Ids& ids,
                   const Numbers& ranges, const Numbers& bearings, const Table& own, std::optional<std::int64_t> node_ns) {
  return (self.*METHOD)(increment_of(motion, covariance, shift), scan_of(ids, ranges, bearings, own), node_ns);
}

}  // namespace

void bind_open_window(nb::module_& m) {
  nb::class_<OpenWindow>(m, "OpenWindow", "A window while it is open: its particles behind a gate against outliers, and their random numbers.")
      .def(
          "__init__",
          [](OpenWindow* self, std::size_t particles, const std::array<double, 5>& noise, bool improved,
             const std::array<double, 3>& mount, double resample_below, double max_range, double field_of_view, double outlier_share,
             const random::Random& random) {
            new (self) OpenWindow(settings_of(particles, noise, improved, mount, resample_below),
                                  gate_of(noise, max_range, field_of_view, outlier_share), random);
          },
          "particles"_a, "noise"_a, "improved"_a, "mount"_a, "resample_below"_a, "max_range"_a, "field_of_view"_a, "outlier_share"_a,
          "random"_a, "Open a window: arguments as of `Window` and `Consensus`. random: copied, where it is.")
      .def("admit", &take_keyframe<&OpenWindow::admit>, "motion"_a, "covariance"_a, "shift"_a, "ids"_a.noconvert(), "ranges"_a,
           "bearings"_a, "own"_a, "node_ns"_a = nb::none(),
           "Take a keyframe with those of its measurements that agree with others of the window so far.\n\n"
           "node_ns: the team time, where the keyframe is a pose node. Other arguments are as of `Window.advance`.\n"
           "Returns False, and leaves the particles as they are, if a measurement that was accepted before no longer\n"
           "agrees: restart with `begin` and the accepted measurements of all keyframes. Raises MotionError.")
      .def("take", &take_keyframe<&OpenWindow::take>, "motion"_a, "covariance"_a, "shift"_a, "ids"_a.noconvert(), "ranges"_a,
           "bearings"_a, "own"_a, "node_ns"_a = nb::none(), "Take a keyframe past the gate; arguments as of `admit`. Raises MotionError.")
      .def(
          "move",
          [](OpenWindow& self, const Triple& motion, const Matrix3& covariance, const Quadruple& shift) {
            self.move(increment_of(motion, covariance, shift));
          },
          "motion"_a, "covariance"_a, "shift"_a, "Move the particles without a keyframe, as `Window.move`.")
      .def("confirm", &OpenWindow::confirm, "Compare all measurements of the window; return whether others are accepted now.")
      .def("accepted", &OpenWindow::accepted, "keyframe"_a,
           "Mark the accepted measurements of an admitted keyframe; None where they all are.")
      .def(
          "begin",
          [](OpenWindow& self, std::size_t particles) {
            check(particles > 0 && particles <= MOST_PARTICLES, "particles must be in 1 ... 10,000,000");
            self.begin(particles);
          },
          "particles"_a, "Restart with so many particles and the first random number; the gate stays.")
      .def_prop_ro("window", &OpenWindow::window, nb::rv_policy::reference_internal, "The particles.")
      .def_prop_ro("random", &OpenWindow::random, nb::rv_policy::reference_internal, "The random numbers.")
      .def_prop_ro("rejected", &OpenWindow::rejected, "Number of measurements that are not accepted.")
      .def_prop_ro("least_effective", &OpenWindow::least_effective,
                   "Least number of effective particles after a keyframe since the beginning.");
}

}  // namespace teamslam::binding
