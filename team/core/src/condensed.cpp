#include "condensed.hpp"

#include <algorithm>
#include <numeric>

#include "product.hpp"

namespace teamslam::graph {

namespace {

using dense::by_columns, dense::by_rows, dense::Const, dense::Into, dense::Matrix, dense::multiply;
using Places = std::vector<std::size_t>;

constexpr std::size_t ROWS = 32;  // of a triangle that are computed together, in the cache

Matrix part(Const a, const Places& rows, const Places& columns) {
  Matrix found(rows.size(), columns.size());
  for (std::size_t i = 0; i < rows.size(); i++)
    for (std::size_t j = 0; j < columns.size(); j++) found[i][j] = a[rows[i]][columns[j]];
  return found;
}

Matrix rows_of(Const a, const Places& rows) {
  Matrix found(rows.size(), a.columns);
  for (std::size_t i = 0; i < rows.size(); i++) std::copy_n(a[rows[i]], a.columns, found[i]);
  return found;
}

Numbers part(const Numbers& x, const Places& places) {
  Numbers found;
  for (const std::size_t place : places) found.push_back(x[place]);
  return found;
}

// ½ (A + Aᵀ).
Matrix symmetric(const Matrix& a) {
  Matrix found(a.rows(), a.rows());
  for (std::size_t i = 0; i < a.rows(); i++)
    for (std::size_t j = 0; j < a.rows(); j++) found[i][j] = 0.5 * (a[i][j] + a[j][i]);
  return found;
}

// The two numbers of each landmark.
Places numbers_of(std::span<const std::size_t> landmarks) {
  Places found;
  for (const std::size_t each : landmarks) found.insert(found.end(), {2 * each, 2 * each + 1});
  return found;
}

}  // namespace

std::optional<Elimination> eliminate(Summed&& sum, const std::vector<bool>& is_eliminated) {
  Elimination found;
  for (std::size_t i = 0; i < is_eliminated.size(); i++)
    (is_eliminated[i] ? found.eliminated : found.remaining).push_back(i);
  const Places &out = found.eliminated, &left = found.remaining;
  const std::size_t n = left.size();
  if (out.empty()) {
    found.gain = Matrix(0, n);
    found.rest = std::move(sum);
    return found;
  }
  const Matrix cross = part(sum.information, out, left);
  const Numbers own = part(sum.slope, out);
  std::optional<Matrix> factor = dense::cholesky(part(sum.information, out, out));
  if (!factor) return {};
  Matrix solved(out.size(), n + 1);  // (L Lᵀ)⁻¹ (cross, own)
  for (std::size_t i = 0; i < out.size(); i++) {
    std::copy_n(cross[i], n, solved[i]);
    solved[i][n] = own[i];
  }
  dense::solve_lower(*factor, solved.view());
  dense::solve_upper(*factor, solved.view());
  Matrix lowered(n, n);
  const Const by_others = solved.view().part(0, 0, out.size(), n);
  multiply<Into::SET>(lowered.view(), by_columns(cross), by_others);
  Matrix information = part(sum.information, left, left);
  for (std::size_t i = 0; i < n; i++)
    for (std::size_t j = 0; j < n; j++) information[i][j] -= lowered[i][j];
  found.rest.information = symmetric(information);
  Numbers last(out.size());
  for (std::size_t i = 0; i < out.size(); i++) last[i] = solved[i][n];
  const Numbers fall = dense::product(dense::transposed(cross), last);
  for (std::size_t i = 0; i < n; i++) found.rest.slope.push_back(sum.slope[left[i]] - fall[i]);
  found.rest.cost = sum.cost - dense::inner(own, last);
  found.factor = std::move(*factor);
  found.gain = Matrix(by_others);
  for (std::size_t i = 0; i < out.size(); i++) {
    found.step.push_back(-last[i]);
    for (std::size_t j = 0; j < n; j++) found.gain[i][j] = -found.gain[i][j];
  }
  return found;
}

Numbers Resting::spread_among(std::span<const std::size_t> among, std::size_t size, Const A, Const B) const {
  const std::size_t n = means.size(), m = among.size();
  Places end(m);  // behind the run of neighbours that holds each place
  for (std::size_t j = m; j-- > 0;) end[j] = j + 1 < m && among[j + 1] == among[j] + 1 ? end[j + 1] : j + 1;
  Numbers made(size * (size + 1) / 2);
  Matrix rows(std::min(ROWS, m), m);
  for (std::size_t begin = 0, to = 0; begin < m; begin += ROWS) {
    const std::size_t high = std::min(ROWS, m - begin), wide = m - begin;
    const dense::View block = rows.view().part(0, 0, high, wide);
    for (std::size_t i = 0; i < high; i++) {
      const std::size_t row = among[begin + i];
      const double* from = covariance.data() + row * n - row * (row + 1) / 2;
      for (std::size_t j = begin + i; j < m; j = end[j]) std::copy_n(from + among[j], end[j] - j, block[i] + j - begin);
    }
    multiply<Into::ADD>(block, by_rows(A.part(begin, 0, high, A.columns)), B.part(0, begin, B.rows, wide),
                        {.is_upper = true});
    for (std::size_t i = 0; i < high; to += size - begin - i++) std::copy_n(block[i] + i, wide - i, made.data() + to);
  }
  return made;
}

Numbers Quadratic::difference(Values state, Indices numbers) const {
  Numbers d(at.size());
  for (std::size_t i = 0; i < d.size(); i++) {
    d[i] = state[numbers[i]] - at[i];
    if (is_heading[i]) d[i] = se2::wrapped(d[i]);
  }
  return d;
}

Quadratic::Terms Quadratic::terms(Values state, Indices numbers) const {
  const Numbers d = difference(state, numbers);
  Terms found{0.0, dense::product(information, d)};
  found.cost = cost + (2.0 * dense::inner(slope, d) + dense::inner(d, found.slope));
  for (std::size_t i = 0; i < d.size(); i++) found.slope[i] = slope[i] + found.slope[i];
  return found;
}

std::optional<Quadratic> Quadratic::woken(std::span<const std::size_t> places, Indices as_nodes) const {
  const std::size_t n = at.size();
  const Places out = numbers_of(places);
  Places left;
  for (std::size_t i = 0; i < resting.means.size(); i++)
    if (!std::binary_search(out.begin(), out.end(), i)) left.push_back(i);
  const std::size_t w = out.size(), l = left.size();
  Matrix own(w, w), cross(l, w), crossing(w, l);
  for (std::size_t j = 0; j < w; j++) {
    for (std::size_t i = 0; i < w; i++) own[i][j] = resting.variance(out[i], out[j]);
    for (std::size_t i = 0; i < l; i++) cross[i][j] = crossing[j][i] = resting.variance(left[i], out[j]);
  }
  const std::optional<Matrix> factor = dense::cholesky(own);
  if (!factor) return {};
  const Matrix precision = dense::inverse_from_factor(*factor), gain = rows_of(resting.gain, out);
  const Matrix weighted = dense::product(precision, gain);
  Quadratic made;
  made.cost = cost;
  made.nodes = nodes;
  made.nodes.insert(made.nodes.end(), as_nodes.begin(), as_nodes.end());
  made.at = at;
  for (const std::size_t i : out) made.at.push_back(resting.means[i]);
  made.is_heading = is_heading;
  made.is_heading.resize(n + w);
  made.slope = slope;
  made.slope.resize(n + w);
  Matrix gained(n, n);
  multiply<Into::SET>(gained.view(), by_columns(gain), weighted, {.is_upper = true});
  made.information = Matrix(n + w, n + w);
  for (std::size_t i = 0; i < n; i++) {
    for (std::size_t j = i; j < n; j++)
      made.information[i][j] = made.information[j][i] = information[i][j] + gained[i][j];
    for (std::size_t k = 0; k < w; k++) made.information[i][n + k] = made.information[n + k][i] = -weighted[k][i];
  }
  for (std::size_t k = 0; k < w; k++) std::copy_n(precision[k], w, made.information[n + k] + n);
  Matrix share = dense::product(cross, precision), withdrawn = share;
  for (std::size_t i = 0; i < l; i++)
    for (std::size_t k = 0; k < w; k++) withdrawn[i][k] = -share[i][k];
  made.resting = {part(resting.means, left), Matrix(l, n + w), resting.spread_among(left, l, withdrawn, crossing)};
  for (std::size_t i = 0; i < l; i++) {
    std::copy_n(resting.gain[left[i]], n, made.resting.gain[i]);
    std::copy_n(share[i], w, made.resting.gain[i] + n);
  }
  multiply<Into::ADD>(made.resting.gain.view().part(0, 0, l, n), by_rows(withdrawn), gain);
  return made;
}

void Quadratic::rest(const Quadratic* before, const Elimination& parts, std::span<const std::size_t> of_before,
                     std::span<const double> difference, std::span<const std::size_t> rests, const Numbers& points) {
  const std::size_t old = before ? before->resting.means.size() : 0, n = parts.remaining.size();
  // The numbers that are eliminated here and on which landmarks at rest depend, and of before's numbers the places
  // among these and among those that remain.
  const std::size_t total = parts.eliminated.size() + n;
  Places is_needed(total), place(total);
  for (const std::size_t at : of_before) is_needed[at] = 1;
  for (const std::size_t k : rests) is_needed[parts.eliminated[k]] = 1;
  Places chosen;
  for (std::size_t k = 0; k < parts.eliminated.size(); k++)
    if (is_needed[parts.eliminated[k]]) {
      place[parts.eliminated[k]] = chosen.size();
      chosen.push_back(k);
    }
  for (std::size_t k = 0; k < n; k++) place[parts.remaining[k]] = k;
  const std::size_t k = chosen.size(), m = rests.size();
  std::vector<bool> is_out(total);
  for (const std::size_t at : parts.eliminated) is_out[at] = true;

  Matrix on_out(old, k), made(old + m, n);
  for (std::size_t i = 0; i < old; i++)
    for (std::size_t j = 0; j < of_before.size(); j++)
      (is_out[of_before[j]] ? on_out : made)[i][place[of_before[j]]] = before->resting.gain[i][j];
  multiply<Into::ADD>(made.view().part(0, 0, old, n), by_rows(on_out), rows_of(parts.gain, chosen));
  Matrix root(parts.eliminated.size(), k);  // L⁻¹ of the chosen
  for (std::size_t j = 0; j < k; j++) root[chosen[j]][j] = 1.0;
  dense::solve_lower(parts.factor, root.view());
  Matrix among(k, k);
  multiply<Into::SET>(among.view(), by_columns(root), root);
  const Matrix spread = dense::product(on_out, among), across = dense::transposed(on_out);
  Places all(old), own;  // own: the landmarks' numbers among the chosen
  std::iota(all.begin(), all.end(), std::size_t{0});
  for (const std::size_t each : rests) own.push_back(place[parts.eliminated[each]]);

  const Numbers steps = part(parts.step, chosen);
  if (old) {
    const Numbers by_difference = dense::product(before->resting.gain, difference), by_steps = dense::product(on_out, steps);
    for (std::size_t i = 0; i < old; i++)
      resting.means.push_back(before->resting.means[i] + by_difference[i] + by_steps[i]);
    resting.covariance = before->resting.spread_among(all, old + m, spread, across);
  } else {
    resting.covariance.resize(m * (m + 1) / 2);
  }
  for (std::size_t i = 0; i < m; i++) {
    std::copy_n(parts.gain[rests[i]], n, made[old + i]);
    resting.means.push_back(points[i] + parts.step[rests[i]]);
  }
  resting.gain = std::move(made);
  const std::size_t size = old + m;
  for (std::size_t i = 0; i < size; i++) {
    double* row = resting.covariance.data() + i * size - i * (i + 1) / 2;
    for (std::size_t j = std::max(i, old); j < size; j++)
      row[j] = i < old ? spread[i][own[j - old]] : among[own[i - old]][own[j - old]];
  }
}

}  // namespace teamslam::graph
