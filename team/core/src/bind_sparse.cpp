// Bindings of the sparse Cholesky factorisation.
#include "binding.hpp"
#include "sparse.hpp"

namespace teamslam::binding {

using sparse::Cholesky, sparse::Pattern;

namespace {

using IndexVector = std::vector<std::int64_t>;

sparse::Values values_on(const Pattern& pattern, sparse::Values values) {
  check(std::int64_t(values.size()) == pattern.numbers(), "values must be the numbers of a matrix on the pattern");
  return values;
}

sparse::Indices unknowns_of(const Cholesky& factor, sparse::Indices unknowns) {
  for (const std::int64_t each : unknowns)
    check(each >= 0 && each < factor.pattern().unknowns(), "there is no such unknown");
  return unknowns;
}

// Python's exception has the C++ one's variable as an attribute.
void translate_not_positive_definite(const std::exception_ptr& raised, void* type) {
  try {
    std::rethrow_exception(raised);
  } catch (const sparse::NotPositiveDefinite& error) {
    nb::object made = nb::borrow(static_cast<PyObject*>(type))(error.what());
    made.attr("variable") = error.variable;
    PyErr_SetObject(static_cast<PyObject*>(type), made.ptr());
  }
}

}  // namespace

void bind_sparse(nb::module_& m) {
  nb::exception<sparse::NotPositiveDefinite> error(m, "NotPositiveDefiniteError", PyExc_ValueError);
  error.attr("__doc__") = "A pivot of the factorisation is not positive: the block `variable` is undetermined.";
  error.attr("variable") = -1;
  nb::register_exception_translator(translate_not_positive_definite, error.ptr());

  nb::class_<Pattern>(m, "Pattern",
                      "The stored blocks of the lower triangle of a symmetric matrix, and their places in its factor.\n\n"
                      "sizes: unknowns of each block variable. Entry e with column_start[j] ≤ e < column_start[j + 1] is\n"
                      "block (rows[e], j), rows[e] ≥ j; the first entry of each column is its diagonal block.\n"
                      "The numbers of a matrix are one flat array: block e row by row from value_start[e] on, diagonal\n"
                      "blocks as full squares. Each property makes a new array.")
      .def(nb::init<IndexVector, IndexVector, IndexVector>(), "sizes"_a, "column_start"_a, "rows"_a,
           "Analyse a pattern: order of elimination, structure of the factor. Raises ValueError for no pattern.")
      .def_prop_ro("sizes", &Pattern::sizes, "Unknowns of each variable.")
      .def_prop_ro("offset", &Pattern::offset,
                   "Index of each variable's first unknown; the last one is the number of unknowns.")
      .def_prop_ro("column_start", &Pattern::column_start,
                   "Index of each column's first entry; the last one is the number of entries.")
      .def_prop_ro("rows", &Pattern::rows, "Row of each entry.")
      .def_prop_ro("columns", &Pattern::columns, "Column of each entry.")
      .def_prop_ro("value_start", &Pattern::value_start,
                   "Index of each entry's first number; the last one is the total length.")
      .def_prop_ro("diagonal", &Pattern::diagonal, "Indices of the diagonal among the numbers of a matrix.")
      .def_prop_ro("panels",
                   [](const Pattern& p) {
                     IndexVector widths, heights;
                     for (std::int64_t s = 0; s < p.supernodes().count(); s++) {
                       widths.push_back(p.supernodes().width(s));
                       heights.push_back(p.supernodes().height(s));
                     }
                     return std::tuple(std::move(widths), std::move(heights));
                   },
                   "Number of columns and of rows of each dense panel of the factor.")
      .def_prop_ro("has_big_panel", &Pattern::has_big_panel, "Whether a panel is factorised by blocks.")
      .def("block",
           [](const Pattern& p, sparse::Values values, std::int64_t row, std::int64_t column) {
             check(row >= 0 && row < p.variables() && column >= 0 && column < p.variables(), "there is no such variable");
             return p.block(values_on(p, values), row, column);
           },
           "values"_a, "row"_a, "column"_a,
           "Block (row, column) of a symmetric matrix on this pattern; zero where none is stored.")
      .def("quadratic",
           [](const Pattern& p, sparse::Values values, sparse::Values x) {
             check(std::int64_t(x.size()) == p.unknowns(), "x must have a number for each unknown");
             return p.quadratic(values_on(p, values), x);
           },
           "values"_a, "x"_a, "Compute xᵀ A x of a matrix on this pattern.");

  nb::class_<Cholesky>(m, "Cholesky", "The Cholesky factor L of a matrix on a pattern: L Lᵀ = A, permuted. Its numbers are finite.")
      .def("__init__",
           [](Cholesky* self, std::shared_ptr<Pattern> pattern, sparse::Values values) {
             values_on(*pattern, values);
             new (self) Cholesky(std::move(pattern), values);
           },
           "pattern"_a, "values"_a,
           "Factorise A. Raises NotPositiveDefiniteError, which names the variable of the pivot; a pivot that is\n"
           "rounding noise of its diagonal entry counts as zero.")
      .def("solve",
           [](const Cholesky& f, const Array& right) {
             check(right.ndim() == 1 || right.ndim() == 2, "right must be a vector or a matrix");
             check(std::int64_t(right.shape(0)) == f.pattern().unknowns(), "right must have a row for each unknown");
             const std::size_t columns = right.ndim() == 2 ? right.shape(1) : 1;
             return made_array(f.solve(dense::Const{right.data(), right.shape(0), columns, columns}).numbers(), axes_of(right));
           },
           "right"_a, "Solve A X = right, (n,) or (n, k).")
      .def("inverse_columns",
           [](const Cholesky& f, sparse::Indices unknowns) { return f.inverse_columns(unknowns_of(f, unknowns)); }, "unknowns"_a,
           "Compute columns of A⁻¹, (n, k): the covariance of all unknowns with some.")
      .def("inverse_block",
           [](const Cholesky& f, sparse::Indices unknowns) { return f.inverse_block(unknowns_of(f, unknowns)); }, "unknowns"_a,
           "Compute A⁻¹ between some unknowns, (k, k): their joint covariance, exactly symmetric.")
      .def("selected_inverse", &Cholesky::selected_inverse,
           "Compute the entries of A⁻¹ on the pattern of A, in the layout of A's numbers, by Takahashi's recursion.");
}

}  // namespace teamslam::binding
