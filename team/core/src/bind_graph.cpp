// Bindings of the submap graph and its estimate.
#include <nanobind/stl/pair.h>
#include <nanobind/stl/vector.h>

#include "binding.hpp"
#include "estimate.hpp"
#include "scan.hpp"

namespace teamslam::binding {

using dense::Matrix;
using graph::Estimate, graph::Graph, graph::Index, graph::Indices, graph::Quadratic, graph::Submap, graph::Values;

namespace {

using SubmapFactor = std::tuple<std::shared_ptr<Submap>, std::vector<Index>>;
using Sighting = std::tuple<Index, Index, Values, Table, Values>;
using Prior = std::tuple<std::vector<Index>, graph::Numbers, Matrix, bool>;
using Rows = std::optional<Matrix>;
using Marks = std::vector<bool>;

Values state_of(const Graph& graph, Values state) {
  check(state.size() == graph.unknowns(), "the state has not the size of the graph");
  return state;
}

bool is_square(const Matrix& matrix, std::size_t n) { return matrix.rows() == n && matrix.columns() == n; }

void set_errors(Submap& submap, const Matrix& sensitivity, const std::vector<Index>& range_power, const Rows& curvature) {
  check(sensitivity.rows() == range_power.size() && (range_power.empty() || sensitivity.columns() == submap.size()),
        "a sensitivity has a row of the mean's size for each bias");
  for (const Index power : range_power)
    check(power >= graph::NO_POWER && power <= 1, "the power of a range is 0, 1 or -1 for none");
  check(!curvature || (curvature->rows() == range_power.size() && curvature->columns() == sensitivity.columns()),
        "a curvature has the shape of the sensitivity");
  submap.sensitivity = sensitivity;
  submap.range_power = range_power;
  submap.curvature = curvature.value_or(Matrix());
}

Submap made_submap(const graph::Numbers& mean, const Matrix& information, const Matrix& landmarks, const Matrix& sensitivity,
                   const std::vector<Index>& range_power, bool is_measured, const Rows& curvature) {
  const std::size_t n = mean.size(), L = landmarks.rows();
  check(landmarks.columns() == 3, "a landmark's covariance is (xx, xy, yy)");
  check(n >= 3 + 2 * L && (n - 2 * L) % 3 == 0, "a submap has poses of three numbers, then landmarks of two");
  check(is_square(information, n), "the information matrix must have the mean's size");
  Submap submap{mean, information, {}, {}, {}, {}, is_measured};
  for (std::size_t l = 0; l < L; l++) submap.landmarks.push_back({landmarks[l][0], landmarks[l][1], landmarks[l][2]});
  set_errors(submap, sensitivity, range_power, curvature);
  return submap;
}

scan::Observed observed_of(const Table& points, const Table& spread, double most) {
  check(points.shape(1) == 2 && spread.shape(1) == 3 && points.shape(0) == spread.shape(0),
        "an observation has a point (x, y) and a covariance (xx, xy, yy)");
  return {matrix_of(points), matrix_of(spread), most};
}

// Nodes, or -1 - k for the k-th landmark at rest, in a map.
Indices members_of(const Estimate& estimate, Indices members, bool are_landmarks) {
  const Graph& graph = estimate.graph();
  const Index at_rest = graph.condensed ? Index(graph.condensed->resting.means.size() / 2) : 0;
  for (const Index member : members) {
    check(-1 - member < at_rest && member < Index(graph.nodes()), "there is no such member of the map");
    check(!are_landmarks || member < 0 || graph.size_of(member) == 2, "a landmark has two numbers");
  }
  return members;
}

// The indices of a submap's members in a state.
Indices members_of(const Submap& submap, Values state, Indices at) {
  check(at.size() == submap.members(), "a submap has an index for each member");
  for (std::size_t k = 0; k < at.size(); k++) {
    const Index size = k <= submap.poses() ? 3 : k <= submap.points() ? 2 : 1;
    check(at[k] >= 0 && at[k] + size <= Index(state.size()), "a member is not in the state");
  }
  return at;
}

graph::Sighting made_sighting(const Sighting& from) {
  const auto& [observer, teammate, measurement, information, point] = from;
  check(measurement.size() == 2 && information.shape(0) == 2 && information.shape(1) == 2 && point.size() == 2,
        "an inter-robot measurement is a range and a bearing of a point");
  graph::Sighting made{observer, teammate, {measurement[0], measurement[1]}, {}, {point[0], point[1]}};
  for (std::size_t i = 0; i < 4; i++) made.information[i / 2][i % 2] = information(i / 2, i % 2);
  return made;
}

graph::Prior made_prior(const Prior& from) {
  const auto& [nodes, mean, information, is_of_bias] = from;
  check(is_square(information, mean.size()), "a prior's matrix has its mean's size");
  return {nodes, mean, information, is_of_bias};
}

std::shared_ptr<Graph> made_graph(const std::vector<Index>& offset, const Marks& fixed, const std::vector<SubmapFactor>& submaps,
                                  const std::vector<Sighting>& sightings, const std::vector<Prior>& priors,
                                  std::shared_ptr<Quadratic> condensed) {
  std::vector<graph::Joined> joined;
  for (const auto& [submap, nodes] : submaps) joined.push_back({submap, nodes});
  std::vector<graph::Sighting> seen;
  for (const Sighting& each : sightings) seen.push_back(made_sighting(each));
  std::vector<graph::Prior> known;
  for (const Prior& each : priors) known.push_back(made_prior(each));
  return std::make_shared<Graph>(offset, fixed, std::move(joined), std::move(seen), std::move(known), std::move(condensed));
}

}  // namespace

void bind_graph(nb::module_& m) {
  nb::class_<Submap>(m, "SubmapFactor",
                     "A submap as a factor between its start pose, its other poses, its landmarks and its biases.\n\n"
                     "mean: of (poses, landmarks); information: P⁻¹; landmarks: each one's own covariance (xx, xy, yy).\n"
                     "sensitivity: ∂mean/∂b, a row per bias; range_power: of each, the power of a landmark's range with\n"
                     "which the bias moves it, 0 or 1; -1 for none. curvature: ∂²mean/∂b², a row per bias.\n"
                     "is_measured: False for a saved map, whose errors belong to no range. at: index in the state of the first\n"
                     "number of each member.")
      .def("__init__",
           [](Submap* self, const graph::Numbers& mean, const Matrix& information, const Matrix& landmarks,
              const Matrix& sensitivity, const std::vector<Index>& range_power, bool is_measured, const Rows& curvature) {
             new (self) Submap(made_submap(mean, information, landmarks, sensitivity, range_power, is_measured, curvature));
           },
           "mean"_a, "information"_a, "landmarks"_a, "sensitivity"_a, "range_power"_a, "is_measured"_a = true,
           "curvature"_a = nb::none())
      .def("with_errors",
           [](const Submap& self, const Matrix& sensitivity, const std::vector<Index>& range_power, const Rows& curvature) {
             Submap made = self;
             set_errors(made, sensitivity, range_power, curvature);
             return made;
           },
           "sensitivity"_a, "range_power"_a, "curvature"_a = nb::none(), "Make the same submap with other biases.")
      .def("normal",
           [](const Submap& self, Values state, Indices at) {
             graph::Normal normal = self.normal(state, members_of(self, state, at));
             return std::tuple(std::move(normal.hessian), std::move(normal.gradient), normal.chi2);
           },
           "state"_a, "at"_a, "Compute JᵀP⁻¹J, JᵀP⁻¹r and χ² = rᵀP⁻¹r over the members.")
      .def("at_joined_ranges",
           [](const Submap& self, Values state, Indices at) { return self.at_joined_ranges(state, members_of(self, state, at)); },
           "state"_a, "at"_a, "Make the same submap with its noise at the ranges in a state, for errors proportional to the range.")
      .def("discounted",
           [](const Submap& self, Values weights) {
             check(weights.size() == self.landmarks.size(), "each landmark has a weight");
             return self.discounted(weights);
           },
           "weights"_a,
           "Make the same submap with each landmark's own covariance enlarged by its weight: P + blkdiag(0, (1/w - 1) P_ll).")
      .def_ro("information", &Submap::information, "P⁻¹.")
      .def_ro("sensitivity", &Submap::sensitivity, "∂mean/∂b, a row per bias.")
      .def_prop_ro("landmarks",
                   [](const Submap& self) {
                     Matrix landmarks(self.landmarks.size(), 3);
                     for (std::size_t l = 0; l < landmarks.rows(); l++) {
                       const auto& [xx, xy, yy] = self.landmarks[l];
                       landmarks[l][0] = xx, landmarks[l][1] = xy, landmarks[l][2] = yy;
                     }
                     return landmarks;
                   },
                   "Each landmark's own covariance (xx, xy, yy).");
  m.attr("LARGEST_RATIO") = graph::LARGEST_RATIO;

  nb::class_<Quadratic>(m, "Quadratic",
                        "Old factors, linearised: cost + 2 slopeᵀ d + dᵀ information d, d = x - at with headings wrapped,\n"
                        "over some nodes of a graph, none of them fixed; and the landmarks at rest given these nodes.")
      .def("__init__",
           [](Quadratic* self, const std::vector<Index>& nodes, const graph::Numbers& at, const Marks& headings,
              const Matrix& information, const graph::Numbers& slope, double cost) {
             const std::size_t n = at.size();
             check(headings.size() == n && slope.size() == n && is_square(information, n),
                   "the parts of a quadratic must have one size");
             new (self) Quadratic{{information, slope, cost}, nodes, at, headings, {}};
             self->resting.gain = Matrix(0, n);
           },
           "nodes"_a, "at"_a, "headings"_a, "information"_a, "slope"_a, "cost"_a)
      .def_ro("nodes", &Quadratic::nodes)
      .def_ro("at", &Quadratic::at, "Linearisation point.")
      .def_ro("headings", &Quadratic::is_heading, "Marks of the headings.")
      .def_ro("information", &Quadratic::information)
      .def_ro("slope", &Quadratic::slope)
      .def_ro("cost", &Quadratic::cost)
      .def("woken",
           [](const Quadratic& self, const std::vector<Index>& places, const std::vector<Index>& nodes) {
             check(places.size() == nodes.size(), "each landmark has a node");
             std::vector<std::size_t> ascending;
             for (std::size_t k = 0; k < places.size(); k++) {
               check(places[k] >= (k ? places[k - 1] + 1 : 0) && 2 * std::size_t(places[k]) < self.resting.means.size(),
                     "places must be of landmarks at rest, ascending");
               ascending.push_back(std::size_t(places[k]));
             }
             std::optional<Quadratic> made = self.woken(ascending, nodes);
             if (!made) throw sparse::NotPositiveDefinite(nodes[0]);
             return std::move(*made);
           },
           "places"_a, "nodes"_a,
           "Turn some landmarks at rest, by ascending place, into nodes; exact, since the others at rest are conditioned on\n"
           "them. Raises NotPositiveDefiniteError.");

  m.def("scatter_of_landmarks",
        [](const Table& points, const Table& spread, Indices of, std::size_t count, double most) {
          const scan::Observed observed = observed_of(points, spread, most);
          check(of.size() == points.shape(0), "each observation has a landmark");
          for (const Index each : of) check(each >= 0 && std::size_t(each) < count, "a landmark is beyond the count");
          return scan::scatter(observed, of, count);
        },
        "points"_a, "spread"_a, "of"_a, "count"_a, "most"_a,
        "Sum chi2 of each landmark's observations N(points, spread (xx, xy, yy)) about their median, each at most `most`.");
  m.def("change_of",
        [](const Table& points, const Table& spread, std::size_t least, double most) -> std::optional<std::pair<Index, double>> {
          check(least > 0, "each place has an observation");
          const auto found = scan::change(observed_of(points, spread, most), least);
          if (!found) return {};
          return std::pair{found->before, found->gain};
        },
        "points"_a, "spread"_a, "least"_a, "most"_a,
        "Find where the place of a landmark changes most: the number of observations before, and by how much chi2 about\n"
        "two medians, each of at least `least`, is smaller than about one. None with too few.");

  nb::class_<Graph>(m, "SubmapGraph",
                    "The factor graph of one frame, independent of the state.\n\n"
                    "offset: of each node's first number in the state, and the state's length. fixed: nodes that are\n"
                    "constants. submaps: (factor, nodes of its members). sightings: (observer's and teammate's node,\n"
                    "measurement, information). priors: (nodes, mean, information, whether it is of one robot's bias).\n"
                    "Raises ValueError for a factor that does not fit its nodes.")
      .def(nb::new_(&made_graph), "offset"_a, "fixed"_a, "submaps"_a, "sightings"_a, "priors"_a, "condensed"_a.none())
      .def_prop_ro("pattern", [](const Graph& self) { return std::const_pointer_cast<sparse::Pattern>(self.pattern()); },
                   "Blocks of the normal equations, a variable per node, and their places in the factor.")
      .def("landmark_chi2",
           [](const Graph& self, Values state, double covariance_factor) {
             return self.landmark_chi2(state_of(self, state), covariance_factor);
           },
           "state"_a, "covariance_factor"_a,
           "Compute r_lᵀ (covariance_factor · P_ll)⁻¹ r_l of each landmark of each submap.");

  nb::class_<Estimate>(m, "Estimate",
                       "A state of a graph, with the weights of the factors at it, and its Gauss-Newton step.\n\n"
                       "scale, sighting_scale: widening of the gates of each submap and inter-robot measurement. submap_gate:\n"
                       "factor on the gates of submaps; landmark_gate: χ² of a landmark's. Arrays are in the graph's order; results are cached.")
      .def("__init__",
           [](Estimate* self, std::shared_ptr<Graph> graph, const graph::Numbers& state, const graph::Numbers& scale,
              const graph::Numbers& sighting_scale, bool robust, double submap_gate, double landmark_gate,
              double covariance_factor, bool joined_ranges) {
             new (self) Estimate(std::move(graph), state, scale, sighting_scale,
                                 {robust, submap_gate, landmark_gate, covariance_factor, joined_ranges});
           },
           "graph"_a, "state"_a, "scale"_a, "sighting_scale"_a, "robust"_a, "submap_gate"_a, "landmark_gate"_a,
           "covariance_factor"_a, "joined_ranges"_a)
      .def_prop_ro("landmark_weights", &Estimate::landmark_weights,
                   "Weight of each landmark of each submap: 1 up to its gate or without a robust loss.")
      .def_prop_ro("dimensions", &Estimate::dimensions,
                   "Dimension of each submap, a discounted landmark counting by its weight.")
      .def_prop_ro("chi2", &Estimate::chi2, "rᵀ(f P)⁻¹r of each submap, with discounted landmarks.")
      .def_prop_ro("whole_chi2", &Estimate::whole_chi2, "rᵀ(f P)⁻¹r of each submap, without discounting.")
      .def_prop_ro("counted_chi2", &Estimate::counted_chi2,
                   "χ² of each submap in which each landmark's share w χ² counts w times.")
      .def_prop_ro("weights", &Estimate::weights, "Robust weight of each submap.")
      .def_prop_ro("sighting_chi2", &Estimate::sighting_chi2, "rᵀR⁻¹r of each inter-robot measurement.")
      .def_prop_ro("sighting_weights", &Estimate::sighting_weights, "Robust weight of each inter-robot measurement.")
      .def_prop_ro("prior_chi2", &Estimate::prior_chi2, "χ² of each prior.")
      .def_prop_ro("prior_weights", &Estimate::prior_weights, "Robust weight of each prior: below 1 only for a robot's own bias.")
      .def_prop_ro("cost", &Estimate::cost, "Cost at these robust scales.")
      .def_prop_ro("normal_equations", &Estimate::normal_equations,
                   "A = Σ w JᵀP⁻¹J in the layout of the graph's pattern, and half the gradient, Σ w JᵀP⁻¹r.")
      .def_prop_ro("gradient", [](const Estimate& self) { return self.normal_equations().second; },
                   "Half the gradient, Σ w JᵀP⁻¹r.")
      .def_prop_ro("posterior",
                   [](const Estimate& self) { return std::const_pointer_cast<sparse::Cholesky>(self.posterior()); },
                   "Cholesky factor of A. Raises NotPositiveDefiniteError.")
      .def_prop_ro("step", &Estimate::step, "Full step, -A⁻¹g.")
      .def_prop_ro("squared_length",
                   [](const Estimate& self) { return -dense::inner(self.normal_equations().second, self.step()); },
                   "Squared length of the full step in standard deviations, gᵀA⁻¹g.")
      .def_prop_ro("selected_covariance", &Estimate::selected_covariance,
                   "Entries of A⁻¹ in the layout of the graph's pattern; fixed nodes: identity.")
      .def("take_step",
           [](const Estimate& self, double damping, int halvings, double most_damping) {
             check(damping >= 0.0, "the damping must not be negative");
             gauss_newton::Step step = self.take_step(damping, halvings, most_damping);
             std::optional<graph::Numbers> state;
             if (!step.state.empty()) state = std::move(step.state);
             return std::tuple(std::move(state), step.damping, step.change);
           },
           "damping"_a, "halvings"_a, "most_damping"_a,
           "Take the step -(A + damping · diag A)⁻¹g if it lowers the cost; else, if undamped, its half, and so on; else a\n"
           "more damped one, up to most_damping. Returns the next state, the next damping and the full step's largest\n"
           "change; if no damping helps, None, infinity and the change of the first step.")
      .def_prop_ro("explained", &Estimate::explained,
                   "tr(JᵀP⁻¹J Σ) of each submap: the part of its dimension that the solution absorbs.")
      .def_prop_ro("explained_by_sightings", &Estimate::explained_by_sightings, "tr(JᵀR⁻¹J Σ) of each inter-robot measurement.")
      .def_prop_ro("explained_by_priors", &Estimate::explained_by_priors, "tr(P⁻¹ Σ) of each prior.")
      .def_prop_ro("observations",
                   [](const Estimate& self) {
                     graph::Observations found = self.observations();
                     return std::tuple(std::move(found.points), std::move(found.spread));
                   },
                   "Points of the landmarks of each submap by its start pose, and their covariances (xx, xy, yy) from that of\n"
                   "the start pose and their own.")
      .def("points",
           [](const Estimate& self, Indices members) {
             graph::Numbers found = self.points(members_of(self, members, true));
             return made<double, nb::ndim<2>>(std::move(found), {members.size(), 2});
           },
           "members"_a, "Find the points of landmarks, by their nodes, or -1 - k for the k-th at rest.")
      .def("blocks",
           [](const Estimate& self, Indices members) {
             graph::Numbers found = self.blocks(members_of(self, members, true));
             return made<double, nb::ndim<3>>(std::move(found), {members.size(), 2, 2});
           },
           "members"_a, "Compute the covariance of each landmark; zero of a fixed node. members: as of `points`.")
      .def("joint", [](const Estimate& self, Indices members) { return self.joint(members_of(self, members, false)); },
           "members"_a,
           "Compute mean and joint covariance of nodes and of landmarks at rest; zero of fixed nodes. members: as of `points`.")
      .def("condense",
           [](const Estimate& self, const Marks& leaving, Indices resting, Indices given_up,
              const std::vector<std::vector<Index>>& runs) {
             const Graph& graph = self.graph();
             const std::size_t count = graph.submaps.size();
             check(leaving.size() == count, "each submap has a mark");
             Marks listed(count);
             for (const std::vector<Index>& run : runs) {
               check(!run.empty(), "a run has a submap");
               for (const Index f : run) {
                 check(f >= 0 && std::size_t(f) < count && leaving[f] && !listed[f], "the runs have each leaving submap once");
                 listed[f] = true;
               }
             }
             check(listed == leaving, "the runs have each leaving submap once");
             for (const Indices nodes : {resting, given_up})
               for (std::size_t k = 0; k < nodes.size(); k++)
                 check(nodes[k] >= (k ? nodes[k - 1] + 1 : 0) && std::size_t(nodes[k]) < graph.nodes() &&
                           graph.size_of(nodes[k]) == 2 && !graph.fixed[nodes[k]],
                       "landmarks must be free nodes of two numbers, ascending");
             graph::Condensing made = self.condense(leaving, resting, given_up, runs);
             return std::tuple(std::move(made.factor), std::move(made.eliminated), made.unknowns,
                               std::move(made.factors.sightings), std::move(made.factors.priors));
           },
           "leaving"_a, "resting"_a, "given_up"_a, "runs"_a,
           "Condense some submaps: eliminate their poses but for the ends of the paths, and landmarks that come to rest or\n"
           "are given up. runs: the submaps in the order in which they are eliminated, if none has been before.\n\n"
           "Returns the factor over the renumbered nodes that stay, marks of the eliminated nodes and the number of their\n"
           "free unknowns, and marks of the inter-robot measurements and priors in it. Raises NotPositiveDefiniteError.");
}

}  // namespace teamslam::binding
