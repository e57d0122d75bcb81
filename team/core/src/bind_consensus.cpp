// Bindings of the consensus over a window's scans.
#include <algorithm>

#include "binding_scan.hpp"
#include "consensus.hpp"

namespace teamslam::binding {

using window::Consensus;

void bind_consensus(nb::module_& m) {
  nb::class_<Consensus>(m, "Consensus",
                        "The measurements of a window, and which of them agree: a measurement that no others confirm is an outlier.\n\n"
                        "A measurement is accepted where it is likelier given the other accepted ones and the odometry than\n"
                        "as an outlier, uniform over the sensor's range and field of view.")
      .def(
          "__init__",
          [](Consensus* self, const std::array<double, 5>& noise, double max_range, double field_of_view, double outlier_share) {
            new (self) Consensus(gate_of(noise, max_range, field_of_view, outlier_share));
          },
          "noise"_a, "max_range"_a, "field_of_view"_a, "outlier_share"_a,
          "Begin a window. noise: as of `Window`; outlier_share: the share of measurements that are outliers.")
      .def(
          "add", [](Consensus& self, const window::Keyframe& keyframe) { self.add(keyframe.motion, scan_of(keyframe)); },
          "keyframe"_a, "Add a keyframe: the motion since the last one, then its measurements, if any.")
      .def("agreeing", &Consensus::agreeing,
           "Mark the measurements that agree with others of their landmark under the odometry alone.\n\n"
           "The measurement of a landmark that the others support best places it; it is accepted together with\n"
           "those that support it.")
      .def("confirmed", &Consensus::confirmed,
           "Mark those of `agreeing`, then by a smoother over the whole window until the classification is stable.\n\n"
           "Where the normal equations have no solution in floating point, nothing more is rejected.");
}

}  // namespace teamslam::binding
