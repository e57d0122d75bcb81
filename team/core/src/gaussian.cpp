#include "gaussian.hpp"

#include <cmath>

#include "se2.hpp"

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

std::optional<Spread> spread_of(dense::Const P, std::span<const bool> is_heading) {
  assert(P.rows == P.columns && is_heading.size() == P.rows);
  std::vector<double> sigmas(P.rows);
  Spread found{};
  for (std::size_t i = 0; i < P.rows; i++) {
    if (!(P[i][i] > 0.0)) return {};
    sigmas[i] = pack::sqrt(P[i][i]);
    Spread::Sigmas& of = is_heading[i] ? found.headings : found.coordinates;
    of = {pack::min(of.least, sigmas[i]), pack::max(of.most, sigmas[i])};
  }
  dense::Matrix scaled(P);
  for (std::size_t i = 0; i < P.rows; i++)
    for (std::size_t j = 0; j < P.rows; j++) scaled[i][j] = P[i][j] / sigmas[j] / sigmas[i];
  if (const std::optional<dense::Matrix> L = dense::cholesky(scaled)) {
    double least = 1.0;
    for (std::size_t i = 0; i < P.rows; i++) least = pack::min(least, (*L)[i][i]);
    found.independent = least * least;
  }
  return found;
}

dense::Matrix curved(double heading, dense::Const P) {
  const linalg::Matrix3 T = se2::tangent(heading);
  const dense::Matrix S = dense::product(dense::product(dense::transposed(T), P), T);
  const auto of_squares = [&](int i, int j) { return 0.25 * (S[2][2] * S[i][j] + 2.0 * (S[i][2] * S[j][2])); };
  dense::Matrix away(2, 2);
  away[0][0] = of_squares(1, 1);
  away[0][1] = away[1][0] = -of_squares(0, 1);
  away[1][1] = of_squares(0, 0);
  const dense::Const turn = dense::Const(T).part(0, 0, 2, 2);
  const dense::Matrix added = dense::product(dense::product(turn, away), dense::transposed(turn));
  dense::Matrix curved(P);
  for (int i = 0; i < 2; i++)
    for (int j = 0; j < 2; j++) curved[i][j] += added[i][j];
  return curved;
}

}  // namespace teamslam::gaussian
