// A fill-reducing elimination order for a block-sparse symmetric matrix: minimum degree.
//
// The graph has a vertex per block variable (a pose: 3 unknowns, a landmark: 2) and an edge per
// non-zero block. Eliminating a vertex makes its neighbours adjacent to each other; next is the vertex
// whose neighbours have the fewest unknowns, the smallest index among equals (George & Liu 1989,
// without its approximations). The neighbours at that moment are the structure of the vertex's column
// in the Cholesky factor, so the order comes with the symbolic factorisation.
#pragma once

#include <cstdint>
#include <span>
#include <vector>

namespace teamslam::sparse {

using Index = std::int64_t;
using Indices = std::span<const Index>;

// The order and the structure of the factor, by step of elimination, in postorder (a subtree is
// contiguous). The column of step k has the rows structure[start[k]] … structure[start[k + 1] − 1]:
// steps at which they are eliminated, ascending, without the diagonal. parent: the first of them, −1
// at a root.
struct Elimination {
  std::vector<Index> order, parent, start, structure;
};

// Blocks (rows[e], j) with column_start[j] ≤ e < column_start[j + 1] are the non-zero blocks of one
// triangle, the diagonal included or not. Indices are trusted.
Elimination minimum_degree(Indices sizes, Indices column_start, Indices rows);

}  // namespace teamslam::sparse
