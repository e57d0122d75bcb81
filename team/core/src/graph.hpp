// The factor graph of one frame, independent of the state: nodes, and factors between them.
//
// Nodes are poses (three numbers of the state), landmarks (two) and biases (one). Factors are submaps,
// inter-robot measurements, priors, and at most one quadratic in place of older factors.
#pragma once

#include <memory>
#include <optional>

#include "condensed.hpp"
#include "sparse.hpp"

namespace teamslam::graph {

// A submap in the graph. nodes: of its members. at: the index in the state of each one's first number.
struct Joined {
  std::shared_ptr<const Submap> submap;
  std::vector<Index> nodes, at = {};
};

// A range [m] and a bearing [rad] that an observer at pose a measures to the point l of a teammate at pose
// b. With v = p_b + R(θ_b) l − p_a and ρ = ‖v‖
//
//     r = z − (ρ, wrap(atan2(v_y, v_x) − θ_a)) ~ N(0, R),
//
// ∂r/∂p_b = −[v/ρ; (−v_y, v_x)/ρ²], ∂r/∂p_a = −∂r/∂p_b, ∂r/∂θ_a = (0, 1), ∂r/∂θ_b = ∂r/∂p_b R′(θ_b) l.
struct Sighting {
  struct Linear {
    double residual[2];
    double jacobian[2][6];  // over both poses
  };

  Index observer, teammate;  // nodes
  double measurement[2], information[2][2];
  double point[2] = {};  // l

  Linear linear(const double* observer_pose, const double* teammate_pose) const;
  // rᵀR⁻¹r.
  double chi2(const Linear& at) const;
  // JᵀR⁻¹J.
  dense::Matrix hessian(const Linear& at) const;
};

// A pose, or biases jointly, ~ N(mean, information⁻¹). The information may be singular, as of a difference.
struct Prior {
  std::vector<Index> nodes;  // one, or several of one number each
  Numbers mean;
  dense::Matrix information;
  bool is_of_bias;  // of one robot, so that a robust loss weighs it

  struct Terms {
    Numbers slope;  // P⁻¹r
    double chi2;    // rᵀP⁻¹r
  };
  Terms terms(Values state, Indices offset) const;
};

// Marks of factors, in the graph's order.
struct Marked {
  std::vector<bool> submaps, sightings, priors;
};

class Graph {
 public:
  // Throws std::invalid_argument where a factor does not fit its nodes.
  Graph(std::vector<Index> offset, std::vector<bool> fixed, std::vector<Joined> submaps,
        std::vector<Sighting> sightings, std::vector<Prior> priors, std::shared_ptr<const Quadratic> condensed);

  std::size_t nodes() const { return fixed.size(); }
  std::size_t unknowns() const { return std::size_t(offset.back()); }
  std::size_t size_of(Index node) const { return std::size_t(offset[node + 1] - offset[node]); }
  std::size_t landmarks() const { return landmark_start.back(); }
  // The indices in the state of the numbers of the condensed factor's nodes.
  Indices boundary() const { return boundary_; }

  // Marks the start pose of a submap and its pose nodes.
  void mark_path(std::size_t submap, std::vector<bool>& nodes) const;
  // Marks of these submaps, and of the other factors with a marked node.
  Marked touching(const std::vector<bool>& submaps, const std::vector<bool>& nodes) const;
  // Marks the nodes of the marked factors.
  void mark_nodes(const Marked& factors, std::vector<bool>& nodes) const;

  // A block variable per node.
  const std::shared_ptr<const sparse::Pattern>& pattern() const;
  // JᵀP⁻¹J of a factor over its nodes, times a weight, is added to the numbers of a matrix on the pattern.
  void add(std::size_t factor, Indices nodes, dense::Const hessian, double weight, Numbers& values) const;
  // tr(JᵀP⁻¹J Σ), given the numbers of Σ on the pattern.
  double trace(std::size_t factor, Indices nodes, dense::Const hessian, Values covariance) const;
  // The symmetric matrix over a factor's nodes, `size` numbers, of one on the pattern; zero of fixed nodes.
  dense::Matrix among(std::size_t factor, Indices nodes, std::size_t size, Values values) const;
  dense::Matrix among_boundary(Values values) const;  // over those of the condensed factor
  // Where the diagonal block of a node begins.
  std::size_t diagonal_of(Index node) const;
  // The factors' numbers: submaps, then inter-robot measurements, the condensed factor, priors.
  std::size_t of_sighting(std::size_t s) const { return submaps.size() + s; }
  std::size_t of_condensed() const { return submaps.size() + sightings.size(); }
  std::size_t of_prior(std::size_t k) const { return of_condensed() + (condensed ? 1 : 0) + k; }

  // χ² of each landmark of each submap, as measured.
  Numbers landmark_chi2(Values state, double covariance_factor) const;

  const std::vector<Index> offset;  // of each node's first number in the state, and the state's length
  const std::vector<bool> fixed;    // nodes that are constants
  const std::vector<Joined> submaps;
  const std::vector<std::size_t> landmark_start;  // of each submap's landmarks among all
  const std::vector<Sighting> sightings;
  const std::vector<Prior> priors;
  const std::shared_ptr<const Quadratic> condensed;

 private:
  struct Blocks {  // entry: of the pattern, for each pair of members of each factor, −1 for none
    std::shared_ptr<const sparse::Pattern> pattern;
    std::vector<Index> entry;
    std::vector<std::size_t> entry_start;
  };
  const Blocks& blocks() const;
  Blocks make_blocks() const;
  template <class F>
  void each_block(std::size_t factor, Indices nodes, F&& do_block) const;

  std::vector<Index> boundary_;
  mutable std::optional<Blocks> blocks_;  // made when it is first needed
};

}  // namespace teamslam::graph
