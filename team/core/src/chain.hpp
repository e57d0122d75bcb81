// A prior and the submaps after it, each beginning at the end of the one before: one small
// least-squares problem.
#pragma once

#include "own_map.hpp"
#include "submap_factor.hpp"

namespace teamslam::maps {

// Why a chain has no solution: an unknown is undetermined, or a map has no covariance.
enum class ChainFault : int { NONE = 0, UNDETERMINED = 1, NO_COVARIANCE = 2 };

// map: the last end pose and all landmarks. cost: χ² of all maps, in `dof` degrees of freedom. known:
// for each map after the first, the number of its landmarks that another map has, too. landmark_chi2:
// of each landmark of these maps. at: the map without covariance.
struct ChainSolution {
  WholeMap map;
  double cost = 0.0;
  std::ptrdiff_t dof = 0;
  std::vector<std::int64_t> known;
  std::vector<double> landmark_chi2;
  ChainFault fault = ChainFault::NONE;
  std::size_t at = 0;
};

// The unknowns are the end pose of each map and the landmarks, a few tens of numbers; most factors
// contain most of them, so the matrix is dense. The last pose and the landmarks stand last: their
// covariance is the inverse of the last block of the factor.
class Chain {
 public:
  // Maps without pose nodes.
  explicit Chain(const LocalMap& prior) { append(prior); }
  void append(const LocalMap& submap);

  // Minimises over all poses and landmarks without robust losses, by `gauss_newton::take_step`; stops where
  // no number of an undamped step reaches the tolerance.
  ChainSolution solve(int iterations, double tolerance) const;

 private:
  struct Problem;
  struct Link {
    std::vector<std::uint32_t> ids;
    graph::Submap factor;
  };

  std::vector<Link> links_;
  std::optional<std::size_t> without_covariance_;  // the first map that has none
};

}  // namespace teamslam::maps
