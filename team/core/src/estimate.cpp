#include "estimate.hpp"

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

Summed Estimate::quadratic(Indices nodes, const Marked& marked) const {
  const Graph& graph = *graph_;
  std::vector<std::ptrdiff_t> place(graph.nodes(), -1);
  std::size_t total = 0;
  for (const Index node : nodes) {
    place[node] = std::ptrdiff_t(total);
    total += graph.size_of(node);
  }
  Summed sum{dense::Matrix(total, total), Numbers(total), condensed_terms().cost + cost_of_factors(marked)};
  dense::Matrix& H = sum.information;
  Numbers& g = sum.slope;
  // Calls do_number with the number in the sum and the number in the factor.
  const auto each_number = [&](Indices of, auto&& do_number) {
    std::size_t row = 0;
    for (const Index node : of)
      for (std::size_t p = 0, size = graph.size_of(node); p < size; p++, row++)
        if (place[node] >= 0) do_number(std::size_t(place[node]) + p, row);
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

}  // namespace teamslam::graph
