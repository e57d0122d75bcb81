#include "own_map.hpp"

#include <algorithm>
#include <numeric>

namespace teamslam::maps {

namespace {

using dense::Const, dense::Matrix, dense::View;
using Numbers = std::vector<double>;
using Places = std::vector<std::size_t>;

constexpr int ITERATIONS = 3;  // of the EKF update

// The constraints of k landmarks, linearised at the result of the iterations.
//
// sine, cosine: of θ; lever: ∂(R bₗ)/∂θ, two numbers each; multiplier z = S⁻¹ y of the innovation y with
// covariance S = H P Hᵀ, and S⁻¹. The state moves by −P Hᵀ z, its covariance by −P Hᵀ S⁻¹ H P.
struct Constraints {
  double sine = 0.0, cosine = 1.0;
  Numbers lever, multiplier;
  Matrix inverse;
};

Numbers part(std::span<const double> x, const Places& places) {
  Numbers found(places.size());
  for (std::size_t i = 0; i < places.size(); i++) found[i] = x[places[i]];
  return found;
}

Matrix part(Const A, const Places& rows, const Places& columns) {
  Matrix found(rows.size(), columns.size());
  for (std::size_t i = 0; i < rows.size(); i++) {
    const double* from = A[rows[i]];
    double* to = found[i];
    for (std::size_t j = 0; j < columns.size(); j++) to[j] = from[columns[j]];
  }
  return found;
}

void put(View to, Const from) {
  for (std::size_t i = 0; i < from.rows; i++) std::copy(from[i], from[i] + from.columns, to[i]);
}

// cov(map, innovation): rows of the map's covariance (columns: pose, then the landmarks) times Hᵀ.
Matrix map_cross(Const P, const Numbers& lever) {
  Matrix U(P.rows, lever.size());
  for (std::size_t row = 0; row < P.rows; row++) {
    const double* from = P[row];
    double* to = U[row];
    for (std::size_t i = 0; i < lever.size(); i += 2) {
      to[i] = from[0] + lever[i] * from[2] - from[3 + i];
      to[i + 1] = from[1] + lever[i + 1] * from[2] - from[4 + i];
    }
  }
  return U;
}

// cov(submap, innovation): rows of the submap's covariance (columns: the landmarks) times Hᵀ.
Matrix submap_cross(Const P, double s, double c) {
  Matrix V(P.rows, P.columns);
  for (std::size_t row = 0; row < P.rows; row++) {
    const double* from = P[row];
    double* to = V[row];
    for (std::size_t i = 0; i < P.columns; i += 2) {
      to[i] = c * from[i] - s * from[i + 1];
      to[i + 1] = s * from[i] + c * from[i + 1];
    }
  }
  return V;
}

// mean − gain z.
Numbers moved(std::span<const double> mean, Const gain, const Numbers& z) {
  Numbers after = dense::product(gain, z);
  for (std::size_t i = 0; i < after.size(); i++) after[i] = mean[i] - after[i];
  return after;
}

// S⁻¹ of a symmetric S, exactly symmetric; none where S is not positive definite. A pivot is √p, where
// `dense::cholesky` has p/√p, which rounds differently.
std::optional<Matrix> inverse(const Matrix& S) {
  const std::size_t m = S.rows();
  Matrix U = dense::transposed(S), L(m, m);
  for (std::size_t k = 0; k < m; k++) {
    double* row = U[k];
    if (!(row[k] > 0.0)) return std::nullopt;
    row[k] = pack::sqrt(row[k]);
    for (std::size_t i = k + 1; i < m; i++) row[i] /= row[k];
    for (std::size_t i = k; i < m; i++) L[i][k] = row[i];
    for (std::size_t later = k + 1; later < m; later++) {
      const double factor = row[later];
      double* __restrict to = U[later];
      for (std::size_t i = later; i < m; i++) to[i] -= row[i] * factor;
    }
  }
  return dense::inverse_from_factor(L);
}

// Iterates the EKF update by the constraints; returns whether S is positive definite.
//
// mean: (t, θ, a₁, a₂, …); seen: (b₁, b₂, …), the same landmarks in the submap.
bool tie(const Numbers& mean, const Matrix& covariance, const Numbers& seen, const Matrix& of_seen,
         Constraints& found) {
  const std::size_t m = seen.size();
  Numbers state = mean, local = seen, y(m);
  found.lever.resize(m);
  found.multiplier.assign(m, 0.0);
  for (int iteration = 0; iteration < ITERATIONS; iteration++) {
    const auto [s, c] = elementary::sin_cos(state[2]);
    const double turn = mean[2] - state[2];
    for (std::size_t i = 0; i < m; i += 2) {
      const std::size_t j = i + 1;
      const double x = -s * local[i] - c * local[j], u = c * local[i] - s * local[j];
      found.lever[i] = x;
      found.lever[j] = u;
      y[i] = c * seen[i] - s * seen[j] + mean[0] - mean[3 + i] + x * turn;
      y[j] = s * seen[i] + c * seen[j] + mean[1] - mean[3 + j] + u * turn;
    }
    const Matrix U = map_cross(covariance, found.lever), V = submap_cross(of_seen, s, c);
    Matrix S(m, m);
    for (std::size_t i = 0; i < m; i += 2)
      for (std::size_t k = 0; k < m; k++) {
        const std::size_t j = i + 1;
        S[i][k] = (U[0][k] + found.lever[i] * U[2][k] - U[3 + i][k]) + (c * V[i][k] - s * V[j][k]);
        S[j][k] = (U[1][k] + found.lever[j] * U[2][k] - U[3 + j][k]) + (s * V[i][k] + c * V[j][k]);
      }
    std::optional<Matrix> information = inverse(S);
    if (!information) return false;
    found.sine = s;
    found.cosine = c;
    found.inverse = std::move(*information);
    found.multiplier = dense::product(found.inverse, y);
    state = moved(mean, U, found.multiplier);
    local = moved(seen, V, found.multiplier);
  }
  return true;
}

// The landmarks that a map and a submap share, without those beyond the gate, and their constraints.
//
// in_map, in_submap: their indices; place, sights: those of their numbers, in the map the pose's
// before them. mean, covariance: of the map's pose and of these landmarks. known: the number of shared
// landmarks, also beyond the gate.
struct Agreement {
  Places in_map, in_submap, place, sights;
  Numbers mean;
  Matrix covariance;
  Constraints tie;
  std::size_t known;
  Fault fault = Fault::NONE;

  // The constraint that the others contradict most, if by more than the gate.
  std::optional<std::size_t> worst(double gate) {
    const Numbers& z = tie.multiplier;
    const Matrix& A = tie.inverse;
    std::optional<std::size_t> found;
    for (std::size_t i = 0; i < z.size(); i += 2) {
      double block[4] = {A[i][i], A[i][i + 1], A[i + 1][i], A[i + 1][i + 1]}, weighted[2] = {z[i], z[i + 1]};
      if (!dense::solve({block, 2, 2, 2}, {weighted, 2, 1, 1})) {
        fault = Fault::SINGULAR;
        return std::nullopt;
      }
      const double gain = z[i] * weighted[0] + z[i + 1] * weighted[1];
      if (std::isnan(gain)) return std::nullopt;
      if (gain > gate) {
        found = i / 2;
        gate = gain;
      }
    }
    return found;
  }
};

Places numbers_of(const Places& landmarks, std::size_t first, std::size_t before) {
  Places places(before);
  std::iota(places.begin(), places.end(), std::size_t{0});
  for (const std::size_t k : landmarks) {
    places.push_back(first + 2 * k);
    places.push_back(first + 2 * k + 1);
  }
  return places;
}

Agreement agreement(const WholeMap& map, const LocalMap& submap, double gate) {
  Agreement found;
  for (std::size_t i = 0, j = 0; j < submap.ids.size(); j++) {
    while (i < map.ids.size() && map.ids[i] < submap.ids[j]) i++;
    if (i < map.ids.size() && map.ids[i] == submap.ids[j]) {
      found.in_map.push_back(i);
      found.in_submap.push_back(j);
    }
  }
  found.known = found.in_map.size();
  while (true) {
    found.place = numbers_of(found.in_map, 3, 3);
    found.sights = numbers_of(found.in_submap, submap.at(0), 0);
    found.mean = part(map.mean, found.place);
    found.covariance = part(map.covariance, found.place, found.place);
    const Matrix of_seen = part(submap.covariance, found.sights, found.sights);
    if (!tie(found.mean, found.covariance, part(submap.mean, found.sights), of_seen, found.tie)) {
      found.fault = Fault::INDEFINITE;
      return found;
    }
    const std::optional<std::size_t> worst = gate < elementary::INF ? found.worst(gate) : std::nullopt;
    if (!worst) return found;
    found.in_map.erase(found.in_map.begin() + std::ptrdiff_t(*worst));
    found.in_submap.erase(found.in_submap.begin() + std::ptrdiff_t(*worst));
  }
}

Places up_to(std::size_t n) { return numbers_of({}, 0, n); }

// (pose ∘ end pose, pose ∘ new landmarks) and its Jacobian by (pose, submap).
struct Composed {
  Numbers mean;
  Matrix jacobian;
};

Composed composed(const Numbers& pose, const Numbers& submap, const Places& fresh) {
  const auto [s, c] = elementary::sin_cos(pose[2]);
  Composed found{Numbers(3 + 2 * fresh.size()), Matrix(3 + 2 * fresh.size(), 3 + submap.size())};
  Matrix& G = found.jacobian;
  found.mean[2] = se2::wrapped(pose[2] + submap[2]);
  G[2][2] = G[2][5] = 1.0;
  for (std::size_t k = 0; k <= fresh.size(); k++) {
    const std::size_t row = k == 0 ? 0 : 1 + 2 * k, at = k == 0 ? 0 : 3 + 2 * fresh[k - 1];
    const double x = submap[at], y = submap[at + 1];
    found.mean[row] = pose[0] + (c * x - s * y);
    found.mean[row + 1] = pose[1] + (s * x + c * y);
    G[row][0] = G[row + 1][1] = 1.0;
    G[row][2] = -s * x - c * y;
    G[row + 1][2] = c * x - s * y;
    G[row][3 + at] = G[row + 1][4 + at] = c;
    G[row][4 + at] = -s;
    G[row + 1][3 + at] = s;
  }
  return found;
}

// A −= B.
void subtract(Matrix& A, const Matrix& B) {
  for (std::size_t i = 0; i < A.rows(); i++)
    for (std::size_t j = 0; j < A.columns(); j++) A[i][j] -= B[i][j];
}

// Landmarks by ascending id, and the covariance exactly symmetric.
WholeMap in_order(const std::vector<std::uint32_t>& ids, const Numbers& mean, const Matrix& P) {
  Places order = up_to(ids.size());
  std::sort(order.begin(), order.end(), [&](std::size_t a, std::size_t b) { return ids[a] < ids[b]; });
  const Places place = numbers_of(order, 3, 3);
  WholeMap sorted{{}, part(mean, place), Matrix(mean.size(), mean.size())};
  for (const std::size_t k : order) sorted.ids.push_back(ids[k]);
  for (std::size_t i = 0; i < mean.size(); i++)
    for (std::size_t j = 0; j < mean.size(); j++)
      sorted.covariance[i][j] = 0.5 * (P[place[i]][place[j]] + P[place[j]][place[i]]);
  return sorted;
}

}  // namespace

bool WholeMap::has_sound_landmarks() const {
  if (!dense::is_finite(covariance.view().part(3, 3, mean.size() - 3, mean.size() - 3))) return false;
  for (std::size_t i = 3; i < mean.size(); i += 2) {
    const double xx = covariance[i][i], xy = covariance[i][i + 1], yy = covariance[i + 1][i + 1];
    if (!(xx > 0.0 && yy > 0.0 && pack::abs(xy) < pack::sqrt(xx) * pack::sqrt(yy))) return false;
  }
  return true;
}

Fault join(const WholeMap& map, const LocalMap& submap, WholeMap& joined) {
  const Agreement found = agreement(map, submap, elementary::INF);
  if (found.fault != Fault::NONE) return found.fault;
  const std::size_t n = map.mean.size(), m = submap.mean.size(), old = n - 3;
  const Matrix U = map_cross(part(map.covariance, up_to(n), found.place), found.tie.lever);
  const Matrix V = submap_cross(part(submap.covariance, up_to(m), found.sights), found.tie.sine, found.tie.cosine);
  const Numbers state = moved(map.mean, U, found.tie.multiplier), ended = moved(submap.mean, V, found.tie.multiplier);
  // The covariance of (map, submap) after the update: P less P Hᵀ S⁻¹ H P.
  const Matrix map_gain = dense::product(U, found.tie.inverse), gain = dense::product(V, found.tie.inverse);
  const Matrix Ut = dense::transposed(U), Vt = dense::transposed(V);
  Matrix whole = map.covariance, local(submap.covariance), cross(n, m);
  subtract(whole, dense::product(map_gain, Ut));
  subtract(local, dense::product(gain, Vt));
  subtract(cross, dense::product(map_gain, Vt));
  // The new pose and the new landmarks are made of (pose, submap).
  Matrix own(3 + m, 3 + m), with_old(old, 3 + m);
  put(own.view().part(0, 0, 3, 3), whole.view().part(0, 0, 3, 3));
  put(own.view().part(3, 3, m, m), local);
  put(own.view().part(0, 3, 3, m), cross.view().part(0, 0, 3, m));
  put(own.view().part(3, 0, m, 3), dense::transposed(cross.view().part(0, 0, 3, m)));
  put(with_old.view().part(0, 0, old, 3), whole.view().part(3, 0, old, 3));
  put(with_old.view().part(0, 3, old, m), cross.view().part(3, 0, old, m));
  Places fresh;
  for (std::size_t k = 0; k < submap.ids.size(); k++)
    if (!std::binary_search(found.in_submap.begin(), found.in_submap.end(), k)) fresh.push_back(k);
  const Composed made = composed(state, ended, fresh);
  const Matrix Gt = dense::transposed(made.jacobian);
  const Matrix of_own = dense::product(dense::product(made.jacobian, own), Gt), of_old = dense::product(with_old, Gt);
  const Matrix turned = dense::transposed(of_old);
  // In the order (pose, old landmarks, new landmarks).
  const std::size_t f = 2 * fresh.size();
  Matrix P(n + f, n + f);
  put(P.view().part(3, 3, old, old), whole.view().part(3, 3, old, old));
  put(P.view().part(0, 0, 3, 3), of_own.view().part(0, 0, 3, 3));
  put(P.view().part(n, n, f, f), of_own.view().part(3, 3, f, f));
  put(P.view().part(0, n, 3, f), of_own.view().part(0, 3, 3, f));
  put(P.view().part(n, 0, f, 3), of_own.view().part(3, 0, f, 3));
  put(P.view().part(3, 0, old, 3), of_old.view().part(0, 0, old, 3));
  put(P.view().part(3, n, old, f), of_old.view().part(0, 3, old, f));
  put(P.view().part(0, 3, 3, old), turned.view().part(0, 0, 3, old));
  put(P.view().part(n, 3, f, old), turned.view().part(3, 0, f, old));
  Numbers mean(made.mean.begin(), made.mean.begin() + 3);
  mean.insert(mean.end(), state.begin() + 3, state.end());
  mean.insert(mean.end(), made.mean.begin() + 3, made.mean.end());
  std::vector<std::uint32_t> ids = map.ids;
  for (const std::size_t k : fresh) ids.push_back(submap.ids[k]);
  joined = in_order(ids, mean, P);
  return Fault::NONE;
}

TiedPose end_pose(const WholeMap& map, const LocalMap& submap, double gate) {
  const Agreement found = agreement(map, submap, gate);
  TiedPose at;
  at.known = found.known;
  at.refused = found.known - found.in_map.size();
  at.fault = found.fault;
  if (found.fault != Fault::NONE) return at;
  // (pose, end pose) after the update.
  const std::size_t m = found.sights.size();
  const Numbers& z = found.tie.multiplier;
  Matrix gain(6, m), joint(6, 6);
  put(gain.view().part(0, 0, 3, m), map_cross(found.covariance.view().part(0, 0, 3, 3 + m), found.tie.lever));
  put(gain.view().part(3, 0, 3, m),
      submap_cross(part(submap.covariance, up_to(3), found.sights), found.tie.sine, found.tie.cosine));
  Numbers before(found.mean.begin(), found.mean.begin() + 3);
  before.insert(before.end(), submap.mean.begin(), submap.mean.begin() + 3);
  const Numbers state = moved(before, gain, z);
  put(joint.view().part(0, 0, 3, 3), found.covariance.view().part(0, 0, 3, 3));
  put(joint.view().part(3, 3, 3, 3), submap.covariance.part(0, 0, 3, 3));
  for (std::size_t a = 0; a < 6; a++) {
    const Numbers row = dense::product(found.tie.inverse, std::span<const double>(gain[a], m));
    for (std::size_t b = 0; b < 6; b++)
      for (std::size_t k = 0; k < m; k++) joint[a][b] -= row[k] * gain[b][k];
  }
  // pose ∘ end pose with its Jacobian.
  const auto [s, c] = elementary::sin_cos(state[2]);
  const double x = c * state[3] - s * state[4], y = s * state[3] + c * state[4];
  const double G[3][6] = {{1.0, 0.0, -y, c, -s, 0.0}, {0.0, 1.0, x, s, c, 0.0}, {0.0, 0.0, 1.0, 0.0, 0.0, 1.0}};
  for (std::size_t a = 0; a < 3; a++)
    for (std::size_t b = 0; b <= a; b++) {
      double sum = 0.0;
      for (std::size_t i = 0; i < 6; i++)
        for (std::size_t j = 0; j < 6; j++) sum += G[a][i] * joint[i][j] * G[b][j];
      at.covariance[3 * a + b] = at.covariance[3 * b + a] = sum;
    }
  at.pose = {state[0] + x, state[1] + y, se2::wrapped(state[2] + state[5])};
  return at;
}

void correct(std::span<double> mean, View covariance, double factor, std::span<const SharedError> errors,
             Const sensitivity, Const curvature) {
  const std::size_t n = mean.size();
  Numbers bent(n), column(n);
  for (const SharedError& each : errors)
    for (std::size_t i = 0; i < n; i++) bent[i] += each.value * (each.value * curvature[each.row][i]);
  for (std::size_t i = 0; i < n; i++) mean[i] -= 0.5 * bent[i];
  for (std::size_t i = 0; i < n; i++)
    for (std::size_t j = 0; j < n; j++) covariance[i][j] = factor * covariance[i][j];
  for (const auto& [value, sigma, row] : errors) {
    const double variance = sigma * sigma;
    for (std::size_t i = 0; i < n; i++) column[i] = sensitivity[row][i] + value * curvature[row][i];
    for (std::size_t i = 0; i < n; i++) {
      mean[i] += value * column[i];
      for (std::size_t j = 0; j < n; j++) covariance[i][j] += variance * (column[i] * column[j]);
    }
  }
}

}  // namespace teamslam::maps
