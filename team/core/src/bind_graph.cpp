// Bindings of the submap graph and its estimate.
#include <nanobind/stl/optional.h>
#include <nanobind/stl/shared_ptr.h>
#include <nanobind/stl/vector.h>

#include "binding.hpp"
#include "estimate.hpp"

namespace teamslam::binding {

using graph::Estimate, graph::Graph, graph::Quadratic, graph::Submap;

namespace {

using IndexArray = nb::ndarray<const std::int64_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Marks = nb::ndarray<const bool, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Changed = nb::ndarray<double, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using SubmapFactor = std::tuple<std::shared_ptr<Submap>, IndexArray>;
using Sighting = std::tuple<std::int64_t, std::int64_t, Numbers, Table, Numbers>;
using Prior = std::tuple<std::int64_t, Numbers, Table, bool>;

template <class T>
std::vector<T> listed(const nb::ndarray<const T, nb::ndim<1>, nb::c_contig, nb::device::cpu>& array) {
  return std::vector<T>(array.data(), array.data() + array.size());
}

graph::Values values_of(const Numbers& numbers, std::size_t size, const char* what) {
  check(numbers.size() == size, what);
  return {numbers.data(), numbers.size()};
}

graph::Values state_of(const Graph& graph, const Numbers& state) {
  return values_of(state, graph.unknowns(), "the state has not the size of the graph");
}

MadeNumbers made_copy(const std::vector<double>& numbers) { return made_numbers(std::vector<double>(numbers)); }

using Rows = std::optional<Table>;

void set_errors(Submap& submap, const Table& sensitivity, const IndexArray& range_power, const Rows& curvature) {
  check(sensitivity.shape(0) == range_power.size() && (range_power.size() == 0 || sensitivity.shape(1) == submap.size()),
        "a sensitivity has a row of the mean's size for each bias");
  for (std::size_t b = 0; b < range_power.size(); b++)
    check(range_power(b) >= graph::NO_POWER && range_power(b) <= 1, "the power of a range is 0, 1 or -1 for none");
  submap.sensitivity = dense::Matrix(matrix_of(sensitivity));
  submap.range_power = listed(range_power);
  check(!curvature || (curvature->shape(0) == range_power.size() && curvature->shape(1) == sensitivity.shape(1)),
        "a curvature has the shape of the sensitivity");
  submap.curvature = curvature ? dense::Matrix(matrix_of(*curvature)) : dense::Matrix();
}

Submap made_submap(const Numbers& mean, const Table& information, const Table& landmarks, const Table& sensitivity,
                   const IndexArray& range_power, const Rows& curvature) {
  const std::size_t n = mean.size(), L = landmarks.shape(0);
  check(landmarks.shape(1) == 3, "a landmark's covariance is (xx, xy, yy)");
  check(n >= 3 + 2 * L && (n - 2 * L) % 3 == 0, "a submap has poses of three numbers, then landmarks of two");
  check(information.shape(0) == n && information.shape(1) == n, "the information matrix must have the mean's size");
  Submap submap{listed(mean), dense::Matrix(matrix_of(information)), {}, {}, {}, {}};
  for (std::size_t l = 0; l < L; l++) submap.landmarks.push_back({landmarks(l, 0), landmarks(l, 1), landmarks(l, 2)});
  set_errors(submap, sensitivity, range_power, curvature);
  return submap;
}

// The indices of a submap's members in a state.
graph::Indices members_of(const Submap& submap, const Numbers& state, const IndexArray& at) {
  check(at.size() == submap.members(), "a submap has an index for each member");
  for (std::size_t k = 0; k < at.size(); k++) {
    const std::int64_t size = k <= submap.poses() ? 3 : k <= submap.points() ? 2 : 1;
    check(at(k) >= 0 && at(k) + size <= std::int64_t(state.size()), "a member is not in the state");
  }
  return {at.data(), at.size()};
}

graph::Sighting made_sighting(const Sighting& from) {
  const auto& [observer, teammate, measurement, information, point] = from;
  check(measurement.size() == 2 && information.shape(0) == 2 && information.shape(1) == 2 && point.size() == 2,
        "an inter-robot measurement is a range and a bearing of a point");
  graph::Sighting made{observer, teammate, {measurement(0), measurement(1)}, {}, {point(0), point(1)}};
  for (std::size_t i = 0; i < 4; i++) made.information[i / 2][i % 2] = information(i / 2, i % 2);
  return made;
}

graph::Prior made_prior(const Prior& from) {
  const auto& [node, mean, information, is_of_bias] = from;
  check(information.shape(0) == mean.size() && information.shape(1) == mean.size(), "a prior's matrix has its mean's size");
  return {node, listed(mean), dense::Matrix(matrix_of(information)), is_of_bias};
}

std::shared_ptr<Graph> made_graph(const IndexArray& offset, const Marks& fixed, const std::vector<SubmapFactor>& submaps,
                                  const std::vector<Sighting>& sightings, const std::vector<Prior>& priors,
                                  std::shared_ptr<Quadratic> condensed) {
  check(offset.size() > 0, "the offsets end with the size of the state");
  std::vector<graph::Joined> joined;
  for (const auto& [submap, nodes] : submaps) joined.push_back({submap, listed(nodes)});
  std::vector<graph::Sighting> seen;
  for (const Sighting& each : sightings) seen.push_back(made_sighting(each));
  std::vector<graph::Prior> known;
  for (const Prior& each : priors) known.push_back(made_prior(each));
  return std::make_shared<Graph>(listed(offset), listed(fixed), std::move(joined), std::move(seen), std::move(known),
                                 std::move(condensed));
}

graph::Marked marked_of(const Graph& graph, const Marks& submaps, const Marks& sightings, const Marks& priors) {
  check(submaps.size() == graph.submaps.size() && sightings.size() == graph.sightings.size() &&
            priors.size() == graph.priors.size(),
        "each factor has a mark");
  return {listed(submaps), listed(sightings), listed(priors)};
}

}  // namespace

void bind_graph(nb::module_& m) {
  nb::class_<Submap>(m, "SubmapFactor",
                     "A submap as a factor between its start pose, its other poses, its landmarks and its biases.\n\n"
                     "mean: of (poses, landmarks); information: P⁻¹; landmarks: each one's own covariance (xx, xy, yy).\n"
                     "sensitivity: ∂mean/∂b, a row per bias; range_power: of each, the power of a landmark's range with\n"
                     "which the bias moves it, 0 or 1; -1 for none. curvature: ∂²mean/∂b², a row per bias.\n"
                     "is_measured: False for a saved map, whose errors belong to no range. A state is additive; `at` has the index in it of the first number of each member.")
      .def("__init__",
           [](Submap* self, const Numbers& mean, const Table& information, const Table& landmarks, const Table& sensitivity,
              const IndexArray& range_power, bool is_measured, const Rows& curvature) {
             new (self) Submap(made_submap(mean, information, landmarks, sensitivity, range_power, curvature));
             self->is_measured = is_measured;
           },
           "mean"_a, "information"_a, "landmarks"_a, "sensitivity"_a, nb::arg("range_power").noconvert(),
           "is_measured"_a = true, "curvature"_a = nb::none())
      .def("with_errors",
           [](const Submap& self, const Table& sensitivity, const IndexArray& range_power, const Rows& curvature) {
             Submap made = self;
             set_errors(made, sensitivity, range_power, curvature);
             return made;
           },
           "sensitivity"_a, nb::arg("range_power").noconvert(), "curvature"_a = nb::none(), "Make the same submap with other biases.")
      .def("normal",
           [](const Submap& self, const Numbers& state, const IndexArray& at) {
             graph::Normal normal = self.normal({state.data(), state.size()}, members_of(self, state, at));
             return std::tuple(made_matrix(std::move(normal.hessian)), made_numbers(std::move(normal.gradient)), normal.chi2);
           },
           "state"_a, nb::arg("at").noconvert(), "Compute JᵀP⁻¹J, JᵀP⁻¹r and χ² = rᵀP⁻¹r over the members.")
      .def("at_joined_ranges",
           [](const Submap& self, const Numbers& state, const IndexArray& at) {
             return self.at_joined_ranges({state.data(), state.size()}, members_of(self, state, at));
           },
           "state"_a, nb::arg("at").noconvert(),
           "Make the same submap with its noise at the ranges in a state, for errors proportional to the range.")
      .def("discounted",
           [](const Submap& self, const Numbers& weights) {
             return self.discounted(values_of(weights, self.landmarks.size(), "each landmark has a weight"));
           },
           "weights"_a,
           "Make the same submap with each landmark's own covariance enlarged by its weight: P + blkdiag(0, (1/w - 1) P_ll).")
      .def_prop_ro("information",
                   [](const Submap& self) { return made_matrix(dense::Matrix(self.information)); },
                   nb::rv_policy::move, "P⁻¹.")
      .def_prop_ro("sensitivity", [](const Submap& self) { return made_matrix(dense::Matrix(self.sensitivity)); },
                   nb::rv_policy::move, "∂mean/∂b, a row per bias.")
      .def_prop_ro("landmarks",
                   [](const Submap& self) {
                     std::vector<double> numbers;
                     for (const auto& each : self.landmarks) numbers.insert(numbers.end(), {each.xx, each.xy, each.yy});
                     return made<double, nb::ndim<2>>(std::move(numbers), {self.landmarks.size(), 3});
                   },
                   nb::rv_policy::move, "Each landmark's own covariance (xx, xy, yy).");
  m.attr("LARGEST_RATIO") = graph::LARGEST_RATIO;

  m.def("linearise_sighting",
        [](const Triple& observer, const Triple& teammate, const Numbers& measurement, const Numbers& point) {
          check(measurement.size() == 2 && point.size() == 2, "an inter-robot measurement is a range and a bearing of a point");
          const graph::Sighting sighting{0, 0, {measurement(0), measurement(1)}, {}, {point(0), point(1)}};
          const auto at = sighting.linear(observer.data(), teammate.data());
          return std::tuple(made_numbers({at.residual, at.residual + 2}),
                            made<double, nb::ndim<2>>({at.jacobian[0], at.jacobian[0] + 12}, {2, 6}));
        },
        "observer"_a, "teammate"_a, "measurement"_a, "point"_a,
        "Compute the residual of an inter-robot measurement (range, bearing) of a teammate's point, and its Jacobian\n"
        "over both poses.");

  nb::class_<Quadratic>(m, "Quadratic",
                        "Old factors, linearised: cost + 2 slopeᵀ d + dᵀ information d, d = x - at with headings wrapped,\n"
                        "over some nodes of a graph, ascending, none of them fixed.")
      .def("__init__",
           [](Quadratic* self, const IndexArray& nodes, const Numbers& at, const Marks& headings, const Table& information,
              const Numbers& slope, double cost) {
             const std::size_t n = at.size();
             check(headings.size() == n && slope.size() == n && information.shape(0) == n && information.shape(1) == n,
                   "the parts of a quadratic must have one size");
             new (self) Quadratic{listed(nodes), listed(at), listed(headings), dense::Matrix(matrix_of(information)),
                                  listed(slope), cost};
           },
           nb::arg("nodes").noconvert(), "at"_a, nb::arg("headings").noconvert(), "information"_a, "slope"_a, "cost"_a);

  m.def("add_product",
        [](const Table& a, const Table& b, const Changed& c, bool upper, bool lower) {
          check(a.shape(1) == b.shape(0), "a must have as many columns as b has rows");
          check(c.shape(0) >= a.shape(0) && c.shape(1) >= b.shape(1), "the sum must have room for the product");
          dense::add_product(matrix_of(a), matrix_of(b), {c.data(), a.shape(0), b.shape(1), c.shape(1)}, {upper, lower});
        },
        "a"_a, "b"_a, nb::arg("c").noconvert(), "upper"_a = false, "lower"_a = false,
        "Add A B to the first rows and columns of C, in place; each entry adds its terms in order.\n\n"
        "upper: only the upper triangle of the square A B is required, the rest of C may change or not. lower: B is\n"
        "lower triangular, entries above its diagonal count as zero.");
  m.def("own_blocks",
        [](const Table& upper, const Table& spread) {
          const std::size_t count = spread.shape(0) / 2, n = spread.shape(1);
          check(spread.shape(0) % 2 == 0 && upper.shape(0) == 2 * count && upper.shape(1) == 2 * count,
                "both matrices must have two rows for each landmark");
          std::vector<double> blocks;
          for (std::size_t k = 0; k < 2 * count; k += 2) {
            const std::span<const double> x{spread.data() + k * n, n}, y{spread.data() + (k + 1) * n, n};
            const double cross = upper(k, k + 1) + dense::inner(x, y);
            blocks.insert(blocks.end(), {upper(k, k) + dense::inner(x, x), cross, cross,
                                         upper(k + 1, k + 1) + dense::inner(y, y)});
          }
          return made<double, nb::ndim<3>>(std::move(blocks), {count, 2, 2});
        },
        "upper"_a, "spread"_a, "Compute the 2 × 2 diagonal blocks of C + S Sᵀ, from the upper triangle of C.");

  nb::class_<Graph>(m, "SubmapGraph",
                    "The factor graph of one frame, independent of the state.\n\n"
                    "offset: of each node's first number in the state, and the state's length. fixed: nodes that are\n"
                    "constants. submaps: (factor, nodes of its members). sightings: (observer's and teammate's node,\n"
                    "measurement, information). priors: (node, mean, information, whether it is of one robot's bias).\n"
                    "Raises ValueError where a factor does not fit its nodes.")
      .def(nb::new_(&made_graph), nb::arg("offset").noconvert(), nb::arg("fixed").noconvert(), "submaps"_a, "sightings"_a,
           "priors"_a, "condensed"_a.none())
      .def_prop_ro("pattern", [](const Graph& self) { return std::const_pointer_cast<sparse::Pattern>(self.pattern()); },
                   "Blocks of the normal equations, a variable per node, and their places in the factor.")
      .def("landmark_chi2",
           [](const Graph& self, const Numbers& state, double covariance_factor) {
             return made_numbers(self.landmark_chi2(state_of(self, state), covariance_factor));
           },
           "state"_a, "covariance_factor"_a,
           "Compute r_lᵀ (covariance_factor · P_ll)⁻¹ r_l of each landmark of each submap.");

  const auto copied = [](const std::vector<double>& (Estimate::*of)() const) {
    return [of](const Estimate& self) { return made_copy((self.*of)()); };
  };
  const auto made_by = [](std::vector<double> (Estimate::*of)() const) {
    return [of](const Estimate& self) { return made_numbers((self.*of)()); };
  };
  nb::class_<Estimate>(m, "Estimate",
                       "A state of a graph, with the weights of the factors there, and its Gauss-Newton step.\n\n"
                       "scale, sighting_scale: widening of the gates of each submap and inter-robot measurement. submap_gate:\n"
                       "factor on the gates of submaps; landmark_gate: χ² of a landmark's. The arrays are in the graph's order. What is computed is kept.")
      .def("__init__",
           [](Estimate* self, std::shared_ptr<Graph> graph, const Numbers& state, const Numbers& scale,
              const Numbers& sighting_scale, bool robust, double submap_gate, double landmark_gate, double covariance_factor,
              bool joined_ranges) {
             new (self) Estimate(std::move(graph), listed(state), listed(scale), listed(sighting_scale),
                                 {robust, submap_gate, landmark_gate, covariance_factor, joined_ranges});
           },
           "graph"_a, "state"_a, "scale"_a, "sighting_scale"_a, "robust"_a, "submap_gate"_a, "landmark_gate"_a,
           "covariance_factor"_a, "joined_ranges"_a)
      .def_prop_ro("landmark_weights", copied(&Estimate::landmark_weights), nb::rv_policy::move,
                   "Weight of each landmark of each submap: 1 up to its gate or without a robust loss.")
      .def_prop_ro("dimensions", made_by(&Estimate::dimensions), nb::rv_policy::move,
                   "Dimension of each submap, a discounted landmark counting by its weight.")
      .def_prop_ro("chi2", copied(&Estimate::chi2), nb::rv_policy::move,
                   "rᵀ(f P)⁻¹r of each submap, with discounted landmarks.")
      .def_prop_ro("whole_chi2", made_by(&Estimate::whole_chi2), nb::rv_policy::move,
                   "rᵀ(f P)⁻¹r of each submap, without discounting.")
      .def_prop_ro("counted_chi2", made_by(&Estimate::counted_chi2), nb::rv_policy::move,
                   "χ² of each submap in which each landmark's share w χ² counts w times.")
      .def_prop_ro("weights", made_by(&Estimate::weights), nb::rv_policy::move, "Robust weight of each submap.")
      .def_prop_ro("sighting_chi2", copied(&Estimate::sighting_chi2), nb::rv_policy::move,
                   "rᵀR⁻¹r of each inter-robot measurement.")
      .def_prop_ro("sighting_weights", made_by(&Estimate::sighting_weights), nb::rv_policy::move,
                   "Robust weight of each inter-robot measurement.")
      .def_prop_ro("prior_chi2", made_by(&Estimate::prior_chi2), nb::rv_policy::move, "χ² of each prior.")
      .def_prop_ro("prior_weights", made_by(&Estimate::prior_weights), nb::rv_policy::move,
                   "Robust weight of each prior: below 1 only for a robot's own bias.")
      .def_prop_ro("cost", &Estimate::cost, "The minimised cost, at these robust scales.")
      .def("cost_of",
           [](const Estimate& self, const Estimate& other) {
             check(&self.graph() == &other.graph(), "both states must be of one graph");
             return self.cost_of(other);
           },
           "other"_a, "Evaluate Σ w χ² of another state with the weights and noise of this one, which a step lowers.")
      .def_prop_ro("normal_equations",
                   [](const Estimate& self) {
                     const auto& [values, gradient] = self.normal_equations();
                     return std::tuple(made_copy(values), made_copy(gradient));
                   },
                   nb::rv_policy::move, "A = Σ w JᵀP⁻¹J in the layout of the graph's pattern, and half the gradient, Σ w JᵀP⁻¹r.")
      .def_prop_ro("gradient", [](const Estimate& self) { return made_copy(self.normal_equations().second); },
                   nb::rv_policy::move, "Half the gradient, Σ w JᵀP⁻¹r.")
      .def_prop_ro("posterior",
                   [](const Estimate& self) { return std::const_pointer_cast<sparse::Cholesky>(self.posterior()); },
                   "The Cholesky factor of A. Raises NotPositiveDefiniteError.")
      .def_prop_ro("step", copied(&Estimate::step), nb::rv_policy::move, "The full step, -A⁻¹g.")
      .def_prop_ro("squared_length",
                   [](const Estimate& self) { return -dense::inner(self.normal_equations().second, self.step()); },
                   "The full step's squared length in standard deviations, gᵀA⁻¹g.")
      .def_prop_ro("selected_covariance", copied(&Estimate::selected_covariance), nb::rv_policy::move,
                   "Entries of A⁻¹ in the layout of the graph's pattern; fixed nodes: identity.")
      .def_prop_ro("boundary_covariance",
                   [](const Estimate& self) { return made_matrix(self.graph().among_boundary(self.selected_covariance())); },
                   nb::rv_policy::move, "The joint covariance of the condensed factor's nodes.")
      .def("take_step",
           [](const Estimate& self, double damping, int halvings, double most_damping) {
             check(damping >= 0.0, "the damping must not be negative");
             graph::Step step = self.take_step(damping, halvings, most_damping);
             std::optional<MadeNumbers> state;
             if (!step.state.empty()) state = made_numbers(std::move(step.state));
             return std::tuple(std::move(state), step.damping, step.change);
           },
           "damping"_a, "halvings"_a, "most_damping"_a,
           "Take the step -(A + damping · diag A)⁻¹g if it lowers the cost; else, if undamped, its half, and so on; else a\n"
           "more damped one, up to most_damping. Returns the next state, the next damping and the full step's largest change; where no damping\n"
           "helps the state is None, the damping infinite and the change that of the first step.")
      .def_prop_ro("explained", made_by(&Estimate::explained), nb::rv_policy::move,
                   "tr(JᵀP⁻¹J Σ) of each submap: the part of its dimension that the solution absorbs.")
      .def_prop_ro("explained_by_sightings", made_by(&Estimate::explained_by_sightings), nb::rv_policy::move,
                   "tr(JᵀR⁻¹J Σ) of each inter-robot measurement.")
      .def_prop_ro("explained_by_priors", made_by(&Estimate::explained_by_priors), nb::rv_policy::move,
                   "tr(P⁻¹ Σ) of each prior.")
      .def("quadratic",
           [](const Estimate& self, const IndexArray& nodes, const Marks& submaps, const Marks& sightings, const Marks& priors) {
             for (std::size_t k = 0; k < nodes.size(); k++)
               check(nodes(k) >= (k ? nodes(k - 1) + 1 : 0) && nodes(k) < std::int64_t(self.graph().nodes()),
                     "nodes must be nodes of the graph, ascending");
             graph::Summed sum =
                 self.quadratic({nodes.data(), nodes.size()}, marked_of(self.graph(), submaps, sightings, priors));
             return std::tuple(made_matrix(std::move(sum.information)), made_numbers(std::move(sum.slope)), sum.cost);
           },
           nb::arg("nodes").noconvert(), nb::arg("submaps").noconvert(), nb::arg("sightings").noconvert(),
           nb::arg("priors").noconvert(),
           "Sum the marked factors and the condensed one to matrix A, half the gradient and the cost, over some nodes,\n"
           "ascending; other nodes are constants.");
}

}  // namespace teamslam::binding
