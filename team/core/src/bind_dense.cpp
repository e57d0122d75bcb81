// Bindings of dense algebra: matrices, vectors and stacks of matrices, as in NumPy.
#include "binding.hpp"
#include "chi2.hpp"
#include "dense.hpp"
#include "gaussian.hpp"

namespace teamslam::binding {

namespace {

[[noreturn]] void fail(const char* why) {  // numpy.linalg.LinAlgError
  PyErr_SetString(nb::module_::import_("numpy.linalg").attr("LinAlgError").ptr(), why);
  throw nb::python_error();
}

std::string text_of(const Axes& axes) {
  std::string text = "(";
  for (std::size_t i = 0; i < axes.size(); i++) text += (i ? ", " : "") + std::to_string(axes[i]);
  return text + (axes.size() == 1 ? ",)" : ")");
}

std::span<const std::size_t> without(const Axes& axes, std::size_t last) { return {axes.data(), axes.size() - last}; }

dense::Const square(const Array& matrix) {
  check(matrix.ndim() == 2 && matrix.shape(0) == matrix.shape(1), "the matrix must be square");
  return {matrix.data(), matrix.shape(0), matrix.shape(0), matrix.shape(0)};
}

// A vector or a matrix, as a matrix of one or more columns of n rows.
dense::Matrix columns_of(const Array& values, std::size_t n) {
  check(values.ndim() == 1 || values.ndim() == 2, "the right-hand side must be a vector or a matrix");
  check(values.shape(0) == n, "the right-hand side must have as many rows as the matrix");
  const std::size_t many = values.ndim() == 2 ? values.shape(1) : 1;
  return dense::Matrix(dense::Const{values.data(), n, many, many});
}

MadeArray product(const Array& a, const Array& b) {
  Axes axes = axes_of(a);
  const Axes of_b = axes_of(b);
  if (axes.empty() || of_b.empty() || axes.back() != of_b[of_b.size() == 1 ? 0 : of_b.size() - 2])
    throw nb::value_error(("no product of the shapes " + text_of(axes) + " and " + text_of(of_b)).c_str());
  const std::size_t k = axes.back();
  const std::span<const double> of_row(b.data(), b.size());
  if (of_b.size() == 1 && axes.size() == 1) return made_array({dense::inner({a.data(), k}, of_row)}, {});
  const bool is_row = axes.size() == 1;
  if (of_b.size() <= 2) {
    axes.pop_back();
    const dense::Const rows{a.data(), product_of(axes), k, k};
    if (of_b.size() == 1) return made_array(dense::product(rows, of_row), axes);
    axes.push_back(of_b[1]);
    return made_array(dense::product(rows, dense::Const{b.data(), k, of_b[1], of_b[1]}).numbers(), axes);
  }
  const std::size_t n = is_row ? 1 : axes[axes.size() - 2], m = of_b.back();
  axes.resize(is_row ? 0 : axes.size() - 2);
  const Broadcast stack(axes, without(of_b, 2));
  std::vector<double> c(stack.left.size() * n * m);
  for (std::size_t s = 0; s < stack.left.size(); s++)
    for (std::size_t i = 0; i < n; i++)
      for (std::size_t p = 0; p < k; p++) {
        const double factor = a.data()[(stack.left[s] * n + i) * k + p];
        const double* row = b.data() + (stack.right[s] * k + p) * m;
        double* __restrict sums = &c[(s * n + i) * m];
        for (std::size_t j = 0; j < m; j++) sums[j] += factor * row[j];
      }
  axes = stack.axes;
  if (!is_row) axes.push_back(n);
  axes.push_back(m);
  return made_array(std::move(c), axes);
}

MadeArray solve(const Array& A, const Array& B) {
  const Axes of_A = axes_of(A), of_B = axes_of(B);
  const bool is_vector = of_B.size() == 1;
  check(of_A.size() >= 2 && of_A.back() == of_A[of_A.size() - 2], "the matrix must be square");
  check(!of_B.empty() && of_B[is_vector ? 0 : of_B.size() - 2] == of_A.back(),
        "the right-hand side must have as many rows as the matrix");
  const std::size_t n = of_A.back(), m = is_vector ? 1 : of_B.back();
  const Broadcast stack(without(of_A, 2), without(of_B, is_vector ? 1 : 2));
  std::vector<double> solved(stack.left.size() * n * m);
  for (std::size_t s = 0; s < stack.left.size(); s++) {
    dense::Matrix left(dense::Const{A.data() + stack.left[s] * n * n, n, n, n});
    const dense::View right{solved.data() + s * n * m, n, m, m};
    std::copy_n(B.data() + stack.right[s] * n * m, n * m, right.data);
    if (!dense::solve(left.view(), right)) fail("Singular matrix");
  }
  Axes axes = stack.axes;
  axes.push_back(n);
  if (!is_vector) axes.push_back(m);
  return made_array(std::move(solved), axes);
}

}  // namespace

void bind_dense(nb::module_& m) {
  m.def("product", product, "a"_a, "b"_a,
        "Compute A B of matrices, vectors or stacks of them, as NumPy's `matmul`.\n\n"
        "Raises ValueError unless A has as many columns as B has rows.");
  m.def("solve", solve, "A"_a, "B"_a,
        "Solve A^-1 B by elimination with partial pivoting; B is a vector, a matrix or a stack of these.\n\n"
        "Raises LinAlgError if A is singular.");
  m.def(
      "inverse_matrix",
      [](const Array& A) {
        check(A.ndim() >= 2 && A.shape(A.ndim() - 1) == A.shape(A.ndim() - 2), "the matrix must be square");
        const std::size_t n = A.shape(A.ndim() - 1), each = std::max<std::size_t>(n * n, 1);
        std::vector<double> inverses(A.size());
        for (std::size_t at = 0; at < A.size(); at += each) {
          dense::Matrix left(dense::Const{A.data() + at, n, n, n});
          const dense::View right{inverses.data() + at, n, n, n};
          for (std::size_t i = 0; i < n; i++) right[i][i] = 1.0;
          if (!dense::solve(left.view(), right)) fail("Singular matrix");
        }
        return made_array(std::move(inverses), axes_of(A));
      },
      "A"_a, "Invert a matrix or each of a stack. Raises LinAlgError if one is singular.");
  m.def(
      "cholesky",
      [](const Array& A) {
        std::optional<dense::Matrix> L = dense::cholesky(square(A));
        if (!L) fail("Matrix is not positive definite");
        return std::move(*L);
      },
      "A"_a,
      "Compute the lower L with L L^T = A from the lower triangle of A.\n\n"
      "Raises LinAlgError unless A is positive definite.");
  m.def(
      "inverse_of_factored", [](const Array& L) { return dense::inverse_from_factor(square(L)); }, "L"_a,
      "Compute (L L^T)^-1 of a lower triangular L, exactly symmetric.");
  m.def(
      "forward",
      [](const Array& L, const Array& B) {
        const dense::Const lower = square(L);
        dense::Matrix right = columns_of(B, lower.rows);
        dense::solve_lower(lower, right.view());
        return made_array(std::move(right).numbers(), axes_of(B));
      },
      "L"_a, "B"_a, "Compute L^-1 B of a lower triangular L; B is a vector or a matrix.");
  m.def(
      "solve_factored",
      [](const Array& L, const Array& B) {
        const dense::Const lower = square(L);
        dense::Matrix right = columns_of(B, lower.rows);
        dense::solve_lower(lower, right.view());
        dense::solve_upper(lower, right.view());
        return made_array(std::move(right).numbers(), axes_of(B));
      },
      "L"_a, "B"_a, "Compute (L L^T)^-1 B of a lower triangular L; B is a vector or a matrix.");
  m.def(
      "factor_or_fault",
      [](const Array& P) {
        gaussian::Factor found = gaussian::factor_or_fault(square(P));
        return std::tuple(std::move(found.L), int(found.fault));
      },
      "P"_a,
      "Factor a covariance: lower L with L L^T = P, and 0; or an empty matrix, and the index in "
      "teamslam.team.estimation.gaussian.FAULTS of why there is none.");
  m.def(
      "spread_of",
      [](const Array& P, const nb::ndarray<const bool, nb::ndim<1>, nb::c_contig, nb::device::cpu>& headings)
          -> std::optional<std::tuple<std::array<double, 2>, std::array<double, 2>, double>> {
        check(headings.size() == square(P).rows, "headings must be (n,) of a covariance (n, n)");
        const auto found = gaussian::spread_of(square(P), {headings.data(), headings.size()});
        if (!found) return {};
        const auto& [of, turns, independent] = *found;
        return std::tuple(std::array{of.least, of.most}, std::array{turns.least, turns.most}, independent);
      },
      "P"_a, "headings"_a.noconvert(),
      "Find the (least, largest) standard deviation of coordinates and of headings, which `headings` marks, and the\n"
      "least share of a number's variance that the others leave: 0 where P is not positive definite.\n\n"
      "Returns None where a variance is not positive.");
  m.def(
      "curved_covariance",
      [](double heading, const linalg::Matrix3& P) { return gaussian::curved(heading, P); },
      "heading"_a, "covariance"_a,
      "Compute the covariance of (x, y, heading) about pose o Exp(xi) to second order; "
      "teamslam.team.estimation.gaussian.curved describes it.");
  m.def(
      "packed",
      [](const Array& P) {
        const dense::Const full = square(P);
        std::vector<double> triangle;
        triangle.reserve(full.rows * (full.rows + 1) / 2);
        for (std::size_t i = 0; i < full.rows; i++) triangle.insert(triangle.end(), full[i] + i, full[i] + full.rows);
        return triangle;
      },
      "P"_a, "Pack the upper triangle, row-major: n(n+1)/2 numbers.");
  m.def(
      "unpacked",
      [](const Numbers& triangle, std::size_t n) {
        check(n <= triangle.size() && triangle.size() == n * (n + 1) / 2, "the triangle must have n(n+1)/2 numbers");
        dense::Matrix full(n, n);
        const double* next = triangle.data();
        for (std::size_t i = 0; i < n; i++)
          for (std::size_t j = i; j < n; j++) full[i][j] = full[j][i] = *next++ + 0.0;  // a zero is positive
        return full;
      },
      "triangle"_a, "n"_a, "Expand a packed upper triangle to a symmetric n x n matrix.");
  m.def(
      "largest",
      [](const Array& values) {
        double most = 0.0;
        for (std::size_t i = 0; i < values.size(); i++) {
          const double size = pack::abs(values.data()[i]);
          if (!(size <= most)) most = size;
          if (std::isnan(most)) break;
        }
        return most;
      },
      "values"_a, "Find the largest absolute value: 0 of an empty array, NaN with a NaN.");
  m.def(
      "chi2_quantiles",
      [](double below, double above, std::vector<double> dof) {
        check(below > 0.0 && above > 0.0 && below < 1.0 && above < 1.0, "the probabilities must be between 0 and 1");
        for (double& each : dof) each = chi2::quantile(below, above, each);
        return dof;
      },
      "below"_a, "above"_a, "dof"_a,
      "Compute the values that chi-squared exceeds with the probability above = 1 - below; NaN for less than one "
      "degree of freedom.");
  m.def(
      "chi2_scale",
      [](std::span<const double> squares, std::span<const double> dof, std::span<const double> medians) -> std::optional<std::tuple<double, double>> {
        check(squares.size() == dof.size() && medians.size() == dof.size(), "each term has its degrees of freedom and median");
        const auto found = chi2::estimate_scale(squares, dof, medians);
        if (!found) return {};
        return std::tuple{found->value, found->total};
      },
      "squares"_a, "dof"_a, "medians"_a,
      "Estimate the scale s of terms s chi2(dof): the median of squares / medians, weighted by dof, and the sum of dof.\n\n"
      "medians: of chi2(dof). Terms with dof < 1 are left out; None where none is left.");
}

}  // namespace teamslam::binding
