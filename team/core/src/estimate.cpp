#include "estimate.hpp"

#include <algorithm>

#include "product.hpp"

namespace teamslam::graph {

namespace {

using linalg::pairwise_sum;

template <class T, class F>
const T& once(std::optional<T>& kept, F&& make) {
  if (!kept) kept = make();
  return *kept;
}

double squared(double x) { return x * x; }

Numbers negated(Numbers x) {
  for (double& each : x) each = -each;
  return x;
}

// Σ value(k) over k < count, of those that are chosen, in the order of NumPy.
template <class Chosen, class F>
double sum(std::size_t count, Chosen&& is_chosen, F&& value) {
  Numbers terms;
  for (std::size_t k = 0; k < count; k++)
    if (is_chosen(k)) terms.push_back(value(k));
  return pairwise_sum(terms);
}

const auto ALL = [](std::size_t) { return true; };

double weighted_sum(const Numbers& weights, const Numbers& chi2) {
  return sum(chi2.size(), ALL, [&](std::size_t k) { return weights[k] * chi2[k]; });
}


}  // namespace

Estimate::Estimate(std::shared_ptr<const Graph> graph, Numbers state, Numbers scale, Numbers sighting_scale, Loss loss)
    : graph_(std::move(graph)),
      state_(std::move(state)),
      scale_(std::move(scale)),
      sighting_scale_(std::move(sighting_scale)),
      loss_(loss) {
  if (state_.size() != graph_->unknowns()) throw std::invalid_argument("the state has not the size of the graph");
  if (scale_.size() != graph_->submaps.size() || sighting_scale_.size() != graph_->sightings.size())
    throw std::invalid_argument("a submap or inter-robot measurement has no robust scale");
}

const Estimate::Submaps& Estimate::submaps() const {
  return once(submaps_, [&] {
    Submaps found;
    for (const Joined& each : graph_->submaps)
      found.push_back(loss_.has_joined_ranges
                          ? std::make_shared<const Submap>(each.submap->at_joined_ranges(state_, each.at))
                          : each.submap);
    return found;
  });
}

const std::pair<Numbers, Numbers>& Estimate::landmark_chi2_and_gate() const {
  return once(landmark_chi2_, [&] {
    const std::size_t count = graph_->landmarks();
    if (!loss_.is_robust) return std::pair{Numbers(count), Numbers(count, 1.0)};
    std::pair<Numbers, Numbers> found{Numbers(count), {}};
    for (std::size_t f = 0; f < submaps().size(); f++) {
      const Submap& each = *submaps()[f];
      each.landmark_chi2(state_, graph_->submaps[f].at, loss_.covariance_factor,
                         std::span(found.first).subspan(graph_->landmark_start[f], each.landmarks.size()));
      found.second.insert(found.second.end(), each.landmarks.size(),
                          loss_.landmark_gate * squared(scale_[f]));
    }
    return found;
  });
}

const Numbers& Estimate::landmark_weights() const {
  return once(weights_, [&] {
    const auto& [chi2, gate] = landmark_chi2_and_gate();
    Numbers found(chi2.size(), 1.0);
    for (std::size_t l = 0; l < found.size(); l++)
      found[l] = pack::max(robust_weight(chi2[l], gate[l]), LEAST_WEIGHT);
    return found;
  });
}

Estimate::Submaps Estimate::discounted_by(const Numbers& weights) const {
  Submaps found = submaps();
  for (std::size_t f = 0; f < found.size(); f++) {
    const Values own = Values(weights).subspan(graph_->landmark_start[f], found[f]->landmarks.size());
    bool is_discounted = false;
    for (const double weight : own) is_discounted |= weight < 1.0;
    if (is_discounted) found[f] = std::make_shared<const Submap>(found[f]->discounted(own));
  }
  return found;
}

const Estimate::Submaps& Estimate::discounted() const {
  return once(discounted_, [&] { return discounted_by(landmark_weights()); });
}

Numbers Estimate::dimensions() const {
  Numbers found;
  for (std::size_t f = 0; f < graph_->submaps.size(); f++) {
    double lost = 0.0;
    for (std::size_t l = graph_->landmark_start[f]; l < graph_->landmark_start[f + 1]; l++)
      lost += 2.0 * (1.0 - landmark_weights()[l]);
    found.push_back(double(graph_->submaps[f].submap->size()) - lost);
  }
  return found;
}

Numbers Estimate::costs(const Submaps& submaps, const Numbers& state) const {
  Numbers found;
  for (std::size_t f = 0; f < submaps.size(); f++)
    found.push_back(chi2_ && &state == &state_ && submaps[f] == discounted()[f]
                        ? (*chi2_)[f]
                        : submaps[f]->chi2(state, graph_->submaps[f].at) / loss_.covariance_factor);
  return found;
}

const Numbers& Estimate::chi2() const {
  return once(chi2_, [&] { return costs(discounted(), state_); });
}

Numbers Estimate::whole_chi2() const { return costs(submaps(), state_); }

Numbers Estimate::counted_chi2() const {
  Numbers squares = landmark_weights();
  for (double& weight : squares) weight = squared(weight);
  return costs(discounted_by(squares), state_);
}

Numbers Estimate::gates() const {
  Numbers found;
  for (std::size_t f = 0; f < scale_.size(); f++)
    found.push_back(loss_.submap_gate * gate_of(double(graph_->submaps[f].submap->size()), scale_[f]));
  return found;
}

Numbers Estimate::sighting_gates() const {
  Numbers found;
  for (const double scale : sighting_scale_) found.push_back(gate_of(2.0, scale));
  return found;
}

Numbers Estimate::weights() const {
  Numbers found = gates();
  for (std::size_t f = 0; f < found.size(); f++) found[f] = robust_weight(chi2()[f], found[f]);
  return found;
}

const Numbers& Estimate::sighting_chi2() const {
  return once(sighting_chi2_, [&] {
    Numbers found;
    for (const Sighting& each : graph_->sightings) found.push_back(each.chi2(linear(each)));
    return found;
  });
}

Numbers Estimate::sighting_weights() const {
  Numbers found = sighting_gates();
  for (std::size_t s = 0; s < found.size(); s++) found[s] = robust_weight(sighting_chi2()[s], found[s]);
  return found;
}

const std::vector<Prior::Terms>& Estimate::prior_terms() const {
  return once(prior_terms_, [&] {
    std::vector<Prior::Terms> found;
    for (const Prior& each : graph_->priors) found.push_back(each.terms(state_, graph_->offset));
    return found;
  });
}

Numbers Estimate::prior_chi2() const {
  Numbers found;
  for (const Prior::Terms& each : prior_terms()) found.push_back(each.chi2);
  return found;
}

// Of Student's t of one degree of freedom for a robot's own bias, 1 for all others: −2 log p is
// 2 log(1 + χ²), whose slope, the weight, is 2/(1 + χ²). Most sensors are as their configuration states,
// to within the prior; one that is not is far off, and must not draw the other robots' biases away
// through the common errors. Markers do not change; the error of a marker seen from one side only is
// distinguished from its landmark's position by its prior alone.
Numbers Estimate::prior_weights() const {
  Numbers found(graph_->priors.size(), 1.0);
  for (std::size_t k = 0; k < found.size(); k++)
    if (graph_->priors[k].is_of_bias) found[k] = 2.0 / (1.0 + prior_terms()[k].chi2);
  return found;
}

const Quadratic::Terms& Estimate::condensed_terms() const {
  return once(condensed_terms_, [&] {
    return graph_->condensed ? graph_->condensed->terms(state_, graph_->boundary()) : Quadratic::Terms{};
  });
}

double Estimate::cost_of(const Estimate& other) const {
  const bool are_equal = &other == this || (!loss_.is_robust && !loss_.has_joined_ranges);
  const double chi2 = weighted_sum(weights(), are_equal ? other.chi2() : costs(discounted(), other.state_));
  double seen = weighted_sum(sighting_weights(), other.sighting_chi2());
  seen += weighted_sum(prior_weights(), other.prior_chi2());
  return chi2 + seen + other.condensed_terms().cost;
}

double Estimate::cost() const {
  return cost_of_factors({std::vector<bool>(graph_->submaps.size(), true),
                          std::vector<bool>(graph_->sightings.size(), true),
                          std::vector<bool>(graph_->priors.size(), true)}) +
         condensed_terms().cost;
}

double Estimate::cost_of_factors(const Marked& marked) const {
  const Numbers of_priors = prior_chi2(), gates = this->gates(), seen = sighting_gates();
  const auto is_submap = [&](std::size_t f) { return marked.submaps[f]; };
  const auto is_sighting = [&](std::size_t s) { return marked.sightings[s]; };
  const auto is_prior = [&](std::size_t k) { return marked.priors[k]; };
  double cost = sum(gates.size(), is_submap, [&](std::size_t f) { return robust_loss(chi2()[f], gates[f]); });
  cost += sum(of_priors.size(), is_prior, [&](std::size_t k) {
    return graph_->priors[k].is_of_bias ? 2.0 * elementary::log(1.0 + of_priors[k]) : of_priors[k];
  });
  if (loss_.is_robust) {
    const auto& [own, gate] = landmark_chi2_and_gate();
    Numbers beyond;  // a discounted landmark's share of χ² is w χ² already
    for (std::size_t f = 0; f < gates.size(); f++)
      for (std::size_t l = graph_->landmark_start[f]; l < graph_->landmark_start[f + 1]; l++)
        if (marked.submaps[f] && own[l] > gate[l])
          beyond.push_back(robust_loss(own[l], gate[l]) - robust_weight(own[l], gate[l]) * own[l]);
    cost += pairwise_sum(beyond);
  }
  return cost + sum(seen.size(), is_sighting, [&](std::size_t s) { return robust_loss(sighting_chi2()[s], seen[s]); });
}

const std::pair<Numbers, Numbers>& Estimate::normal_equations() const {
  return once(normal_, [&] {
    const Graph& graph = *graph_;
    const Numbers gates = this->gates(), seen = sighting_gates();
    std::pair made{Numbers(std::size_t(graph.pattern()->numbers())), Numbers(state_.size())};
    auto& [values, gradient] = made;
    for (std::size_t node = 0; node < graph.nodes(); node++)
      if (graph.fixed[node])
        for (std::size_t p = 0, size = graph.size_of(Index(node)); p < size; p++)
          values[graph.diagonal_of(Index(node)) + p * size + p] = 1.0;
    for (std::size_t f = 0; f < graph.submaps.size(); f++) {
      const Joined& at = graph.submaps[f];
      const Normal normal = discounted()[f]->normal(state_, at.at);
      const double chi2 = normal.chi2 / loss_.covariance_factor;
      const double weight = robust_weight(chi2, gates[f]) / loss_.covariance_factor;
      std::size_t row = 0;
      for (std::size_t a = 0; a < at.nodes.size(); a++)
        for (std::size_t p = 0, size = graph.size_of(at.nodes[a]); p < size; p++, row++)
          if (!graph.fixed[at.nodes[a]]) gradient[at.at[a] + p] += weight * normal.gradient[row];
      graph.add(f, at.nodes, normal.hessian, weight, values);
    }
    for (std::size_t s = 0; s < graph.sightings.size(); s++) {
      const Sighting& each = graph.sightings[s];
      const Sighting::Linear at = linear(each);
      const auto& W = each.information;
      double slope[2];
      for (std::size_t i = 0; i < 2; i++) slope[i] = W[i][0] * at.residual[0] + W[i][1] * at.residual[1];
      const double chi2 = at.residual[0] * slope[0] + at.residual[1] * slope[1];
      const double weight = robust_weight(chi2, seen[s]);
      const Index nodes[] = {each.observer, each.teammate};
      for (std::size_t i = 0; i < 2; i++)
        for (std::size_t p = 0; p < 3; p++)
          for (std::size_t k = 0; k < 2; k++)
            if (!graph.fixed[nodes[i]]) gradient[graph.offset[nodes[i]] + p] += weight * at.jacobian[k][3 * i + p] * slope[k];
      graph.add(graph.of_sighting(s), nodes, each.hessian(at), weight, values);
    }
    if (graph.condensed) {
      for (std::size_t i = 0; i < graph.boundary().size(); i++)
        gradient[graph.boundary()[i]] += condensed_terms().slope[i];
      graph.add(graph.of_condensed(), graph.condensed->nodes, graph.condensed->information, 1.0, values);
    }
    const Numbers weights = prior_weights();
    for (std::size_t k = 0; k < weights.size(); k++) {
      const Prior& each = graph.priors[k];
      std::size_t row = 0;
      for (const Index node : each.nodes)
        for (std::size_t p = 0, size = graph.size_of(node); p < size; p++, row++)
          if (!graph.fixed[node]) gradient[graph.offset[node] + p] += weights[k] * prior_terms()[k].slope[row];
      graph.add(graph.of_prior(k), each.nodes, each.information, weights[k], values);
    }
    return made;
  });
}

const std::shared_ptr<const sparse::Cholesky>& Estimate::posterior() const {
  if (!posterior_) posterior_ = std::make_shared<const sparse::Cholesky>(graph_->pattern(), normal_equations().first);
  return posterior_;
}

const Numbers& Estimate::step() const {
  return once(step_, [&] { return negated(posterior()->solve(normal_equations().second)); });
}

const Numbers& Estimate::selected_covariance() const {
  return once(covariance_, [&] { return posterior()->selected_inverse(); });
}

// state + share · step, headings wrapped.
Numbers Estimate::moved(const Numbers& step, double share) const {
  Numbers moved = state_;
  for (std::size_t i = 0; i < moved.size(); i++) moved[i] += share * step[i];
  for (std::size_t node = 0; node < graph_->nodes(); node++)
    if (graph_->size_of(Index(node)) == 3) {
      double& heading = moved[graph_->offset[node] + 2];
      heading = se2::wrapped(heading);
    }
  return moved;
}

gauss_newton::Step Estimate::take_step(double damping, int halvings, double most_damping) const {
  const auto step_at = [&](double damping) -> std::optional<Numbers> {
    if (damping == 0.0) return step();
    auto [damped, gradient] = normal_equations();
    for (const Index i : graph_->pattern()->diagonal()) damped[i] *= 1.0 + damping;
    return negated(sparse::Cholesky(graph_->pattern(), damped).solve(Values(gradient)));
  };
  return gauss_newton::take_step(
      damping, halvings, most_damping, cost_of(*this), step_at,
      [&](const Numbers& step, double share) { return moved(step, share); },
      [&](const Numbers& state) { return cost_of(Estimate(graph_, state, scale_, sighting_scale_, loss_)); });
}

Numbers Estimate::explained() const {
  Numbers found;
  for (std::size_t f = 0; f < graph_->submaps.size(); f++) {
    const Joined& at = graph_->submaps[f];
    const Normal normal = discounted()[f]->normal(state_, at.at);
    found.push_back(graph_->trace(f, at.nodes, normal.hessian, selected_covariance()) / loss_.covariance_factor);
  }
  return found;
}

Numbers Estimate::explained_by_sightings() const {
  Numbers found;
  for (std::size_t s = 0; s < graph_->sightings.size(); s++) {
    const Sighting& each = graph_->sightings[s];
    const Index nodes[] = {each.observer, each.teammate};
    found.push_back(graph_->trace(graph_->of_sighting(s), nodes, each.hessian(linear(each)), selected_covariance()));
  }
  return found;
}

Numbers Estimate::explained_by_priors() const {
  Numbers found;
  for (std::size_t k = 0; k < graph_->priors.size(); k++) {
    const Prior& each = graph_->priors[k];
    const std::size_t size = each.mean.size();
    const dense::Matrix spread = graph_->among(graph_->of_prior(k), each.nodes, size, selected_covariance());
    Numbers terms(size * size);
    for (std::size_t i = 0; i < size * size; i++)
      terms[i] = each.information[i / size][i % size] * spread[i / size][i % size];
    found.push_back(pairwise_sum(terms));
  }
  return found;
}

Observations Estimate::observations() const {
  Observations found{dense::Matrix(graph_->landmarks(), 2), dense::Matrix(graph_->landmarks(), 3)};
  for (std::size_t f = 0, row = 0; f < graph_->submaps.size(); f++) {
    const Joined& at = graph_->submaps[f];
    const Submap& submap = *at.submap;
    const double* start = &state_[at.at[0]];
    const auto [s, c] = elementary::sin_cos(start[2]);
    dense::Matrix P(3, 3);  // of a fixed start 0
    if (const Index node = at.nodes[0]; !graph_->fixed[node])
      for (std::size_t i = 0; i < 9; i++) P[i / 3][i % 3] = selected_covariance()[graph_->diagonal_of(node) + i];
    const Numbers local = submap.shifted_mean(state_, at.at);
    for (std::size_t l = 0; l < submap.landmarks.size(); l++, row++) {
      const double x = local[3 * submap.poses() + 2 * l], y = local[3 * submap.poses() + 2 * l + 1];
      const double dx = c * x - s * y, dy = s * x + c * y;
      auto [xx, xy, yy] = submap.landmarks[l];
      for (double* each : {&xx, &xy, &yy}) *each *= loss_.covariance_factor;
      found.points[row][0] = start[0] + dx;
      found.points[row][1] = start[1] + dy;
      found.spread[row][0] =
          c * c * xx - 2.0 * c * s * xy + s * s * yy + P[0][0] - 2.0 * dy * P[0][2] + dy * dy * P[2][2];
      found.spread[row][1] = c * s * (xx - yy) + (c * c - s * s) * xy + P[0][1] + dx * P[0][2] - dy * P[1][2] -
                             dx * dy * P[2][2];
      found.spread[row][2] =
          s * s * xx + 2.0 * c * s * xy + c * c * yy + P[1][1] + 2.0 * dx * P[1][2] + dx * dx * P[2][2];
    }
  }
  return found;
}

// The place of the first number of each node among those of some nodes; beyond them for others.
std::vector<std::size_t> Estimate::places_of(Indices nodes) const {
  std::vector<std::size_t> place(graph_->nodes(), graph_->unknowns());
  std::size_t total = 0;
  for (const Index node : nodes) {
    place[node] = total;
    total += graph_->size_of(node);
  }
  return place;
}

Summed Estimate::quadratic(Indices nodes, const Marked& marked) const {
  const Graph& graph = *graph_;
  const std::vector<std::size_t> place = places_of(nodes);
  std::size_t total = 0;
  for (const Index node : nodes) total += graph.size_of(node);
  Summed sum{dense::Matrix(total, total), Numbers(total), condensed_terms().cost + cost_of_factors(marked)};
  dense::Matrix& H = sum.information;
  Numbers& g = sum.slope;
  // Calls do_number with the number in the sum and the number in the factor.
  const auto each_number = [&](Indices of, auto&& do_number) {
    std::size_t row = 0;
    for (const Index node : of)
      for (std::size_t p = 0, size = graph.size_of(node); p < size; p++, row++)
        if (place[node] < total) do_number(place[node] + p, row);
  };
  const auto add_matrix = [&](Indices of, double weight, dense::Const hessian) {
    each_number(of, [&](std::size_t i, std::size_t row) {
      each_number(of, [&](std::size_t j, std::size_t column) { H[i][j] += weight * hessian[row][column]; });
    });
  };
  if (graph.condensed) {
    const Quadratic& old = *graph.condensed;
    each_number(old.nodes, [&](std::size_t i, std::size_t row) { g[i] += condensed_terms().slope[row]; });
    add_matrix(old.nodes, 1.0, old.information);
  }
  const Numbers weights = this->weights(), seen_weights = sighting_weights(), prior_weights = this->prior_weights();
  for (std::size_t f = 0; f < graph.submaps.size(); f++) {
    if (!marked.submaps[f]) continue;
    const Joined& at = graph.submaps[f];
    const Normal normal = discounted()[f]->normal(state_, at.at);
    const double weight = weights[f] / loss_.covariance_factor;
    each_number(at.nodes, [&](std::size_t i, std::size_t row) { g[i] += weight * normal.gradient[row]; });
    add_matrix(at.nodes, weight, normal.hessian);
  }
  for (std::size_t s = 0; s < graph.sightings.size(); s++) {
    if (!marked.sightings[s]) continue;
    const Sighting& each = graph.sightings[s];
    const Sighting::Linear at = linear(each);
    dense::Matrix transposed(6, 2), weighted(2, 2);
    for (std::size_t k = 0; k < 2; k++) {
      for (std::size_t p = 0; p < 6; p++) transposed[p][k] = at.jacobian[k][p];
      for (std::size_t l = 0; l < 2; l++) weighted[k][l] = seen_weights[s] * each.information[k][l];
    }
    const Numbers slope = dense::product(transposed, dense::product(weighted, at.residual));
    const dense::Const jacobian{at.jacobian[0], 2, 6, 6};
    const dense::Matrix hessian = dense::product(dense::product(transposed, weighted), jacobian);
    const Index of[] = {each.observer, each.teammate};
    each_number(of, [&](std::size_t i, std::size_t row) { g[i] += slope[row]; });
    add_matrix(of, 1.0, hessian);
  }
  for (std::size_t k = 0; k < graph.priors.size(); k++) {
    if (!marked.priors[k]) continue;
    const Prior& each = graph.priors[k];
    each_number(each.nodes, [&](std::size_t i, std::size_t row) { g[i] += prior_weights[k] * prior_terms()[k].slope[row]; });
    add_matrix(each.nodes, prior_weights[k], each.information);
  }
  return sum;
}

Summed Estimate::eliminate_paths(const std::vector<std::vector<Index>>& runs, Marked rest,
                                 const std::vector<bool>& eliminated, std::vector<Index>& nodes) const {
  const Graph& graph = *graph_;
  struct Left {
    std::vector<Index> nodes;
    Summed sum;
  };
  std::vector<Left> left;
  const auto add = [&](const Left& each, Summed& sum, Indices over) {
    const std::vector<std::size_t> place = places_of(over);
    std::vector<std::size_t> at;
    for (const Index node : each.nodes)
      for (std::size_t p = 0; p < graph.size_of(node); p++) at.push_back(place[node] + p);
    for (std::size_t i = 0; i < at.size(); i++) {
      sum.slope[at[i]] += each.sum.slope[i];
      for (std::size_t j = 0; j < at.size(); j++) sum.information[at[i]][at[j]] += each.sum.information[i][j];
    }
  };
  double total = 0.0;
  for (const std::vector<Index>& run : runs) {
    std::vector<bool> path(graph.nodes()), chosen(graph.submaps.size()), touched(graph.nodes());
    for (const Index f : run) {
      graph.mark_path(std::size_t(f), path);
      chosen[f] = true;
    }
    for (std::size_t node = 0; node < graph.nodes(); node++) path[node] = path[node] && !graph.fixed[node];
    Marked taken = graph.touching(chosen, path);
    for (const auto& [marks, of_rest] :
         {std::pair{&taken.sightings, &rest.sightings}, std::pair{&taken.priors, &rest.priors}})
      for (std::size_t k = 0; k < marks->size(); k++) {
        (*marks)[k] = (*marks)[k] && (*of_rest)[k];
        (*of_rest)[k] = (*of_rest)[k] && !(*marks)[k];
      }
    for (const Index f : run) rest.submaps[f] = false;
    graph.mark_nodes(taken, touched);
    const auto beside = std::stable_partition(left.begin(), left.end(), [&](const Left& each) {
      return std::none_of(each.nodes.begin(), each.nodes.end(), [&](Index node) { return path[node]; });
    });
    for (auto each = beside; each != left.end(); each++)
      for (const Index node : each->nodes) touched[node] = true;
    std::vector<Index> of_run, stays;
    std::vector<bool> is_out;
    for (std::size_t node = 0; node < graph.nodes(); node++) {
      if (!touched[node] || graph.fixed[node]) continue;
      of_run.push_back(Index(node));
      is_out.insert(is_out.end(), graph.size_of(Index(node)), path[node]);
      if (!path[node]) stays.push_back(Index(node));
    }
    Summed sum = quadratic(of_run, taken);
    for (auto each = beside; each != left.end(); each++) add(*each, sum, of_run);
    left.erase(beside, left.end());
    std::optional<Elimination> parts = eliminate(std::move(sum), is_out);
    if (!parts) throw sparse::NotPositiveDefinite(graph.submaps[run[0]].nodes[0]);
    total += parts->rest.cost;
    left.push_back({std::move(stays), std::move(parts->rest)});
  }
  std::erase_if(nodes, [&](Index node) { return eliminated[node] && graph.size_of(node) != 2; });
  Summed sum = quadratic(nodes, rest);
  for (const Left& each : left) add(each, sum, nodes);
  sum.cost = total + sum.cost;
  return sum;
}

Condensing Estimate::condense(const std::vector<bool>& leaving, Indices resting, Indices given_up,
                              const std::vector<std::vector<Index>>& runs) const {
  const Graph& graph = *graph_;
  const Quadratic* before = graph.condensed.get();
  Condensing made{{}, std::vector<bool>(graph.nodes()), 0, {}};
  for (std::size_t f = 0; f < leaving.size(); f++)
    if (leaving[f]) graph.mark_path(f, made.eliminated);
  for (const Indices landmarks : {resting, given_up})
    for (const Index node : landmarks) made.eliminated[node] = true;
  made.factors = graph.touching(leaving, made.eliminated);
  std::vector<bool> touched(graph.nodes());
  graph.mark_nodes(made.factors, touched);
  if (before)
    for (const Index node : before->nodes) touched[node] = true;
  for (const Index node : resting)
    if (!touched[node]) throw std::invalid_argument("a landmark that comes to rest is in no factor that is condensed");
  std::vector<Index> nodes;
  for (std::size_t node = 0; node < graph.nodes(); node++) {
    if (!touched[node] || graph.fixed[node]) continue;
    nodes.push_back(Index(node));
    if (made.eliminated[node]) made.unknowns += graph.size_of(Index(node));
  }
  Summed sum = before ? quadratic(nodes, made.factors) : eliminate_paths(runs, made.factors, made.eliminated, nodes);

  Quadratic& factor = made.factor;
  std::vector<bool> is_out;
  std::vector<Index> renumbered(graph.nodes());
  for (std::size_t node = 0, stays = 0; node < graph.nodes(); node++) {
    renumbered[node] = Index(stays);
    stays += !made.eliminated[node];
  }
  for (const Index node : nodes) {
    const std::size_t size = graph.size_of(node);
    is_out.insert(is_out.end(), size, made.eliminated[node]);
    if (made.eliminated[node]) continue;
    factor.nodes.push_back(renumbered[node]);
    for (std::size_t p = 0; p < size; p++) {
      factor.at.push_back(state_[graph.offset[node] + p]);
      factor.is_heading.push_back(size == 3 && p == 2);
    }
  }
  std::optional<Elimination> parts = eliminate(std::move(sum), is_out);
  if (!parts) throw sparse::NotPositiveDefinite(nodes[0]);
  if (!resting.empty() || (before && !before->resting.means.empty())) {
    const std::vector<std::size_t> place = places_of(nodes);
    std::vector<std::size_t> among(is_out.size()), of_before, rests;  // among: the place of eliminated ones
    for (std::size_t k = 0; k < parts->eliminated.size(); k++) among[parts->eliminated[k]] = k;
    if (before)
      for (const Index node : before->nodes)
        for (std::size_t p = 0; p < graph.size_of(node); p++) of_before.push_back(place[node] + p);
    Numbers points;
    for (const Index node : resting)
      for (std::size_t p = 0; p < 2; p++) {
        rests.push_back(among[place[node] + p]);
        points.push_back(state_[graph.offset[node] + p]);
      }
    factor.rest(before, *parts, of_before, before ? before->difference(state_, graph.boundary()) : Numbers(), rests, points);
  }
  static_cast<Summed&>(factor) = std::move(parts->rest);
  return made;
}

const Numbers& Estimate::resting_points() const {
  return once(resting_points_, [&] {
    const Quadratic& old = *graph_->condensed;
    Numbers points = dense::product(old.resting.gain, old.difference(state_, graph_->boundary()));
    for (std::size_t i = 0; i < points.size(); i++) points[i] = old.resting.means[i] + points[i];
    return points;
  });
}

const dense::Matrix& Estimate::boundary_covariance() const {
  return once(boundary_covariance_, [&] { return graph_->among_boundary(selected_covariance()); });
}

const dense::Matrix& Estimate::resting_spread() const {
  return once(resting_spread_, [&] {
    const dense::Matrix& gain = graph_->condensed->resting.gain;
    const std::optional<dense::Matrix> root = dense::cholesky(boundary_covariance());
    if (!root) throw sparse::NotPositiveDefinite(graph_->condensed->nodes[0]);
    dense::Matrix spread(gain.rows(), gain.columns());
    dense::multiply<dense::Into::SET>(spread.view(), dense::by_rows(gain), *root, {.is_lower = true});
    return spread;
  });
}

Numbers Estimate::points(Indices members) const {
  Numbers found;
  for (const Index member : members) {
    const double* point = member < 0 ? &resting_points()[2 * (-1 - member)] : &state_[graph_->offset[member]];
    found.insert(found.end(), point, point + 2);
  }
  return found;
}

Numbers Estimate::blocks(Indices members) const {
  Numbers found;
  for (const Index member : members) {
    if (member >= 0) {
      const double* block = &selected_covariance()[graph_->diagonal_of(member)];
      for (std::size_t i = 0; i < 4; i++) found.push_back(graph_->fixed[member] ? 0.0 : block[i]);
      continue;
    }
    const std::size_t x = 2 * std::size_t(-1 - member), y = x + 1, n = resting_spread().columns();
    const Resting& resting = graph_->condensed->resting;
    const std::span<const double> of_x{resting_spread()[x], n}, of_y{resting_spread()[y], n};
    const double cross = resting.variance(x, y) + dense::inner(of_x, of_y);
    found.insert(found.end(), {resting.variance(x, x) + dense::inner(of_x, of_x), cross, cross,
                               resting.variance(y, y) + dense::inner(of_y, of_y)});
  }
  return found;
}

std::pair<Numbers, dense::Matrix> Estimate::joint(Indices members) const {
  const Graph& graph = *graph_;
  Numbers mean;
  // Of the numbers of nodes: their unknowns, their places in the result, whether they are constants; of those at rest
  // their numbers there and their places.
  std::vector<Index> unknowns, outside;
  std::vector<std::size_t> at, rests, at_rest;
  std::vector<bool> is_fixed;
  for (const Index member : members)
    if (member < 0) {
      for (std::size_t i = 2 * std::size_t(-1 - member), last = i + 1; i <= last; i++) {
        rests.push_back(i);
        at_rest.push_back(mean.size());
        mean.push_back(resting_points()[i]);
      }
    } else {
      for (Index i = graph.offset[member]; i < graph.offset[member + 1]; i++) {
        unknowns.push_back(i);
        is_fixed.push_back(graph.fixed[member]);
        at.push_back(mean.size());
        mean.push_back(state_[i]);
      }
    }
  const std::size_t n = unknowns.size(), m = rests.size();
  if (m == 0) {
    dense::Matrix covariance = posterior()->inverse_block(unknowns);
    for (std::size_t i = 0; i < n; i++)
      for (std::size_t j = 0; j < n; j++)
        if (is_fixed[i] || is_fixed[j]) covariance[i][j] = 0.0;
    return {std::move(mean), std::move(covariance)};
  }
  // The selected inverse has the covariances among the condensed factor's nodes; other nodes take a solution each.
  const dense::Matrix& P = boundary_covariance();
  const std::size_t size = graph.boundary().size();
  std::vector<std::size_t> in_boundary(state_.size(), size), column(n);
  for (std::size_t k = 0; k < size; k++) in_boundary[graph.boundary()[k]] = k;
  for (std::size_t i = 0; i < n; i++)
    if (in_boundary[unknowns[i]] == size) {
      column[i] = outside.size();
      outside.push_back(unknowns[i]);
    }
  const dense::Matrix solved = posterior()->inverse_columns(outside);
  const auto covariance = [&](std::size_t i, std::size_t j) {
    const std::size_t of_i = in_boundary[unknowns[i]], of_j = in_boundary[unknowns[j]];
    if (of_i == size) return is_fixed[i] ? 0.0 : solved[unknowns[j]][column[i]];
    if (of_j == size) return is_fixed[j] ? 0.0 : solved[unknowns[i]][column[j]];
    return P[of_i][of_j];
  };
  dense::Matrix with_boundary(n, size), gain(m, size), spread(m, size), found(mean.size(), mean.size());
  for (std::size_t i = 0; i < n; i++) {
    for (std::size_t j = 0; j < n; j++) found[at[i]][at[j]] = 0.5 * (covariance(i, j) + covariance(j, i));
    const std::size_t own = in_boundary[unknowns[i]];
    for (std::size_t k = 0; k < size; k++) {
      if (own < size) with_boundary[i][k] = P[own][k];
      else if (!is_fixed[i]) with_boundary[i][k] = solved[graph.boundary()[k]][column[i]];
    }
  }
  for (std::size_t k = 0; k < m; k++) {
    std::copy_n(graph.condensed->resting.gain[rests[k]], size, gain[k]);
    std::copy_n(resting_spread()[rests[k]], size, spread[k]);
  }
  const dense::Matrix cross = dense::product(gain, dense::transposed(with_boundary));
  const dense::Matrix among = dense::product(spread, dense::transposed(spread));
  for (std::size_t k = 0; k < m; k++) {
    for (std::size_t i = 0; i < n; i++) found[at_rest[k]][at[i]] = found[at[i]][at_rest[k]] = cross[k][i];
    for (std::size_t l = 0; l < m; l++)
      found[at_rest[k]][at_rest[l]] =
          0.5 * (among[k][l] + among[l][k]) + graph.condensed->resting.variance(rests[k], rests[l]);
  }
  return {std::move(mean), std::move(found)};
}

}  // namespace teamslam::graph
