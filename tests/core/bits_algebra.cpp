// Hash of dense algebra, quantiles and poses: one number for every compiler and processor, as bits.cpp.
#include "bits.hpp"
#include "chi2.hpp"
#include "gaussian.hpp"
#include "se2.hpp"

using namespace teamslam;

namespace {

using bits::add, bits::centred;

void add(dense::Const a) {
  for (std::size_t i = 0; i < a.rows; i++)
    for (std::size_t j = 0; j < a.columns; j++) add(a[i][j]);
}

dense::Matrix drawn(std::size_t rows, std::size_t columns) {
  dense::Matrix made(rows, columns);
  for (std::size_t i = 0; i < rows; i++)
    for (std::size_t j = 0; j < columns; j++) made[i][j] = centred();
  return made;
}

void run_matrices(std::size_t n) {
  const dense::Matrix A = drawn(n, n), wide = drawn(n, 2 * n + 3);
  add(dense::product(A, wide));
  for (const double x : dense::product(A, std::span<const double>(wide[0], n))) add(x);
  add(dense::inner({A[0], n}, {wide[0], n}));
  const gaussian::Factor found = gaussian::factor_or_fault(dense::product(wide, dense::transposed(wide)));
  add(double(found.fault));
  add(found.L);
  add(dense::inverse_from_factor(found.L));
  for (const std::size_t many : {std::size_t{1}, n + 2}) {
    dense::Matrix left(A), right = drawn(n, many);
    dense::solve_lower(found.L, right.view());
    add(right);
    dense::solve_upper(found.L, right.view());
    add(right);
    add(double(dense::solve(left.view(), right.view())));
    add(right);
  }
}

void add(const se2::Pose<double>& pose) {
  add(pose.x);
  add(pose.y);
  add(pose.heading);
}

}  // namespace

int main() {
  for (const std::size_t n : {1, 3, 8, 31, 32, 45, 70, 133}) run_matrices(n);
  for (int k = 0; k < 2000; k++) {
    const se2::Pose<double> a{9.0 * centred(), centred(), 7.0 * centred()}, b{centred(), centred(), 1e-3 * centred()};
    add(se2::between(a, se2::compose(se2::inverse(b), a)));
    add(se2::exponential(se2::logarithm(k % 2 ? a : b)));
    add(se2::transformed(a, {b.x, b.y}).x);
    const double below = 0.5 + centred(), dof = 1.0 + 900.0 * (0.5 + centred());
    if (below > 0.0) add(chi2::quantile(below, 1.0 - below, dof));
    const dense::Matrix A = drawn(3, 3);
    add(gaussian::curved(a.heading, dense::product(A, dense::transposed(A))));
  }
  bits::print();
}
