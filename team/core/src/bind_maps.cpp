// Bindings of a robot's map and of the submaps after a prior.
#include <nanobind/stl/vector.h>

#include "binding.hpp"
#include "chain.hpp"

namespace teamslam::binding {

using maps::Chain, maps::ChainSolution, maps::LocalMap, maps::WholeMap;

namespace {

using View1 = nb::ndarray<nb::numpy, const double, nb::ndim<1>, nb::c_contig>;
using View2 = nb::ndarray<nb::numpy, const double, nb::ndim<2>, nb::c_contig>;
using ViewIds = nb::ndarray<nb::numpy, const std::uint32_t, nb::ndim<1>, nb::c_contig>;

// Without pose nodes.
LocalMap bare_submap_of(const Ids& ids, const Numbers& mean, const Table& covariance) {
  const std::size_t n = mean.size();
  check(n == 3 + 2 * ids.size(), "mean must be of a pose (x, y, theta), then of each landmark");
  check(covariance.shape(0) == n && covariance.shape(1) == n, "covariance must be (n, n) of a mean of n numbers");
  for (std::size_t k = 1; k < ids.size(); k++) check(ids(k - 1) < ids(k), "ids must ascend");
  return {{ids.data(), ids.size()}, {mean.data(), n}, matrix_of(covariance)};
}

}  // namespace

void bind_maps(nb::module_& m) {
  nb::class_<WholeMap>(m, "WholeMap",
                       "N(mean, covariance) of (pose, landmarks by ascending id) in one frame; immutable.")
      .def("__init__",
           [](WholeMap* self, const Ids& ids, const Numbers& mean, const Table& covariance) {
             const LocalMap of = bare_submap_of(ids, mean, covariance);
             new (self) WholeMap{
                 {of.ids.begin(), of.ids.end()}, {of.mean.begin(), of.mean.end()}, dense::Matrix(of.covariance)};
           },
           "ids"_a.noconvert(), "mean"_a, "covariance"_a)
      .def_prop_ro("ids", [](WholeMap& self) { return ViewIds(self.ids.data(), {self.ids.size()}, nb::find(self)); },
                   "The landmarks' ids (L,), ascending; read-only.")
      .def_prop_ro("mean", [](WholeMap& self) { return View1(self.mean.data(), {self.mean.size()}, nb::find(self)); },
                   "(x, y, theta, x1, y1, ...), n = 3 + 2 L numbers; read-only.")
      .def_prop_ro(
          "covariance",
          [](WholeMap& self) {
            const std::size_t n = self.mean.size();
            return View2(self.covariance.view().data, {n, n}, nb::find(self));
          },
          "(n, n); read-only.")
      .def(
          "pose",
          [](const WholeMap& self) {
            return std::tuple(made_numbers({self.mean.begin(), self.mean.begin() + 3}),
                              made_matrix(dense::Matrix(self.covariance.view().part(0, 0, 3, 3))));
          },
          "Copy mean (3,) and covariance (3, 3) of the pose.")
      .def_prop_ro("has_sound_landmarks", &WholeMap::has_sound_landmarks,
                   "Whether the landmarks' covariance is finite, and that of each landmark alone positive definite.")
      .def(
          "joined",
          [](const WholeMap& self, const Ids& ids, const Numbers& mean, const Table& covariance) {
            WholeMap joined;
            const maps::Fault fault = maps::join(self, bare_submap_of(ids, mean, covariance), joined);
            return std::tuple(fault == maps::Fault::NONE ? std::move(joined) : self, int(fault));
          },
          "ids"_a.noconvert(), "mean"_a, "covariance"_a,
          "Compose a submap, without pose nodes, onto the pose: known landmarks fused, new ones added.\n\n"
          "Returns the map and a fault: 0, 1 where the known landmarks' innovation has no covariance; then the map\n"
          "is as it was.")
      .def(
          "pose_after",
          [](const WholeMap& self, const WholeMap& submap, double gate) {
            const maps::TiedPose at = maps::end_pose(self, submap.view(), gate);
            return std::tuple(std::vector(at.pose.begin(), at.pose.end()),
                              dense::Matrix(dense::Const{at.covariance.data(), 3, 3, 3}), at.known, at.refused, int(at.fault));
          },
          "submap"_a, "gate"_a,
          "Compute the pose of `joined` alone, without landmarks that the others contradict by more than the gate.\n\n"
          "Returns pose (3,), covariance (3, 3), the numbers of known and of refused landmarks, and a fault: 0, 1 as\n"
          "of `joined`, 2 where a single landmark's innovation is singular.");
  m.def(
      "corrected",
      [](std::vector<double> mean, dense::Matrix covariance, double factor, const Table& sensitivity, const Table& curvature,
         const std::vector<std::tuple<double, double, std::size_t>>& errors) {
        const std::size_t n = mean.size(), rows = sensitivity.shape(0);
        check(covariance.rows() == n && covariance.columns() == n, "covariance must be (n, n) of a mean of n numbers");
        check((rows == 0 || sensitivity.shape(1) == n) && curvature.shape(0) == rows && curvature.shape(1) == sensitivity.shape(1),
              "sensitivity and curvature must be (k, n)");
        std::vector<maps::SharedError> shared;
        for (const auto& [value, sigma, row] : errors) {
          check(row < rows, "an error must have a row of the sensitivity");
          shared.push_back({value, sigma, row});
        }
        maps::correct(mean, covariance.view(), factor, shared, matrix_of(sensitivity), matrix_of(curvature));
        return std::tuple(std::move(mean), std::move(covariance));
      },
      "mean"_a, "covariance"_a, "factor"_a, "sensitivity"_a, "curvature"_a, "errors"_a,
      "Correct N(mean, P) by errors (b, sigma, row) with the rows S of the sensitivity and D of the curvature, (k, n).\n\n"
      "Returns mean + sum(S b + D b^2 / 2) and f P + sum(sigma^2 (S + b D)' (S + b D)).");
  nb::class_<Chain>(m, "Chain", "A prior and the submaps after it, each beginning at the end of the one before.")
      .def("__init__", [](Chain* self, const WholeMap& prior) { new (self) Chain(prior.view()); }, "prior"_a)
      .def(
          "append",
          [](Chain& self, const Ids& ids, const Numbers& mean, const Table& covariance) {
            self.append(bare_submap_of(ids, mean, covariance));
          },
          "ids"_a.noconvert(), "mean"_a, "covariance"_a, "Append the next submap, without pose nodes.")
      .def("solve", &Chain::solve, "iterations"_a, "tolerance"_a,
           "Minimise the squares over all poses and landmarks by damped Gauss-Newton.\n\n"
           "tolerance: the largest change of a number, of an undamped step, at which the iterations stop.");
  nb::class_<ChainSolution>(m, "ChainSolution", "Least-squares solution of a prior and the submaps after it.")
      .def_ro("map", &ChainSolution::map, "The last end pose and all landmarks.")
      .def_ro("cost", &ChainSolution::cost, "Chi-squared of all maps, in `dof` degrees of freedom.")
      .def_ro("dof", &ChainSolution::dof)
      .def_ro("known", &ChainSolution::known,
              "For each submap, the number of its landmarks that another map has, too.")
      .def_ro("landmark_chi2", &ChainSolution::landmark_chi2,
              "Chi-squared of each landmark of the submaps by its own covariance.")
      .def_prop_ro("fault", [](const ChainSolution& self) { return int(self.fault); },
                   "0; 1 if an unknown is undetermined, 2 if map `at` has no covariance.")
      .def_ro("at", &ChainSolution::at, "The map without covariance; 0 is the prior.");
}

}  // namespace teamslam::binding
