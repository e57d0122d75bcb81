// Hash of all results of made-up sparse systems: one number for every compiler and processor (see bits.cpp).
#include "bits.hpp"
#include "sparse.hpp"

using namespace teamslam;

namespace {

using bits::add, bits::normal, bits::uniform;

// Every second system is dense enough for a panel that is factored by blocks.
void run_sparse(int number) {
  const sparse::Index variables = number % 2 ? 160 : 1 + sparse::Index(40 * uniform());
  const double share = number % 2 ? 0.8 : 0.3 * uniform();
  std::vector<sparse::Index> sizes, start = {0}, rows;
  for (sparse::Index j = 0; j < variables; j++) {
    sizes.push_back(1 + sparse::Index(3 * uniform()));
    rows.push_back(j);
    for (sparse::Index i = j + 1; i < variables; i++)
      if (uniform() < share) rows.push_back(i);
    start.push_back(sparse::Index(rows.size()));
  }
  const auto pattern = std::make_shared<const sparse::Pattern>(sizes, start, rows);
  std::vector<double> values(pattern->numbers());
  for (double& each : values) each = normal();
  for (const sparse::Index each : pattern->diagonal()) values[each] = 2000.0 + 1000.0 * uniform();
  const sparse::Cholesky factor(pattern, values);
  std::vector<sparse::Index> some;
  for (sparse::Index k = 0; k < pattern->unknowns(); k += 1 + number % 3) some.push_back(pattern->unknowns() - 1 - k);
  for (const std::size_t columns : {1, 2, 5, 70}) {
    dense::Matrix right(pattern->unknowns(), columns);
    for (std::size_t i = 0; i < right.rows(); i++)
      for (std::size_t c = 0; c < columns; c++) right[i][c] = normal();
    add(factor.solve(right).numbers());
  }
  add(factor.inverse_columns(some).numbers());
  add(factor.inverse_block(some).numbers());
  add(factor.selected_inverse());
}

}  // namespace

int main() {
  for (int number = 0; number < 40; number++) run_sparse(number);
  bits::print();
}
