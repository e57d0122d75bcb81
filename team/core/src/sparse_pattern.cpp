#include <algorithm>

#include "sparse.hpp"

namespace teamslam::sparse {

namespace {

constexpr double PADDING = 0.25;         // supernodes grow while explicit zeros are less than this share of the panel
constexpr Index MOST_UNKNOWNS = 1 << 20;  // of one variable

void require(bool is_so, const char* otherwise) {
  if (!is_so) throw std::invalid_argument(otherwise);
}

void append_range(std::vector<Index>& to, Index first, Index count) {
  for (Index k = 0; k < count; k++) to.push_back(first + k);
}

// The first block of each supernode, and the number of blocks. first: the first unknown of each block;
// below: the unknowns below it.
//
// A block joins the supernode before it if it is the parent of that supernode's last block; the rows
// of the earlier blocks are then among the columns and rows of the later one.
std::vector<Index> supernode_begins(Indices first, Indices below, Indices parent) {
  const Index n = Index(below.size());
  std::vector<Index> begins;
  Index stored = 0;
  for (Index k = 0; k < n; k++) {
    const Index width = first[k + 1] - first[k], own = width * (width + below[k]);
    if (k > 0 && parent[k - 1] == k) {
      const Index wide = first[k + 1] - first[begins.back()];
      if (double(wide * (wide + below[k])) <= (1.0 + PADDING) * double(stored + own) + 0.5 * double(wide) * double(wide)) {
        stored += own;
        continue;
      }
    }
    begins.push_back(k);
    stored = own;
  }
  begins.push_back(n);
  return begins;
}

// Neighbouring blocks of the elimination in panels, in numbers of unknowns. first: the first unknown of each block.
Supernodes supernodes_of(Indices sizes, const Elimination& tree, Indices first) {
  const Index n = Index(tree.order.size());
  std::vector<Index> below(n);
  for (Index k = 0; k < n; k++)
    for (Index e = tree.start[k]; e < tree.start[k + 1]; e++) below[k] += sizes[tree.order[tree.structure[e]]];
  const std::vector<Index> begins = supernode_begins(first, below, tree.parent);
  Supernodes made;
  made.columns_of = made.row_start = made.panel_start = {0};
  for (std::size_t s = 0; s + 1 < begins.size(); s++) {
    const Index begin = first[begins[s]], end = first[begins[s + 1]], last = begins[s + 1] - 1;
    made.supernode_of.resize(end, Index(s));
    append_range(made.row, begin, end - begin);
    for (Index e = tree.start[last]; e < tree.start[last + 1]; e++) {
      const Index block = tree.structure[e];
      append_range(made.row, first[block], sizes[tree.order[block]]);
    }
    made.columns_of.push_back(end);
    made.row_start.push_back(Index(made.row.size()));
    made.panel_start.push_back(made.panel_start.back() + (end - begin) * (made.row_start[s + 1] - made.row_start[s]));
  }
  for (std::size_t s = 0; s + 1 < begins.size(); s++) {
    const Index under = made.row_start[s] + made.columns_of[s + 1] - made.columns_of[s];
    made.parent.push_back(under < made.row_start[s + 1] ? made.supernode_of[made.row[under]] : -1);
  }
  return made;
}

}  // namespace

Pattern::Pattern(std::vector<Index> sizes, std::vector<Index> column_start, std::vector<Index> rows)
    : sizes_(std::move(sizes)), column_start_(std::move(column_start)), rows_(std::move(rows)) {
  const Index n = Index(sizes_.size());
  require(Index(column_start_.size()) == n + 1 && column_start_[0] == 0 && column_start_[n] == Index(rows_.size()),
          "column_start must lead from 0 to the number of entries");
  offset_ = value_start_ = {0};
  for (const Index size : sizes_) {
    require(size > 0 && size <= MOST_UNKNOWNS, "each variable of a pattern has unknowns");
    offset_.push_back(offset_.back() + size);
  }
  std::vector<Index> last_of(n, -1);  // the last column with this row
  for (Index j = 0; j < n; j++) {
    const Index begin = column_start_[j], end = column_start_[j + 1];
    require(begin < end && end <= Index(rows_.size()) && rows_[begin] == j,
            "each column of a pattern begins with its diagonal block");
    for (Index e = begin; e < end; e++) {
      require(rows_[e] >= j && rows_[e] < n && last_of[rows_[e]] < j,
              "the rows of a pattern's column are distinct and not above its diagonal");
      last_of[rows_[e]] = j;
      columns_.push_back(j);
      value_start_.push_back(value_start_.back() + sizes_[rows_[e]] * sizes_[j]);
    }
  }

  const Elimination tree = minimum_degree(sizes_, column_start_, rows_);
  std::vector<Index> first(n + 1);
  permutation_.resize(unknowns());
  for (Index k = 0; k < n; k++) {
    const Index block = tree.order[k];
    first[k + 1] = first[k] + sizes_[block];
    for (Index i = 0; i < sizes_[block]; i++) permutation_[offset_[block] + i] = first[k] + i;
  }
  supernodes_ = supernodes_of(sizes_, tree, first);

  // The unknowns of a variable are neighbours in the order of elimination and in each panel's rows, so
  // one of them is searched for. The upper half of a diagonal block has the places of the lower.
  target_.reserve(numbers());
  for (std::size_t e = 0; e < rows_.size(); e++) {
    const Index i = permutation_[offset_[rows_[e]]], j = permutation_[offset_[columns_[e]]];
    const Index s = supernodes_.supernode_of[std::min(i, j)], later = std::max(i, j);
    const Indices present = supernodes_.rows(s);
    const Index at = std::lower_bound(present.begin(), present.end(), later) - present.begin() - later;
    for (Index p = i; p < i + sizes_[rows_[e]]; p++)
      for (Index q = j; q < j + sizes_[columns_[e]]; q++)
        target_.push_back(supernodes_.panel_start[s] +
                          (std::min(p, q) - supernodes_.columns_of[s]) * Index(present.size()) + at + std::max(p, q));
  }
}

std::vector<Index> Pattern::diagonal() const {
  std::vector<Index> places;
  for (Index j = 0; j < variables(); j++)
    for (Index i = 0; i < sizes_[j]; i++) places.push_back(value_start_[column_start_[j]] + i * (sizes_[j] + 1));
  return places;
}

dense::Matrix Pattern::block(Values values, Index row, Index column) const {
  const Index lower = std::max(row, column), upper = std::min(row, column);
  dense::Matrix found(sizes_[row], sizes_[column]);
  const auto end = rows_.begin() + column_start_[upper + 1];
  const auto at = std::find(rows_.begin() + column_start_[upper], end, lower);
  if (at == end) return found;
  const double* stored = values.data() + value_start_[at - rows_.begin()];
  for (Index i = 0; i < sizes_[row]; i++)
    for (Index j = 0; j < sizes_[column]; j++)
      found[i][j] = row == lower ? stored[i * sizes_[column] + j] : stored[j * sizes_[row] + i];
  return found;
}

double Pattern::quadratic(Values values, Values x) const {
  double total = 0.0;
  for (std::size_t e = 0; e < rows_.size(); e++) {
    const Index height = sizes_[rows_[e]], width = sizes_[columns_[e]];
    const double *A = values.data() + value_start_[e], *left = &x[offset_[rows_[e]]], *right = &x[offset_[columns_[e]]];
    double block = 0.0;
    for (Index i = 0; i < height; i++)
      for (Index j = 0; j < width; j++) block += left[i] * A[i * width + j] * right[j];
    total += rows_[e] == columns_[e] ? block : 2.0 * block;
  }
  return total;
}

}  // namespace teamslam::sparse
