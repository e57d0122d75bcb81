// Sparse symmetric positive definite systems of small blocks: A = L Lᵀ, solutions, entries of the inverse.
//
// The pattern (order, structure) is separate from the numbers and holds while the graph does not
// change. The factor is stored by supernodes: neighbouring columns with (nearly) the same rows share
// one dense panel (Davis 2006, "Direct Methods for Sparse Linear Systems", chapters 4 and 6). All sums
// have a fixed order.
#pragma once

#include <memory>
#include <stdexcept>
#include <string>
#include <vector>

#include "dense.hpp"
#include "ordering.hpp"

namespace teamslam::sparse {

using Values = std::span<const double>;

// A pivot of the factorisation is not positive: the block `variable` is undetermined.
struct NotPositiveDefinite : std::domain_error {
  explicit NotPositiveDefinite(Index variable)
      : std::domain_error("the matrix is not positive definite: pivot of variable " + std::to_string(variable)),
        variable(variable) {}
  Index variable;
};

// The panels of L. Supernode s has the permuted unknowns columns_of[s] … columns_of[s + 1] − 1 as
// columns and row[row_start[s]] … row[row_start[s + 1] − 1] as rows, its columns first. Its panel, of
// Lᵀ, begins at panel_start[s]: a row per column of L, as long as there are rows; entries left of the
// diagonal mean nothing. parent: the supernode of the first row below, −1 at a root.
struct Supernodes {
  std::vector<Index> columns_of, row_start, row, panel_start, supernode_of, parent;

  Index count() const { return Index(parent.size()); }
  Index width(Index s) const { return columns_of[s + 1] - columns_of[s]; }
  Index height(Index s) const { return row_start[s + 1] - row_start[s]; }
  Indices rows(Index s) const { return Indices(row).subspan(row_start[s], height(s)); }
};

// The stored blocks of the lower triangle of a symmetric matrix, and their places in the factor.
//
// Entry e with column_start[j] ≤ e < column_start[j + 1] is block (rows[e], j), rows[e] ≥ j, the
// diagonal block first. The numbers of a matrix are one flat array: block e row by row from
// value_start[e] on, diagonal blocks as full squares.
class Pattern {
 public:
  // Throws std::invalid_argument where this is no pattern.
  Pattern(std::vector<Index> sizes, std::vector<Index> column_start, std::vector<Index> rows);

  Index variables() const { return Index(sizes_.size()); }
  Index unknowns() const { return offset_.back(); }
  Index numbers() const { return value_start_.back(); }

  Indices sizes() const { return sizes_; }                // unknowns of each variable
  Indices offset() const { return offset_; }              // first unknown of each variable, and their number
  Indices column_start() const { return column_start_; }  // first entry of each column, and their number
  Indices rows() const { return rows_; }
  Indices columns() const { return columns_; }            // column of each entry
  Indices value_start() const { return value_start_; }    // first number of each entry, and their number
  std::vector<Index> diagonal() const;                    // place of each unknown's diagonal among the numbers

  // Block (row, column) of the symmetric matrix; zero where none is stored.
  dense::Matrix block(Values values, Index row, Index column) const;
  // xᵀ A x.
  double quadratic(Values values, Values x) const;

  Indices permutation() const { return permutation_; }  // place of each unknown in the order of elimination
  Indices target() const { return target_; }            // place in the panels of each number
  const Supernodes& supernodes() const { return supernodes_; }
  bool has_big_panel() const;                           // whether a panel is factored by blocks

 private:
  std::vector<Index> sizes_, column_start_, rows_, offset_, columns_, value_start_, permutation_, target_;
  Supernodes supernodes_;
};

// The Cholesky factor L of a matrix on a pattern, L Lᵀ = A (permuted). Its numbers are finite: one that
// is not leaves no positive pivot in its row.
class Cholesky {
 public:
  // Throws NotPositiveDefinite, which names the pivot's variable. A pivot that is rounding noise of its
  // diagonal entry counts as zero.
  Cholesky(std::shared_ptr<const Pattern> pattern, Values values);

  const Pattern& pattern() const { return *pattern_; }

  // A⁻¹ right.
  dense::Matrix solve(dense::Const right) const;
  std::vector<double> solve(Values right) const;
  // Columns of A⁻¹: the covariance of all unknowns with some.
  dense::Matrix inverse_columns(Indices unknowns) const;
  // A⁻¹ between some unknowns: their joint covariance, exactly symmetric.
  dense::Matrix inverse_block(Indices unknowns) const;
  // The entries of A⁻¹ on the pattern of A, in the layout of A's numbers.
  //
  // Takahashi's recursion over the pattern of L, from the last supernode back (Takahashi, Fagan & Chin
  // 1973): with Y = L_RJ L_JJ⁻¹, Z_RJ = −Z_RR Y and Z_JJ = (L_JJ L_JJᵀ)⁻¹ − Yᵀ Z_RJ.
  std::vector<double> selected_inverse() const;

 private:
  struct Columns;  // of a right side, permuted

  dense::Const panel(Index s) const;
  void forward(Columns& x) const;
  void backward(Columns& x, Index first) const;
  template <class T, std::size_t N>
  void backward_by(Columns& x, Index first) const;
  dense::Matrix columns_of_inverse(Indices chosen, Indices requested, Index first) const;
  dense::Matrix inverse_among(Indices requested) const;

  std::shared_ptr<const Pattern> pattern_;
  std::vector<double> panels_;
};

}  // namespace teamslam::sparse
