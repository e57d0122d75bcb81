// Bindings of the sparse Cholesky factorisation.
#include <nanobind/stl/shared_ptr.h>

#include "binding.hpp"
#include "sparse.hpp"

namespace teamslam::binding {

using sparse::Cholesky, sparse::Pattern;

namespace {

using IndexArray = nb::ndarray<const std::int64_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;

std::vector<std::int64_t> indices(const IndexArray& array) { return {array.data(), array.data() + array.size()}; }

Places places(sparse::Indices indices) { return {{indices.begin(), indices.end()}}; }

sparse::Values values_on(const Pattern& pattern, const Numbers& values) {
  check(std::int64_t(values.size()) == pattern.numbers(), "values must be the numbers of a matrix on the pattern");
  return {values.data(), values.size()};
}

sparse::Indices unknowns_of(const Cholesky& factor, const IndexArray& unknowns) {
  for (std::size_t k = 0; k < unknowns.size(); k++)
    check(unknowns(k) >= 0 && unknowns(k) < factor.pattern().unknowns(), "there is no such unknown");
  return {unknowns.data(), unknowns.size()};
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
      .def("__init__",
           [](Pattern* self, const IndexArray& sizes, const IndexArray& column_start, const IndexArray& rows) {
             new (self) Pattern(indices(sizes), indices(column_start), indices(rows));
           },
           nb::arg("sizes").noconvert(), nb::arg("column_start").noconvert(), nb::arg("rows").noconvert(),
           "Analyse a pattern: order of elimination, structure of the factor. Raises ValueError for no pattern.")
      .def_prop_ro("sizes", [](const Pattern& p) { return places(p.sizes()); }, "Unknowns of each variable.")
      .def_prop_ro("offset", [](const Pattern& p) { return places(p.offset()); },
                   "Index of each variable's first unknown; the last one is the number of unknowns.")
      .def_prop_ro("column_start", [](const Pattern& p) { return places(p.column_start()); },
                   "Index of each column's first entry; the last one is the number of entries.")
      .def_prop_ro("rows", [](const Pattern& p) { return places(p.rows()); }, "Row of each entry.")
      .def_prop_ro("columns", [](const Pattern& p) { return places(p.columns()); }, "Column of each entry.")
      .def_prop_ro("value_start", [](const Pattern& p) { return places(p.value_start()); },
                   "Index of each entry's first number; the last one is the total length.")
      .def_prop_ro("diagonal", [](const Pattern& p) { return Places{p.diagonal()}; },
                   "Indices of the diagonal among the numbers of a matrix.")
      .def_prop_ro("panels",
                   [](const Pattern& p) {
                     Places widths, heights;
                     for (std::int64_t s = 0; s < p.supernodes().count(); s++) {
                       widths.numbers.push_back(p.supernodes().width(s));
                       heights.numbers.push_back(p.supernodes().height(s));
                     }
                     return std::tuple(std::move(widths), std::move(heights));
                   },
                   "Number of columns and of rows of each dense panel of the factor.")
      .def_prop_ro("has_big_panel", &Pattern::has_big_panel, "Whether a panel is factorised by blocks.")
      .def("block",
           [](const Pattern& p, const Numbers& values, std::int64_t row, std::int64_t column) {
             check(row >= 0 && row < p.variables() && column >= 0 && column < p.variables(), "there is no such variable");
             return made_matrix(p.block(values_on(p, values), row, column));
           },
           "values"_a, "row"_a, "column"_a,
           "Block (row, column) of a symmetric matrix on this pattern; zero where none is stored.")
      .def("quadratic",
           [](const Pattern& p, const Numbers& values, const Numbers& x) {
             check(std::int64_t(x.size()) == p.unknowns(), "x must have a number for each unknown");
             return p.quadratic(values_on(p, values), {x.data(), x.size()});
           },
           "values"_a, "x"_a, "Compute xᵀ A x of a matrix on this pattern.");

  nb::class_<Cholesky>(m, "Cholesky", "The Cholesky factor L of a matrix on a pattern: L Lᵀ = A, permuted. Its numbers are finite.")
      .def("__init__",
           [](Cholesky* self, std::shared_ptr<Pattern> pattern, const Numbers& values) {
             const sparse::Values numbers = values_on(*pattern, values);
             new (self) Cholesky(std::move(pattern), numbers);
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
           [](const Cholesky& f, const IndexArray& unknowns) {
             return made_matrix(f.inverse_columns(unknowns_of(f, unknowns)));
           },
           nb::arg("unknowns").noconvert(), "Compute columns of A⁻¹, (n, k): the covariance of all unknowns with some.")
      .def("inverse_block",
           [](const Cholesky& f, const IndexArray& unknowns) {
             return made_matrix(f.inverse_block(unknowns_of(f, unknowns)));
           },
           nb::arg("unknowns").noconvert(),
           "Compute A⁻¹ between some unknowns, (k, k): their joint covariance, exactly symmetric.")
      .def("selected_inverse", [](const Cholesky& f) { return made_numbers(f.selected_inverse()); },
           "Compute the entries of A⁻¹ on the pattern of A, in the layout of A's numbers, by Takahashi's recursion.");

  m.def("minimum_degree",
        [](const IndexArray& sizes, const IndexArray& column_start, const IndexArray& rows) {
          const Pattern checked(indices(sizes), indices(column_start), indices(rows));
          sparse::Elimination e = sparse::minimum_degree(checked.sizes(), checked.column_start(), checked.rows());
          return std::tuple(Places{std::move(e.order)}, Places{std::move(e.parent)}, Places{std::move(e.start)},
                            Places{std::move(e.structure)});
        },
        nb::arg("sizes").noconvert(), nb::arg("column_start").noconvert(), nb::arg("rows").noconvert(),
        "Find the elimination order of a pattern's variables by minimum degree, in postorder.\n\n"
        "Returns (order, parent, start, structure), by step of elimination: the variable; the step of the first row\n"
        "of its column, −1 at a root; its column's rows are structure[start[k] : start[k + 1]].");
}

}  // namespace teamslam::binding
