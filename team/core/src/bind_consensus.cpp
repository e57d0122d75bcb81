// Bindings of the consensus over a window's scans.
#include <algorithm>

#include "binding_scan.hpp"
#include "consensus.hpp"

namespace teamslam::binding {

using window::Consensus;

void bind_consensus(nb::module_& m) {
  nb::class_<Consensus>(m, "Consensus",
                        "The measurements of a window, and which of them agree: those that no others confirm are outliers.\n\n"
                        "A measurement is accepted where it is likelier given the other accepted ones and the odometry than\n"
                        "as an outlier, uniform over the sensor's range and field of view.")
      .def(
          "__init__",
          [](Consensus* self, const std::array<double, 5>& noise, double max_range, double field_of_view, double outlier_share) {
            check(max_range > 0.0 && field_of_view > 0.0, "max_range and field_of_view must be positive");
            check(outlier_share > 0.0 && outlier_share < 1.0, "outlier_share must be in (0, 1)");
            new (self) Consensus(noise_of(noise), max_range, field_of_view, outlier_share);
          },
          "noise"_a, "max_range"_a, "field_of_view"_a, "outlier_share"_a,
          "Begin a window. noise: as of `Window`; outlier_share: the share of measurements that are outliers.")
      .def(
          "add",
          [](Consensus& self, const se2::Pose<double>& motion, const linalg::Matrix3& covariance, const Ids& ids,
             const Numbers& ranges, const Numbers& bearings, const Table& own) {
            self.add({motion, covariance}, scan_of(ids, ranges, bearings, own));
          },
          "motion"_a, "covariance"_a, "ids"_a.noconvert(), "ranges"_a, "bearings"_a, "own"_a,
          "Take a keyframe: the motion since the last one, then its measurements (there may be none).")
      .def("accept", &Consensus::accept,
           "Accept the new measurements that agree with others so far, or all anew where one that was accepted\n"
           "before does not agree any more; return whether those accepted before stay accepted.")
      .def("confirm", &Consensus::confirm, "Accept the `confirmed` measurements; return whether others are accepted now.")
      .def(
          "accepted",
          [](const Consensus& self, std::size_t begin, std::size_t end) {
            const std::vector<bool>& all = self.accepted();
            check(begin <= end && end <= all.size(), "there are no such measurements");
            const std::vector<bool> part(all.begin() + std::ptrdiff_t(begin), all.begin() + std::ptrdiff_t(end));
            const bool is_whole = std::find(part.begin(), part.end(), false) == part.end();
            return is_whole ? std::nullopt : std::optional(part);
          },
          "begin"_a, "end"_a, "Mark the accepted measurements among begin ... end - 1; None where they all are.")
      .def_prop_ro(
          "rejected",
          [](const Consensus& self) { return std::count(self.accepted().begin(), self.accepted().end(), false); },
          "Number of measurements that are not accepted.")
      .def("agreeing", &Consensus::agreeing,
           "Mark the measurements that agree with others of their landmark under the odometry alone.\n\n"
           "The measurement of a landmark that the others support best places it; it is accepted together with\n"
           "those that support it.")
      .def("confirmed", &Consensus::confirmed,
           "Mark those of `agreeing`, then by a smoother over the whole window until the classification is stable.\n\n"
           "Where the normal equations have no solution in floating point, nothing more is rejected.");
}

}  // namespace teamslam::binding
