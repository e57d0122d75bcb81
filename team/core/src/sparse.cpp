#include "sparse.hpp"

#include <algorithm>
#include <cmath>

#include "product.hpp"

namespace teamslam::sparse {

using dense::by_columns, dense::by_rows, dense::Const, dense::Into, dense::Left, dense::load, dense::Matrix;
using dense::multiply, dense::Register, dense::transposed, dense::View;

namespace {

constexpr double PIVOT_TOLERANCE = 1e-14;  // pivot to diagonal entry below which it is rounding: undetermined
constexpr std::size_t ROWS = 256, WIDTH = 16;  // rows and columns from which a panel is big
constexpr std::size_t BLOCK = 48;              // columns of a big panel that are factored, solved or inverted together
constexpr std::size_t HIGH = 4;                // columns of a panel that are worked together, as rows of a product

void negate(View a) {
  for (std::size_t i = 0; i < a.rows; i++)
    for (std::size_t j = 0; j < a.columns; j++) a[i][j] = -a[i][j];
}

bool is_big(Const panel) { return panel.columns >= ROWS && panel.rows >= WIDTH; }

// Factorises these columns in place, given those from `begin` on; panel and least begin at column 0.
// Returns the first column whose pivot is ≤ least, else −1.
Index factorise_columns(View panel, std::size_t begin, std::size_t end, const double* least) {
  for (std::size_t first = begin; first < end; first += HIGH) {
    const std::size_t behind = std::min(first + HIGH, end), m = panel.columns - first;
    const Const before = panel.part(begin, first, first - begin, m);
    multiply<Into::SUBTRACT>(panel.part(first, first, behind - first, m), by_columns(before), before);
    for (std::size_t k = first; k < behind; k++) {
      double* row = panel[k];
      if (!(row[k] > least[k])) return Index(k);
      const double root = pack::sqrt(row[k]);
      for (std::size_t i = k; i < panel.columns; i++) row[i] /= root;
      for (std::size_t later = k + 1; later < behind; later++) {
        const double factor = row[later];
        double* other = panel[later];
        for (std::size_t i = later; i < panel.columns; i++) other[i] -= factor * row[i];
      }
    }
  }
  return -1;
}

// Factorises a panel in place: a big one by blocks, whose product is subtracted from the later columns.
Index factorise_panel(View panel, const double* least) {
  if (!is_big(panel)) return factorise_columns(panel, 0, panel.rows, least);
  for (std::size_t begin = 0; begin < panel.rows; begin += BLOCK) {
    const std::size_t end = std::min(begin + BLOCK, panel.rows), m = panel.columns - end;
    const Index failed = factorise_columns(panel, begin, end, least);
    if (failed >= 0) return failed;
    const Const block = panel.part(begin, end, end - begin, m);
    multiply<Into::SUBTRACT_SUM>(panel.part(end, end, panel.rows - end, m), by_columns(block), block, {.is_upper = true});
  }
  return -1;
}

// place[i] := index of requested[i] in `present`; both ascend, all are present.
void find_places(Indices requested, Indices present, std::vector<Index>& place) {
  Index at = 0;
  for (std::size_t i = 0; i < requested.size(); i++) {
    while (present[at] != requested[i]) at++;
    place[i] = at;
  }
}

// The columns of the panels that the rows below a supernode reach, with the places of these rows.
class Reached {
 public:
  Reached(const Supernodes& nodes, Indices below) : nodes_(nodes), below_(below), place_(below.size()) {}

  // Goes on to the column of below[j] in the panels, where below[i] has the place `at(i)`, i ≥ j.
  Index column(std::size_t j) {
    const Index t = nodes_.supernode_of[below_[j]];
    if (t != supernode_) {
      supernode_ = t;
      begin_ = j;
      find_places(below_.subspan(j), nodes_.rows(t), place_);
    }
    return nodes_.panel_start[t] + (below_[j] - nodes_.columns_of[t]) * nodes_.height(t);
  }
  Index at(std::size_t i) const { return place_[i - begin_]; }
  bool is_contiguous(std::size_t j) const {
    return at(below_.size() - 1) - at(j) == Index(below_.size() - 1 - j);
  }

 private:
  const Supernodes& nodes_;
  Indices below_;
  std::vector<Index> place_;
  Index supernode_ = -1;
  std::size_t begin_ = 0;
};

// L_JJ⁻¹ on the supernode's own rows, Y = L_RJ L_JJ⁻¹ on those below (same layout).
Matrix over_own_triangle(Const panel) {
  const std::size_t width = panel.rows, below = panel.columns - width;
  Matrix y(width, panel.columns);
  for (std::size_t k = 0; k < width; k++) {
    double* own = y[k];
    own[k] = 1.0 / panel[k][k];
    for (std::size_t p = k; p < width; p++) {
      const double* row = panel[p];
      if (p > k) own[p] = -own[p] / row[p];
      for (std::size_t i = p + 1; i < width; i++) own[i] += row[i] * own[p];
    }
  }
  for (std::size_t k = width; k-- > 0;) {
    std::copy_n(panel[k] + width, below, y[k] + width);
    const Left left{panel[k] + k + 1, panel.stride, 1};
    multiply<Into::SUBTRACT>(y.view().part(k, width, 1, below), left, y.view().part(k + 1, width, width - k - 1, below));
    for (std::size_t i = width; i < panel.columns; i++) y[k][i] /= panel[k][k];
  }
  return y;
}

// A big panel's inverse triangle, L_JJ⁻ᵀ. With L = (A 0; B C): L⁻¹ = (A⁻¹ 0; −C⁻¹ B A⁻¹  C⁻¹), one block after the other.
Matrix inverse_by_blocks(Const panel) {
  const std::size_t width = panel.rows;
  Matrix inverse(width, width);
  for (std::size_t begin = 0; begin < width; begin += BLOCK) {
    const std::size_t size = std::min(BLOCK, width - begin);
    const View own = inverse.view().part(begin, begin, size, size);
    const Matrix block = over_own_triangle(panel.part(begin, begin, size, size));
    for (std::size_t k = 0; k < size; k++) std::copy_n(block[k], size, own[k]);
    if (begin == 0) continue;
    Matrix coupled(begin, size);
    const View beside = inverse.view().part(0, begin, begin, size);
    multiply<Into::SET>(coupled.view(), by_rows(inverse.view().part(0, 0, begin, begin)),
                       panel.part(0, begin, begin, size), {.is_left_upper = true});
    multiply<Into::SET>(beside, by_rows(coupled), own);
    negate(beside);
  }
  return inverse;
}

// Takahashi's step for a big panel; known: the inverse on the rows below.
void select_by_blocks(Const panel, Const known, View result) {
  const std::size_t width = panel.rows, below = panel.columns - width;
  const Matrix inverse = inverse_by_blocks(panel), across = transposed(inverse);
  const View own = result.part(0, 0, width, width), rest = result.part(0, width, width, below);
  multiply<Into::SET>(own, by_rows(inverse), across, {.is_upper = true, .is_left_upper = true});
  if (below == 0) return;
  Matrix y(width, below), coupled(width, width);
  multiply<Into::SET>(y.view(), by_rows(inverse), panel.part(0, width, width, below), {.is_left_upper = true});
  multiply<Into::SET>(rest, by_rows(y), known);
  multiply<Into::SET>(coupled.view(), by_rows(rest), transposed(y), {.is_upper = true});
  for (std::size_t k = 0; k < width; k++)
    for (std::size_t later = k; later < width; later++) own[k][later] += coupled[k][later];
  negate(rest);
}

void select(Const panel, Const known, View result) {
  const std::size_t width = panel.rows, below = panel.columns - width;
  const Matrix y = over_own_triangle(panel), across = transposed(y);
  const View own = result.part(0, 0, width, width), rest = result.part(0, width, width, below);
  const Const y_below = y.view().part(0, width, width, below);
  multiply<Into::SUBTRACT>(rest, by_rows(y_below), known);
  multiply<Into::ADD>(own, by_rows(y), across.view().part(0, 0, width, width), {.is_upper = true, .is_left_upper = true});
  multiply<Into::SUBTRACT>(own, by_rows(y_below), transposed(rest), {.is_upper = true});
}

// Overwrites x with L_JJ⁻¹ x; by_sums: the products of blocks are subtracted as a whole.
void solve_forward(Const panel, View x, std::size_t block, bool by_sums) {
  const std::size_t width = panel.rows;
  for (std::size_t begin = 0; begin < width; begin += block) {
    const std::size_t end = std::min(begin + block, width);
    for (std::size_t first = begin; first < end; first += HIGH) {
      const std::size_t behind = std::min(first + HIGH, end);
      multiply<Into::SUBTRACT>(x.part(first, 0, behind - first, x.columns),
                              by_columns(panel.part(begin, first, first - begin, behind - first)),
                              x.part(begin, 0, first - begin, x.columns));
      for (std::size_t k = first; k < behind; k++) {
        for (std::size_t c = 0; c < x.columns; c++) x[k][c] /= panel[k][k];
        for (std::size_t i = k + 1; i < behind; i++)
          for (std::size_t c = 0; c < x.columns; c++) x[i][c] -= panel[k][i] * x[k][c];
      }
    }
    const Left later = by_columns(panel.part(begin, end, end - begin, width - end));
    if (by_sums)
      multiply<Into::SUBTRACT_SUM>(x.part(end, 0, width - end, x.columns), later, x.part(begin, 0, end - begin, x.columns));
  }
}

}  // namespace

// Columns of a right side in the order of elimination, side by side in whole registers or alone.
struct Cholesky::Columns {
  static constexpr std::size_t MOST = 8 * pack::IN_REGISTER;

  // At most MOST columns of n numbers, and panels of at most `height` rows.
  Columns(std::size_t n, std::size_t columns, std::size_t height)
      : registers(columns == 1 ? 0 : columns <= pack::IN_REGISTER ? 1 : columns <= 2 * pack::IN_REGISTER ? 2
                  : columns <= 4 * pack::IN_REGISTER ? 4 : 8),
        x(n, registers ? registers * pack::IN_REGISTER : 1), local(height, x.columns()) {}

  void gather(Indices rows) {
    for (std::size_t i = 0; i < rows.size(); i++) std::copy_n(x[rows[i]], x.columns(), local[i]);
  }

  std::size_t registers;        // 0: one column
  Matrix x, local;              // local: the rows of a panel
  std::vector<char> is_active;  // whether a supernode has numbers other than zero; empty: all have
};

Const Cholesky::panel(Index s) const {
  const Supernodes& nodes = pattern_->supernodes();
  const std::size_t height = nodes.height(s);
  return {panels_.data() + nodes.panel_start[s], std::size_t(nodes.width(s)), height, height};
}

bool Pattern::has_big_panel() const {
  for (Index s = 0; s < supernodes_.count(); s++)
    if (supernodes_.height(s) >= Index(ROWS) && supernodes_.width(s) >= Index(WIDTH)) return true;
  return false;
}

// Right-looking: a supernode's dense factorisation, then its outer product L_RJ L_RJᵀ is subtracted
// from the panels of the rows that it reaches.
Cholesky::Cholesky(std::shared_ptr<const Pattern> pattern, Values values)
    : pattern_(std::move(pattern)), panels_(pattern_->supernodes().panel_start.back()) {
  const Supernodes& nodes = pattern_->supernodes();
  const Indices target = pattern_->target();
  for (std::size_t k = 0; k < target.size(); k++) panels_[target[k]] = values[k];
  std::vector<double> least(pattern_->unknowns()), update;
  for (Index s = 0; s < nodes.count(); s++)
    for (Index k = 0; k < nodes.width(s); k++)
      least[nodes.columns_of[s] + k] = PIVOT_TOLERANCE * std::fabs(panel(s)[k][k]);
  for (Index s = 0; s < nodes.count(); s++) {
    const Const from = panel(s);
    const std::size_t width = from.rows, below = from.columns - width;
    const View own{panels_.data() + nodes.panel_start[s], width, from.columns, from.stride};
    const Index failed = factorise_panel(own, &least[nodes.columns_of[s]]);
    if (failed >= 0) {
      const Indices order = pattern_->permutation(), offset = pattern_->offset();
      const Index unknown = std::find(order.begin(), order.end(), nodes.columns_of[s] + failed) - order.begin();
      throw NotPositiveDefinite(std::upper_bound(offset.begin(), offset.end(), unknown) - offset.begin() - 1);
    }
    Reached reached(nodes, nodes.rows(s).subspan(width));
    update.resize(HIGH * below);
    for (std::size_t first = 0; first < below; first += HIGH) {
      const std::size_t high = std::min(HIGH, below - first), wide = below - first;
      const Const rest = from.part(0, width + first, width, wide);
      multiply<Into::SET>({update.data(), high, wide, wide}, by_columns(rest), rest);
      for (std::size_t j = 0; j < high; j++) {
        double* column = panels_.data() + reached.column(first + j);
        const double* sums = update.data() + j * wide;
        if (reached.is_contiguous(first + j)) {
          column += reached.at(first + j);
          for (std::size_t i = j; i < wide; i++) column[i - j] -= sums[i];
        } else {
          for (std::size_t i = j; i < wide; i++) column[reached.at(first + i)] -= sums[i];
        }
      }
    }
  }
}

// x := L⁻¹ x.
void Cholesky::forward(Columns& x) const {
  const Supernodes& nodes = pattern_->supernodes();
  for (Index s = 0; s < nodes.count(); s++) {
    if (!x.is_active.empty() && !x.is_active[s]) continue;
    const Const L = panel(s);
    const Indices rows = nodes.rows(s);
    const std::size_t width = L.rows, below = L.columns - width, many = x.x.columns();
    x.gather(rows);
    if (x.registers == 0) {
      double* local = x.local[0];
      for (std::size_t k = 0; k < width; k++) {
        const double* row = L[k];
        const double pivot = local[k] /= row[k];
        for (std::size_t i = k + 1; i < L.columns; i++) local[i] -= row[i] * pivot;
      }
    } else {
      const View local = x.local.view();
      solve_forward(L, local.part(0, 0, width, many), width, false);
      multiply<Into::SUBTRACT>(local.part(width, 0, below, many), by_columns(L.part(0, width, width, below)),
                              local.part(0, 0, width, many));
    }
    for (std::size_t i = 0; i < L.columns; i++) std::copy_n(x.local[i], many, x.x[rows[i]]);
  }
}

// x := L⁻ᵀ x down to supernode `first`; those before it stay.
void Cholesky::backward(Columns& x, Index first) const {
  switch (x.registers) {
    case 0: return backward_by<double, 1>(x, first);
    case 1: return backward_by<Register, 1>(x, first);
    case 2: return backward_by<Register, 2>(x, first);
    case 4: return backward_by<Register, 4>(x, first);
    default: return backward_by<Register, 8>(x, first);
  }
}

template <class T, std::size_t N>
void Cholesky::backward_by(Columns& x, Index first) const {
  constexpr std::size_t LANES = sizeof(T) / sizeof(double);
  const Supernodes& nodes = pattern_->supernodes();
  for (Index s = nodes.count() - 1; s >= first; s--) {
    const Const L = panel(s);
    x.gather(nodes.rows(s));
    for (std::size_t k = L.rows; k-- > 0;) {
      const double* row = L[k];
      T sum[N];
      for (std::size_t q = 0; q < N; q++) sum[q] = load<T>(x.local[k] + q * LANES);
      const double* other = x.local[k];
      for (std::size_t i = k + 1; i < L.columns; i++) {
        other += N * LANES;
        for (std::size_t q = 0; q < N; q++) sum[q] -= row[i] * load<T>(other + q * LANES);
      }
      for (std::size_t q = 0; q < N; q++) {
        sum[q] /= row[k] - T{};
        std::memcpy(x.local[k] + q * LANES, &sum[q], sizeof sum[q]);
      }
      std::copy_n(x.local[k], N * LANES, x.x[nodes.columns_of[s] + k]);
    }
  }
}

Matrix Cholesky::solve(Const right) const {
  const Indices place = pattern_->permutation();
  Matrix solution(right.rows, right.columns);
  for (std::size_t begin = 0; begin < right.columns; begin += Columns::MOST) {
    const std::size_t count = std::min(Columns::MOST, right.columns - begin);
    Columns x(right.rows, count, right.rows);
    for (std::size_t i = 0; i < right.rows; i++) std::copy_n(right[i] + begin, count, x.x[place[i]]);
    forward(x);
    backward(x, 0);
    for (std::size_t i = 0; i < right.rows; i++) std::copy_n(x.x[place[i]], count, solution[i] + begin);
  }
  return solution;
}

std::vector<double> Cholesky::solve(Values right) const {
  return solve(dense::column(right)).numbers();
}

// The rows `requested` of columns of A⁻¹, both by their places in the order of elimination and none
// before supernode `first`.
Matrix Cholesky::columns_of_inverse(Indices chosen, Indices requested, Index first) const {
  const Supernodes& nodes = pattern_->supernodes();
  Matrix columns(requested.size(), chosen.size());
  for (std::size_t begin = 0; begin < chosen.size(); begin += Columns::MOST) {
    const std::size_t count = std::min(Columns::MOST, chosen.size() - begin);
    Columns x(pattern_->unknowns(), count, pattern_->unknowns());
    x.is_active.resize(nodes.count());
    for (std::size_t c = 0; c < count; c++) {
      x.x[chosen[begin + c]][c] = 1.0;
      // A unit vector fills the supernodes from its own up to the root.
      for (Index s = nodes.supernode_of[chosen[begin + c]]; s >= 0; s = nodes.parent[s]) x.is_active[s] = true;
    }
    forward(x);
    backward(x, first);
    for (std::size_t i = 0; i < requested.size(); i++) std::copy_n(x.x[requested[i]], count, columns[i] + begin);
  }
  return columns;
}

Matrix Cholesky::inverse_columns(Indices unknowns) const {
  const Indices place = pattern_->permutation();
  std::vector<Index> chosen;
  for (const Index each : unknowns) chosen.push_back(place[each]);
  return columns_of_inverse(chosen, place, 0);
}

Matrix Cholesky::inverse_block(Indices unknowns) const {
  const Indices place = pattern_->permutation();
  std::vector<Index> chosen;
  for (const Index each : unknowns) chosen.push_back(place[each]);
  Matrix block;
  if (pattern_->has_big_panel()) {
    std::vector<Index> order(chosen.size()), ascending(chosen.size());
    for (std::size_t k = 0; k < order.size(); k++) order[k] = Index(k);
    std::stable_sort(order.begin(), order.end(), [&](Index a, Index b) { return chosen[a] < chosen[b]; });
    for (std::size_t k = 0; k < order.size(); k++) ascending[k] = chosen[order[k]];
    const Matrix among = inverse_among(ascending);
    block = Matrix(order.size(), order.size());
    for (std::size_t i = 0; i < order.size(); i++)
      for (std::size_t j = 0; j < order.size(); j++) block[order[i]][order[j]] = among[i][j];
  } else {
    Index first = pattern_->supernodes().count();
    for (const Index each : chosen) first = std::min(first, pattern_->supernodes().supernode_of[each]);
    block = columns_of_inverse(chosen, chosen, first);
  }
  for (std::size_t i = 0; i < chosen.size(); i++)
    for (std::size_t j = 0; j <= i; j++) block[i][j] = block[j][i] = 0.5 * (block[i][j] + block[j][i]);
  return block;
}

// A⁻¹ among ascending unknowns (by their places): Wᵀ W with L W = their unit vectors.
//
// A unit vector fills the supernodes from its own up to the root, so at each supernode only the unit
// vectors of its subtree take part, and those are neighbours.
Matrix Cholesky::inverse_among(Indices requested) const {
  const Supernodes& nodes = pattern_->supernodes();
  const std::size_t many = requested.size();
  std::vector<Index> first(nodes.columns_of.begin(), nodes.columns_of.end() - 1);  // column of each subtree
  for (Index s = 0; s < nodes.count(); s++)
    if (nodes.parent[s] >= 0) first[nodes.parent[s]] = std::min(first[nodes.parent[s]], first[s]);
  Matrix solution(pattern_->unknowns(), many), result(many, many);
  for (std::size_t c = 0; c < many; c++) solution[requested[c]][c] = 1.0;
  for (Index s = 0; s < nodes.count(); s++) {
    const auto at = [&](Index column) {
      return std::size_t(std::lower_bound(requested.begin(), requested.end(), column) - requested.begin());
    };
    const std::size_t begin = at(first[s]), count = at(nodes.columns_of[s + 1]) - begin;
    if (count == 0) continue;
    const Const L = panel(s);
    const std::size_t width = L.rows, below = L.columns - width;
    const View own = solution.view().part(nodes.columns_of[s], begin, width, count);
    solve_forward(L, own, BLOCK, true);
    Matrix reached(below, count);
    multiply<Into::SET>(reached.view(), by_columns(L.part(0, width, width, below)), own);
    const Indices rows = nodes.rows(s).subspan(width);
    for (std::size_t i = 0; i < below; i++)
      for (std::size_t c = 0; c < count; c++) solution[rows[i]][begin + c] -= reached[i][c];
    Matrix squares(count, count);
    multiply<Into::SET>(squares.view(), by_columns(own), own, {.is_upper = true});
    for (std::size_t i = 0; i < count; i++)
      for (std::size_t c = i; c < count; c++) result[begin + i][begin + c] += squares[i][c];
  }
  for (std::size_t i = 0; i < many; i++)
    for (std::size_t c = 0; c < i; c++) result[i][c] = result[c][i];
  return result;
}

std::vector<double> Cholesky::selected_inverse() const {
  const Supernodes& nodes = pattern_->supernodes();
  std::vector<double> inverse(panels_.size());
  for (Index s = nodes.count() - 1; s >= 0; s--) {
    const Const L = panel(s);
    const std::size_t below = L.columns - L.rows;
    Reached reached(nodes, nodes.rows(s).subspan(L.rows));
    Matrix known(below, below);  // the inverse on the rows below
    for (std::size_t j = 0; j < below; j++) {
      const double* column = inverse.data() + reached.column(j);
      for (std::size_t i = j; i < below; i++) known[i][j] = known[j][i] = column[reached.at(i)];
    }
    const View result{inverse.data() + nodes.panel_start[s], L.rows, L.columns, L.stride};
    is_big(L) ? select_by_blocks(L, known, result) : select(L, known, result);
  }
  std::vector<double> entries;
  for (const Index each : pattern_->target()) entries.push_back(inverse[each]);
  return entries;
}

}  // namespace teamslam::sparse
