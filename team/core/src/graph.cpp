#include "graph.hpp"

#include <algorithm>
#include <array>

#include "models.hpp"

namespace teamslam::graph {

namespace {

void require(bool is_right, const char* what) {
  if (!is_right) throw std::invalid_argument(what);
}

std::vector<Index> checked(std::vector<Index> offset, std::size_t nodes) {
  require(offset.size() == nodes + 1 && offset[0] == 0, "each node has an offset, and a mark whether it is fixed");
  for (std::size_t node = 0; node < nodes; node++)
    require(offset[node + 1] > offset[node] && offset[node + 1] <= offset[node] + 3, "a node has one to three numbers");
  return offset;
}

std::vector<Joined> placed(std::vector<Joined> submaps, const std::vector<Index>& offset) {
  for (Joined& each : submaps) {
    require(each.submap != nullptr, "a submap is None");
    const std::size_t members = each.submap->members(), poses = 1 + each.submap->poses(),
                      points = 1 + each.submap->points();
    require(each.nodes.size() == members, "a submap has a node for each member");
    for (std::size_t k = 0; k < members; k++) {
      const Index node = each.nodes[k], size = k < poses ? 3 : k < points ? 2 : 1;
      require(node >= 0 && std::size_t(node) + 1 < offset.size(), "a submap's member is no node of the graph");
      require(offset[node + 1] - offset[node] == size, "a submap's node has another size");
      each.at.push_back(offset[node]);
    }
  }
  return submaps;
}

std::vector<std::size_t> starts_of_landmarks(const std::vector<Joined>& submaps) {
  std::vector<std::size_t> starts{0};
  for (const Joined& each : submaps) starts.push_back(starts.back() + each.submap->landmarks.size());
  return starts;
}

}  // namespace

Sighting::Linear Sighting::linear(const double* a, const double* b) const {
  Linear at{};
  const auto [s, c] = elementary::sin_cos(b[2]);
  const double lx = c * point[0] - s * point[1], ly = s * point[0] + c * point[1];
  const double x = b[0] + lx - a[0], y = b[1] + ly - a[1];
  const double distance = pack::max(pack::sqrt(x * x + y * y), models::NEAREST_M);
  at.residual[0] = measurement[0] - distance;
  at.residual[1] = se2::wrapped(measurement[1] - (elementary::atan2(y, x) - a[2]));
  const double square = distance * distance;
  at.jacobian[0][0] = x / distance;
  at.jacobian[0][1] = y / distance;
  at.jacobian[1][0] = -y / square;
  at.jacobian[1][1] = x / square;
  at.jacobian[1][2] = 1.0;
  for (auto& row : at.jacobian)
    for (std::size_t j = 0; j < 2; j++) row[3 + j] = -row[j];
  for (auto& row : at.jacobian) row[5] = row[4] * lx - row[3] * ly;
  return at;
}

double Sighting::chi2(const Linear& at) const {
  const double *r = at.residual, (*W)[2] = information;
  return W[0][0] * r[0] * r[0] + 2.0 * W[0][1] * r[0] * r[1] + W[1][1] * (r[1] * r[1]);
}

dense::Matrix Sighting::hessian(const Linear& at) const {
  dense::Matrix H(6, 6);
  for (std::size_t p = 0; p < 6; p++)
    for (std::size_t q = 0; q < 6; q++)
      for (std::size_t i = 0; i < 2; i++)
        for (std::size_t j = 0; j < 2; j++) H[p][q] += at.jacobian[i][p] * information[i][j] * at.jacobian[j][q];
  return H;
}

Prior::Terms Prior::terms(Values state, Indices offset) const {
  const std::size_t size = mean.size();
  Terms found{Numbers(size), 0.0};
  Numbers r(size);
  for (std::size_t i = 0; i < size; i++)
    r[i] = state[nodes.size() == 1 ? offset[nodes[0]] + i : offset[nodes[i]]] - mean[i];
  if (nodes.size() == 1 && size == 3) r[2] = se2::wrapped(r[2]);
  for (std::size_t i = 0; i < size; i++) {
    for (std::size_t j = 0; j < size; j++) found.slope[i] += information[i][j] * r[j];
    found.chi2 += r[i] * found.slope[i];
  }
  return found;
}

Graph::Graph(std::vector<Index> offsets, std::vector<bool> constants, std::vector<Joined> joined,
             std::vector<Sighting> seen, std::vector<Prior> known, std::shared_ptr<const Quadratic> old)
    : offset(checked(std::move(offsets), constants.size())),
      fixed(std::move(constants)),
      submaps(placed(std::move(joined), offset)),
      landmark_start(starts_of_landmarks(submaps)),
      sightings(std::move(seen)),
      priors(std::move(known)),
      condensed(std::move(old)) {
  const auto has = [&](Index node, std::size_t size) {
    return node >= 0 && std::size_t(node) < nodes() && size_of(node) == size;
  };
  for (const Sighting& each : sightings)
    require(has(each.observer, 3) && has(each.teammate, 3), "an inter-robot measurement is between two poses");
  for (const Prior& each : priors) {
    const std::size_t count = each.nodes.size();
    require(count > 0 && (count == 1 || count == each.mean.size()), "a prior of several nodes is of biases");
    for (const Index node : each.nodes)
      require(has(node, count == 1 ? each.mean.size() : 1), "a prior has the size of its nodes");
  }
  if (!condensed) return;
  for (const Index node : condensed->nodes) {
    require(node >= 0 && std::size_t(node) < nodes() && !fixed[node], "a condensed factor's member is no free node of the graph");
    for (Index i = offset[node]; i < offset[node + 1]; i++) boundary_.push_back(i);
  }
  require(boundary_.size() == condensed->at.size(), "the condensed factor has the size of its nodes");
}

void Graph::mark_path(std::size_t submap, std::vector<bool>& marks) const {
  const Joined& at = submaps[submap];
  marks[at.nodes[0]] = true;
  for (std::size_t k = 2; k <= at.submap->poses(); k++) marks[at.nodes[k]] = true;
}

Marked Graph::touching(const std::vector<bool>& chosen, const std::vector<bool>& marks) const {
  Marked found{chosen, {}, {}};
  for (const Sighting& each : sightings) found.sightings.push_back(marks[each.observer] || marks[each.teammate]);
  for (const Prior& each : priors)
    found.priors.push_back(std::any_of(each.nodes.begin(), each.nodes.end(), [&](Index node) { return marks[node]; }));
  return found;
}

void Graph::mark_nodes(const Marked& factors, std::vector<bool>& marks) const {
  for (std::size_t f = 0; f < submaps.size(); f++)
    if (factors.submaps[f])
      for (const Index node : submaps[f].nodes) marks[node] = true;
  for (std::size_t s = 0; s < sightings.size(); s++)
    if (factors.sightings[s]) marks[sightings[s].observer] = marks[sightings[s].teammate] = true;
  for (std::size_t k = 0; k < priors.size(); k++)
    if (factors.priors[k])
      for (const Index node : priors[k].nodes) marks[node] = true;
}

const Graph::Blocks& Graph::blocks() const {
  if (!blocks_) blocks_ = make_blocks();
  return *blocks_;
}

const std::shared_ptr<const sparse::Pattern>& Graph::pattern() const { return blocks().pattern; }

// Σ JᵀP⁻¹J has a block for each pair of members i ≥ j of a factor, neither of them fixed; each column's
// in the order in which the factors name them.
Graph::Blocks Graph::make_blocks() const {
  Blocks made;
  std::vector<Index> pair_row, pair_column;
  const auto add_pairs = [&](Indices members) {
    made.entry_start.push_back(pair_row.size());
    for (const Index i : members)
      for (const Index j : members) {
        const bool is_stored = i >= j && !fixed[i] && !fixed[j];
        pair_row.push_back(is_stored ? i : -1);
        pair_column.push_back(is_stored ? j : -1);
      }
  };
  for (const Joined& each : submaps) add_pairs(each.nodes);
  for (const Sighting& each : sightings) add_pairs(std::array{each.observer, each.teammate});
  if (condensed) add_pairs(condensed->nodes);
  for (const Prior& each : priors) add_pairs(each.nodes);
  std::vector<std::size_t> of_column(nodes() + 1);
  for (const Index j : pair_column)
    if (j >= 0) of_column[j + 1]++;
  for (std::size_t j = 0; j < nodes(); j++) of_column[j + 1] += of_column[j];
  std::vector<std::size_t> pairs(of_column.back()), filled(of_column);
  for (std::size_t pair = 0; pair < pair_column.size(); pair++)
    if (pair_column[pair] >= 0) pairs[filled[pair_column[pair]]++] = pair;
  std::vector<Index> column_start{0}, rows, latest(nodes(), -1);
  made.entry.assign(pair_row.size(), -1);
  for (std::size_t j = 0; j < nodes(); j++) {
    latest[j] = Index(rows.size());
    rows.push_back(Index(j));
    for (std::size_t k = of_column[j]; k < of_column[j + 1]; k++) {
      const Index i = pair_row[pairs[k]];
      if (latest[i] < column_start[j]) {
        latest[i] = Index(rows.size());
        rows.push_back(i);
      }
      made.entry[pairs[k]] = latest[i];
    }
    column_start.push_back(Index(rows.size()));
  }
  std::vector<Index> sizes(nodes());
  for (std::size_t node = 0; node < nodes(); node++) sizes[node] = Index(size_of(Index(node)));
  made.pattern = std::make_shared<const sparse::Pattern>(std::move(sizes), std::move(column_start), std::move(rows));
  return made;
}

// Calls do_block with the place of each stored block of a factor's matrix, its first row and column
// there, its height and width, and whether it is on the diagonal.
template <class F>
void Graph::each_block(std::size_t factor, Indices members, F&& do_block) const {
  const Blocks& stored = blocks();
  const Indices value_start = stored.pattern->value_start();
  std::size_t pair = stored.entry_start[factor], row = 0;
  for (const Index i : members) {
    std::size_t column = 0;
    for (const Index j : members) {
      const Index entry = stored.entry[pair++];
      if (entry >= 0) do_block(std::size_t(value_start[entry]), row, column, size_of(i), size_of(j), i == j);
      column += size_of(j);
    }
    row += size_of(i);
  }
}

void Graph::add(std::size_t factor, Indices members, dense::Const hessian, double weight, Numbers& values) const {
  each_block(factor, members,
             [&](std::size_t to, std::size_t row, std::size_t column, std::size_t height, std::size_t width, bool) {
               for (std::size_t p = 0; p < height; p++)
                 for (std::size_t q = 0; q < width; q++) values[to + p * width + q] += weight * hessian[row + p][column + q];
             });
}

double Graph::trace(std::size_t factor, Indices members, dense::Const hessian, Values covariance) const {
  double total = 0.0;
  each_block(factor, members,
             [&](std::size_t at, std::size_t row, std::size_t column, std::size_t height, std::size_t width, bool is_own) {
               const double times = is_own ? 1.0 : 2.0;
               for (std::size_t p = 0; p < height; p++)
                 for (std::size_t q = 0; q < width; q++)
                   total += times * hessian[row + p][column + q] * covariance[at + p * width + q];
             });
  return total;
}

dense::Matrix Graph::among(std::size_t factor, Indices members, std::size_t size, Values values) const {
  dense::Matrix found(size, size);
  each_block(factor, members,
             [&](std::size_t at, std::size_t row, std::size_t column, std::size_t height, std::size_t width, bool) {
               for (std::size_t p = 0; p < height; p++)
                 for (std::size_t q = 0; q < width; q++)
                   found[row + p][column + q] = found[column + q][row + p] = values[at + p * width + q];
             });
  return found;
}

dense::Matrix Graph::among_boundary(Values values) const {
  return condensed ? among(of_condensed(), condensed->nodes, boundary_.size(), values) : dense::Matrix();
}

std::size_t Graph::diagonal_of(Index node) const {
  const sparse::Pattern& stored = *pattern();
  return std::size_t(stored.value_start()[stored.column_start()[node]]);
}

Numbers Graph::landmark_chi2(Values state, double covariance_factor) const {
  Numbers chi2(landmarks());
  for (std::size_t f = 0; f < submaps.size(); f++)
    submaps[f].submap->landmark_chi2(state, submaps[f].at, covariance_factor,
                                     std::span(chi2).subspan(landmark_start[f], submaps[f].submap->landmarks.size()));
  return chi2;
}

}  // namespace teamslam::graph
