#include "ordering.hpp"

#include <algorithm>
#include <bit>

namespace teamslam::sparse {

namespace {

// The vertices that are left, each with a row of bits of its neighbours.
class Graph {
 public:
  Graph(Indices sizes, Indices column_start, Indices rows)
      : sizes_(sizes), words_((sizes.size() + 63) / 64), bits_(sizes.size() * words_), degree_(sizes.size()),
        left_(sizes.size(), true) {
    for (Index j = 0; j < Index(sizes.size()); j++)
      for (Index e = column_start[j]; e < column_start[j + 1]; e++)
        if (rows[e] != j) tie(rows[e], j);
  }

  // The vertex whose neighbours have the fewest unknowns, the first among equals.
  Index least() const {
    Index least = -1;
    for (Index i = 0; i < Index(sizes_.size()); i++)
      if (left_[i] && (least < 0 || degree_[i] < degree_[least])) least = i;
    return least;
  }

  // Makes all neighbours of v adjacent to each other and removes v; they are appended, ascending.
  void eliminate(Index v, std::vector<Index>& neighbours) {
    left_[v] = false;
    const std::size_t begin = neighbours.size();
    for (std::size_t word = 0; word < words_; word++)
      for_each_bit(row(v)[word], word, [&](Index i) { neighbours.push_back(i); });
    for (std::size_t a = begin; a < neighbours.size(); a++) {
      const Index i = neighbours[a];
      row(i)[v >> 6] &= ~bit(v);
      degree_[i] -= sizes_[v];
      for (std::size_t word = 0; word < words_; word++) {
        std::uint64_t fresh = row(v)[word] & ~row(i)[word];
        if (Index(word) == i >> 6) fresh &= ~bit(i);
        row(i)[word] |= fresh;
        for_each_bit(fresh, word, [&](Index j) { degree_[i] += sizes_[j]; });
      }
    }
  }

 private:
  static std::uint64_t bit(Index i) { return std::uint64_t(1) << (i & 63); }
  std::uint64_t* row(Index i) { return bits_.data() + i * words_; }

  void tie(Index i, Index j) {
    if (row(i)[j >> 6] & bit(j)) return;
    row(i)[j >> 6] |= bit(j);
    row(j)[i >> 6] |= bit(i);
    degree_[i] += sizes_[j];
    degree_[j] += sizes_[i];
  }

  template <class F>
  static void for_each_bit(std::uint64_t bits, std::size_t word, F&& use) {
    for (; bits; bits &= bits - 1) use(Index(word << 6) + std::countr_zero(bits));
  }

  Indices sizes_;
  std::size_t words_;
  std::vector<std::uint64_t> bits_;
  std::vector<Index> degree_;
  std::vector<char> left_;
};

// The nodes of a forest with every subtree before its root, children ascending.
std::vector<Index> postorder(Indices parent) {
  const Index n = Index(parent.size());
  std::vector<Index> child(n + 1, -1), sibling(n, -1), visited;
  visited.reserve(n);
  for (Index node = n - 1; node >= 0; node--) {
    Index& first = child[parent[node] >= 0 ? parent[node] : n];
    sibling[node] = first;
    first = node;
  }
  for (Index root = child[n]; root >= 0; root = sibling[root])
    for (Index node = root;; node = sibling[node] >= 0 ? sibling[node] : parent[node]) {
      for (Index down; (down = child[node]) >= 0; node = down) child[node] = -1;
      visited.push_back(node);
      if (node == root) break;
    }
  return visited;
}

std::vector<Index> inverse_of(Indices permutation) {
  std::vector<Index> inverse(permutation.size());
  for (Index k = 0; k < Index(permutation.size()); k++) inverse[permutation[k]] = k;
  return inverse;
}

}  // namespace

Elimination minimum_degree(Indices sizes, Indices column_start, Indices rows) {
  const Index n = Index(sizes.size());
  Graph graph(sizes, column_start, rows);
  std::vector<Index> order(n), start(n + 1), structure, parent(n, -1);
  for (Index step = 0; step < n; step++) {
    order[step] = graph.least();
    graph.eliminate(order[step], structure);
    start[step + 1] = Index(structure.size());
  }
  const std::vector<Index> step_of = inverse_of(order);
  for (Index& each : structure) each = step_of[each];
  for (Index step = 0; step < n; step++)
    if (start[step + 1] > start[step])
      parent[step] = *std::min_element(structure.begin() + start[step], structure.begin() + start[step + 1]);

  const std::vector<Index> old_of = postorder(parent), new_of = inverse_of(old_of);
  Elimination found{std::vector<Index>(n), std::vector<Index>(n, -1), std::vector<Index>(n + 1), {}};
  found.structure.reserve(structure.size());
  for (Index step = 0; step < n; step++) {
    const Index old = old_of[step];
    found.order[step] = order[old];
    if (parent[old] >= 0) found.parent[step] = new_of[parent[old]];
    for (Index k = start[old]; k < start[old + 1]; k++) found.structure.push_back(new_of[structure[k]]);
    std::sort(found.structure.begin() + found.start[step], found.structure.end());
    found.start[step + 1] = Index(found.structure.size());
  }
  return found;
}

}  // namespace teamslam::sparse
