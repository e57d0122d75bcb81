#include "gaussian.hpp"

#include <cmath>

#include "elementary.hpp"

namespace teamslam::gaussian {

Fault fault_of(dense::Const P, std::span<double> sigmas) {
  assert(P.rows == P.columns && sigmas.size() == P.rows);
  if (!dense::is_finite(P)) return Fault::NOT_FINITE;
  for (std::size_t i = 0; i < P.rows; i++) {
    if (!(P[i][i] > 0.0)) return Fault::NOT_POSITIVE;
    sigmas[i] = pack::sqrt(P[i][i]);
  }
  for (std::size_t i = 0; i < P.rows; i++)
    for (std::size_t j = 0; j < i; j++)
      if (std::fabs(P[i][j] - P[j][i]) > 1e-9 * sigmas[i] * sigmas[j]) return Fault::NOT_SYMMETRIC;
  return Fault::NONE;
}

Factor factor_or_fault(dense::Const P) {
  std::vector<double> sigmas(P.rows);
  if (const Fault fault = fault_of(P, sigmas); fault != Fault::NONE) return {{}, fault};
  std::optional<dense::Matrix> L = dense::cholesky(P);
  if (!L) return {{}, Fault::NOT_POSITIVE};
  for (std::size_t i = 0; i < P.rows; i++) {
    const double pivot = (*L)[i][i] / sigmas[i];
    if (pivot * pivot <= double(P.rows) * elementary::EPSILON) return {{}, Fault::NOT_POSITIVE};
  }
  return {std::move(*L), Fault::NONE};
}

}  // namespace teamslam::gaussian
