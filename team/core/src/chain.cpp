#include "chain.hpp"

#include <algorithm>

#include "gauss_newton.hpp"
#include "gaussian.hpp"

namespace teamslam::maps {

namespace {

using dense::Matrix;
using Numbers = std::vector<double>;

constexpr int HALVINGS = 4;  // of an undamped step, tried before damping
constexpr double MOST_DAMPING = 1e8;

}  // namespace

// The unknowns: the origin (which stays zero), the end pose of each map, the landmarks by ascending id.
struct Chain::Problem {
  const std::vector<Link>& links;
  std::vector<std::uint32_t> ids;
  std::vector<std::vector<graph::Index>> at;       // of each map's members
  std::vector<std::vector<std::size_t>> unknowns;  // of each map
  Numbers state;
  double chi2;      // of the state
  Matrix of_prior;  // its part of the normal equations, which is constant: the prior begins at the origin

  explicit Problem(const std::vector<Link>& all) : links(all) {
    for (const Link& link : links) ids.insert(ids.end(), link.ids.begin(), link.ids.end());
    std::sort(ids.begin(), ids.end());
    ids.erase(std::unique(ids.begin(), ids.end()), ids.end());
    for (std::size_t k = 0; k < links.size(); k++) {
      at.push_back({graph::Index(3 * k), graph::Index(3 * k + 3)});
      for (const std::uint32_t id : links[k].ids) at[k].push_back(graph::Index(poses() + 2 * slot(id)));
      unknowns.emplace_back();
      for (std::size_t a = 0; a < at[k].size(); a++)
        for (std::size_t p = 0; p < (a < 2 ? 3u : 2u); p++) unknowns[k].push_back(std::size_t(at[k][a]) + p);
    }
    guess();
    chi2 = cost(state);
    of_prior = Matrix(state.size(), state.size());
    for (std::size_t i = 0; i < 3; i++) of_prior[i][i] = 1.0;
    const Matrix& information = links[0].factor.information;
    for (std::size_t i = 0; i < information.rows(); i++)
      for (std::size_t j = 0; j < information.rows(); j++)
        of_prior[unknowns[0][3 + i]][unknowns[0][3 + j]] = information[i][j];
  }

  std::size_t poses() const { return 3 * (links.size() + 1); }
  std::size_t slot(std::uint32_t id) const {
    return std::size_t(std::lower_bound(ids.begin(), ids.end(), id) - ids.begin());
  }

  // Places each map after the one before, each landmark by the first map that has it.
  void guess() {
    state.assign(poses() + 2 * ids.size(), 0.0);
    std::vector<bool> is_placed(ids.size());
    for (std::size_t k = 0; k < links.size(); k++) {
      const Numbers& mean = links[k].factor.mean;
      const double* begin = &state[3 * k];
      const se2::Pose<double> start{begin[0], begin[1], begin[2]};
      const se2::Pose<double> end = se2::compose(start, {mean[0], mean[1], mean[2]});
      std::copy_n(std::array{end.x, end.y, end.heading}.begin(), 3, &state[3 * k + 3]);
      for (std::size_t i = 0; i < links[k].ids.size(); i++) {
        const std::size_t own = slot(links[k].ids[i]);
        if (is_placed[own]) continue;
        is_placed[own] = true;
        const se2::Point<double> point = se2::transformed(start, {mean[3 + 2 * i], mean[4 + 2 * i]});
        state[poses() + 2 * own] = point.x;
        state[poses() + 2 * own + 1] = point.y;
      }
    }
  }

  double cost(const Numbers& of) const {
    double sum = 0.0;
    for (std::size_t k = 0; k < links.size(); k++) sum += links[k].factor.chi2(of, at[k]);
    return sum;
  }

  // Σ JᵀP⁻¹J and Σ JᵀP⁻¹r; the origin has an identity block and a zero gradient.
  Matrix normal_equations(Numbers& gradient) const {
    Matrix H = of_prior;
    gradient.assign(state.size(), 0.0);
    const graph::Submap& prior = links[0].factor;
    const Numbers slope = dense::product(prior.information, prior.residual(state, at[0]).numbers);
    for (std::size_t i = 0; i < slope.size(); i++) gradient[unknowns[0][3 + i]] = slope[i];
    for (std::size_t k = 1; k < links.size(); k++) {
      const graph::Normal normal = links[k].factor.normal(state, at[k]);
      const std::vector<std::size_t>& own = unknowns[k];
      for (std::size_t i = 0; i < own.size(); i++) {
        gradient[own[i]] += normal.gradient[i];
        double* row = H[own[i]];
        const double* from = normal.hessian[i];
        for (std::size_t j = 0; j < own.size(); j++) row[own[j]] += from[j];
      }
    }
    return H;
  }

  Numbers moved(const Numbers& step, double share) const {
    Numbers after = state;
    for (std::size_t i = 0; i < after.size(); i++) after[i] += share * step[i];
    for (std::size_t i = 2; i < poses(); i += 3) after[i] = se2::wrapped(after[i]);
    return after;
  }

  gauss_newton::Step take_step(double damping) const {
    Numbers gradient;
    Matrix H = normal_equations(gradient);
    Numbers diagonal(H.rows());
    for (std::size_t i = 0; i < H.rows(); i++) diagonal[i] = H[i][i];
    const auto step_at = [&](double damping) -> std::optional<Numbers> {
      for (std::size_t i = 0; i < H.rows(); i++) H[i][i] = diagonal[i] * (1.0 + damping);
      const gaussian::Factor factor = gaussian::factor_or_fault(H);
      if (factor.fault != gaussian::Fault::NONE) return std::nullopt;
      Numbers step = gradient;
      for (double& each : step) each = -each;
      const dense::View column = dense::column(std::span<double>(step));
      dense::solve_lower(factor.L, column);
      dense::solve_upper(factor.L, column);
      return step;
    };
    return gauss_newton::take_step(
        damping, HALVINGS, MOST_DAMPING, chi2, step_at,
        [&](const Numbers& step, double share) { return moved(step, share); },
        [&](const Numbers& after) { return cost(after); });
  }
};

void Chain::append(const LocalMap& submap) {
  graph::Submap factor;
  factor.mean.assign(submap.mean.begin(), submap.mean.end());
  for (std::size_t k = 0; k < submap.ids.size(); k++) {
    const std::size_t i = submap.at(k);
    factor.landmarks.push_back({submap.covariance[i][i], submap.covariance[i][i + 1], submap.covariance[i + 1][i + 1]});
  }
  const gaussian::Factor of = gaussian::factor_or_fault(submap.covariance);
  if (of.fault == gaussian::Fault::NONE) factor.information = dense::inverse_from_factor(of.L);
  else if (!without_covariance_) without_covariance_ = links_.size();
  links_.push_back({{submap.ids.begin(), submap.ids.end()}, std::move(factor)});
}

ChainSolution Chain::solve(int iterations, double tolerance) const {
  ChainSolution found;
  if (without_covariance_) {
    found.fault = ChainFault::NO_COVARIANCE;
    found.at = *without_covariance_;
    return found;
  }
  Problem problem(links_);
  double damping = 0.0;
  for (int iteration = 0; iteration < iterations && damping != elementary::INF; iteration++) {
    gauss_newton::Step step = problem.take_step(damping);
    damping = step.damping;
    if (std::isnan(step.change)) {
      found.fault = ChainFault::UNDETERMINED;
      return found;
    }
    if (!step.state.empty()) problem.state = std::move(step.state);
    problem.chi2 = step.cost;
    if (damping == 0.0 && step.change < tolerance) break;
  }
  Numbers gradient;
  const gaussian::Factor factor = gaussian::factor_or_fault(problem.normal_equations(gradient));
  if (factor.fault != gaussian::Fault::NONE) {
    found.fault = ChainFault::UNDETERMINED;
    return found;
  }
  const std::size_t last = 3 * links_.size(), rest = problem.state.size() - last;
  found.map = {problem.ids,
               {problem.state.begin() + std::ptrdiff_t(last), problem.state.end()},
               dense::inverse_from_factor(factor.L.view().part(last, last, rest, rest))};
  found.cost = problem.chi2;
  found.dof = 3 - std::ptrdiff_t(problem.state.size());
  std::vector<std::size_t> counts(problem.ids.size());
  for (std::size_t k = 0; k < links_.size(); k++) {
    found.dof += std::ptrdiff_t(links_[k].factor.size());
    for (const std::uint32_t id : links_[k].ids) counts[problem.slot(id)]++;
  }
  for (std::size_t k = 1; k < links_.size(); k++) {
    const Link& link = links_[k];
    found.known.push_back(std::count_if(link.ids.begin(), link.ids.end(),
                                        [&](std::uint32_t id) { return counts[problem.slot(id)] > 1; }));
    Numbers of_link(link.ids.size());
    link.factor.landmark_chi2(problem.state, problem.at[k], 1.0, of_link);
    found.landmark_chi2.insert(found.landmark_chi2.end(), of_link.begin(), of_link.end());
  }
  return found;
}

}  // namespace teamslam::maps
