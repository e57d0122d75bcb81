// A state of a graph, with the weights of the factors there, and its Gauss-Newton step.
//
// Minimises Σ ρ(rᵀ(f P)⁻¹r) + Σ ρ(inter-robot measurement) + Σ ρ(prior) + condensed factor by iterated
// re-weighting. ρ(χ²) is χ² up to a gate g that a sound factor does not exceed, and g (2 − g/χ²) beyond,
// whose slope, the weight, is (g/χ²)²; of the priors only those of single robots' biases have a loss,
// Cauchy's. Each landmark of a submap has a gate and a weight of its own as well.
#pragma once

#include "gauss_newton.hpp"
#include "graph.hpp"

namespace teamslam::graph {

inline constexpr double LEAST_WEIGHT = 1e-6;  // of a landmark, so that each stays determined

struct Loss {
  bool is_robust;                  // otherwise all weights are 1
  double submap_gate;              // factor on the gate of a submap as a whole
  double landmark_gate;            // χ² of two numbers from which a landmark is discounted
  double covariance_factor;
  bool has_joined_ranges;          // whether errors of ranges are proportional to those of the joined map
};

// The condensed factor after some submaps have left, and what it takes from the graph: eliminated nodes, of so many
// free numbers, and factors.
struct Condensing {
  Quadratic factor;  // over the renumbered nodes that stay
  std::vector<bool> eliminated;
  std::size_t unknowns;
  Marked factors;
};

// A row for each landmark of each submap: its point in the frame by the submap's start pose, and its
// covariance (xx, xy, yy) from that of the start pose and its own.
struct Observations {
  dense::Matrix points, spread;
};

class Estimate {
 public:
  // scale, sighting_scale: widening of the gates of each submap and inter-robot measurement; its square
  // multiplies them, and it narrows to 1.
  Estimate(std::shared_ptr<const Graph> graph, Numbers state, Numbers scale, Numbers sighting_scale, Loss loss);

  const Graph& graph() const { return *graph_; }
  const Numbers& state() const { return state_; }

  const Numbers& landmark_weights() const;  // of each landmark of each submap
  Numbers dimensions() const;               // of each submap, a discounted landmark counting by its weight
  const Numbers& chi2() const;              // rᵀ(f P)⁻¹r of each submap, with discounted landmarks
  Numbers whole_chi2() const;               // without discounting
  Numbers counted_chi2() const;             // with each landmark's share w χ² counting w times
  Numbers weights() const;                  // of the submaps
  const Numbers& sighting_chi2() const;
  Numbers sighting_weights() const;
  Numbers prior_chi2() const;
  Numbers prior_weights() const;

  // Σ w χ² of another state with the weights and noise of this one, which an iteration lowers. The
  // robust cost then falls too, since each loss lies below its parabola.
  double cost_of(const Estimate& other) const;
  // The minimised cost, at the present robust scales: of all factors, or of the marked ones and never of
  // the condensed one.
  double cost() const;
  double cost_of_factors(const Marked& marked) const;

  // A = Σ w JᵀP⁻¹J on the graph's pattern, and half the gradient, Σ w JᵀP⁻¹r. A fixed node has an
  // identity block without couplings and a zero gradient, so that its step is zero.
  const std::pair<Numbers, Numbers>& normal_equations() const;
  // Throw sparse::NotPositiveDefinite.
  const std::shared_ptr<const sparse::Cholesky>& posterior() const;
  const Numbers& step() const;  // −A⁻¹g
  const Numbers& selected_covariance() const;

  // `gauss_newton::take_step` by −(A + damping · diag A)⁻¹g.
  gauss_newton::Step take_step(double damping, int halvings, double most_damping) const;

  // tr(JᵀP⁻¹J Σ) of each factor: the part of its numbers that the solution absorbs. For a solution with
  // these weights the sum over all factors is the number of unknowns.
  Numbers explained() const;
  Numbers explained_by_sightings() const;
  Numbers explained_by_priors() const;

  // Throws sparse::NotPositiveDefinite.
  Observations observations() const;

  // Eliminates the old poses of the leaving submaps and some landmarks: those that come to rest, and those that are
  // given up. runs: the leaving submaps in the order of their elimination where none has left before.
  //
  // A run of old poses touches only the landmarks seen along it and the poses at its ends. Each is eliminated from a
  // dense quadratic over these, whose rest is a factor of the next run (George 1973, SIAM J. Numer. Anal. 10(2), by
  // blocks). Throws sparse::NotPositiveDefinite.
  Condensing condense(const std::vector<bool>& leaving, Indices resting, Indices given_up,
                      const std::vector<std::vector<Index>>& runs) const;

  // Of members of the map, by their node or, at rest, as −1 less their place there: points of landmarks, the
  // covariance (xx, xy, xy, yy) of each, and mean and joint covariance. Fixed nodes have a covariance of zero.
  //
  // Of a landmark at rest x = means + gain d + e, Cov(x, z) = gain Cov(d, z) and Cov(x, x') = C + gain Cov(d, d) gainᵀ.
  Numbers points(Indices members) const;
  Numbers blocks(Indices members) const;
  std::pair<Numbers, dense::Matrix> joint(Indices members) const;

 private:
  using Submaps = std::vector<std::shared_ptr<const Submap>>;

  const Submaps& submaps() const;  // with the noise of this state, without discounting
  const Submaps& discounted() const;
  Submaps discounted_by(const Numbers& weights) const;
  Numbers costs(const Submaps& submaps, const Numbers& state) const;
  const std::pair<Numbers, Numbers>& landmark_chi2_and_gate() const;
  const std::vector<Prior::Terms>& prior_terms() const;
  const Quadratic::Terms& condensed_terms() const;
  Numbers gates() const;           // of the submaps
  Numbers sighting_gates() const;
  Numbers moved(const Numbers& step, double share) const;
  // The marked factors and the condensed one as one quadratic at this state, over these nodes, ascending; the
  // factors' other nodes are constants.
  Summed quadratic(Indices nodes, const Marked& marked) const;
  Summed eliminate_paths(const std::vector<std::vector<Index>>& runs, Marked rest, const std::vector<bool>& eliminated,
                         std::vector<Index>& nodes) const;
  std::vector<std::size_t> places_of(Indices nodes) const;
  const Numbers& resting_points() const;
  const dense::Matrix& resting_spread() const;  // G R, with the gain G and R Rᵀ = Cov(d, d)
  const dense::Matrix& boundary_covariance() const;
  Sighting::Linear linear(const Sighting& sighting) const {
    return sighting.linear(&state_[graph_->offset[sighting.observer]], &state_[graph_->offset[sighting.teammate]]);
  }

  std::shared_ptr<const Graph> graph_;
  Numbers state_, scale_, sighting_scale_;
  Loss loss_;
  // Made when they are first needed.
  mutable std::optional<Submaps> submaps_, discounted_;
  mutable std::optional<Numbers> weights_, chi2_, sighting_chi2_, step_, covariance_, resting_points_;
  mutable std::optional<dense::Matrix> resting_spread_, boundary_covariance_;
  mutable std::optional<std::pair<Numbers, Numbers>> landmark_chi2_, normal_;
  mutable std::optional<std::vector<Prior::Terms>> prior_terms_;
  mutable std::optional<Quadratic::Terms> condensed_terms_;
  mutable std::shared_ptr<const sparse::Cholesky> posterior_;
};

}  // namespace teamslam::graph
