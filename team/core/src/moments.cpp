#include "moments.hpp"

#include <algorithm>
#include <numeric>

namespace teamslam::window {

using pack::LANES, pack::load, pack::Pack, pack::padded, pack::store, pack::WIDTH;

namespace {

constexpr double POSE_DEGREES = 5.0;  // q + 2 of a pose's q = 3 numbers
constexpr double MOST_SQUARE = 0.1;   // Σ wᵢ² of ten particles of equal weight

// Deviations of M particles in n numbers, a row a particle, padded.
struct Deviations {
  std::size_t count, numbers, stride;
  std::vector<double> rows;

  Deviations(std::size_t count, std::size_t numbers)
      : count(count), numbers(numbers), stride(padded(numbers)), rows(count * stride) {}
  double& operator()(std::size_t i, std::size_t j) { return rows[i * stride + j]; }
  const double* row(std::size_t i) const { return &rows[i * stride]; }
};

// The lower triangle of Σ wᵢ dᵢ dᵢᵀ, row by row with the deviations' stride; each entry takes the
// particles in their order. Four rows and two packs of columns at once stay in registers.
std::vector<double> scatter(const Deviations& D, std::span<const double> weights) {
  constexpr std::size_t TALL = 4;
  const std::size_t n = D.stride;
  std::vector<double> P(n * n);
  for (std::size_t first = 0; first < D.numbers; first += TALL) {
    for (std::size_t column = 0; column < first + TALL; column += 2 * WIDTH) {
      const std::size_t next = column + WIDTH < n ? column + WIDTH : column;
      Pack sums[TALL][2] = {};
      for (std::size_t i = 0; i < D.count; i++) {
        const double* d = D.row(i);
        const Pack here = load(d + column), there = load(d + next);
        for (std::size_t r = 0; r < TALL; r++) {
          const double scaled = weights[i] * d[first + r];
          sums[r][0] += scaled * here;
          sums[r][1] += scaled * there;
        }
      }
      for (std::size_t r = 0; r < TALL; r++) {
        store(&P[(first + r) * n + column], sums[r][0]);
        store(&P[(first + r) * n + next], sums[r][next == column ? 0 : 1]);
      }
    }
  }
  return P;
}

// The mean of the landmarks' coordinates, and the deviations from it, behind p numbers of poses.
void center_landmarks(const Rows& map, std::span<const std::size_t> slots, std::span<const double> weights, std::size_t p,
                      std::vector<double>& mean, Deviations& D) {
  for (std::size_t landmark = 0; landmark < slots.size(); landmark++)
    for (std::size_t axis = 0; axis < 2; axis++) {
      const double* from = map[5 * slots[landmark] + axis];
      for (std::size_t i = 0; i < D.count; i++) D(i, p + 2 * landmark + axis) = from[i];
    }
  std::vector<double> sums(D.stride);
  for (std::size_t column = 0; column < D.stride; column += LANES) {
    Pack sum[LANES / WIDTH] = {};
    for (std::size_t i = 0; i < D.count; i++)
      for (std::size_t q = 0; q < LANES / WIDTH; q++) sum[q] += weights[i] * load(D.row(i) + column + q * WIDTH);
    for (std::size_t q = 0; q < LANES / WIDTH; q++) store(&sums[column + q * WIDTH], sum[q]);
    for (std::size_t i = 0; i < D.count; i++)
      for (std::size_t q = 0; q < LANES / WIDTH; q++) {
        double* at = &D(i, column + q * WIDTH);
        store(at, load(at) - sum[q]);
      }
  }
  std::copy_n(sums.begin() + std::ptrdiff_t(p), mean.size() - p, mean.begin() + std::ptrdiff_t(p));
}

// The mean of the poses' coordinates, headings on the circle, and the deviations from it.
void center_poses(const Rows& poses, std::span<const double> weights, std::vector<double>& mean, Deviations& D) {
  for (std::size_t first = 0; first < poses.rows(); first += 3) {
    const auto [x, y, heading] = mean_pose(poses, first, weights);
    mean[first] = x, mean[first + 1] = y, mean[first + 2] = heading;
    for (std::size_t i = 0; i < D.count; i++) {
      D(i, first) = poses[first][i] - x;
      D(i, first + 1) = poses[first + 1][i] - y;
      D(i, first + 2) = se2::wrapped(poses[first + 2][i] - heading);
    }
  }
}

// Sines and cosines of angles, padded.
struct Directions {
  std::vector<double> sines, cosines;

  explicit Directions(std::span<const double> angles) : sines(padded(angles.size())), cosines(sines.size()) {
    for (std::size_t i = 0; i < angles.size(); i++) sines[i] = elementary::near(angles[i]);
    for (std::size_t i = 0; i < sines.size(); i += WIDTH) {
      const auto [s, c] = elementary::sin_cos_near(load(&sines[i]));
      store(&sines[i], s);
      store(&cosines[i], c);
    }
  }
};

Rows pose_rows(const Rows& poses, std::size_t first) {
  Rows pose(poses.count(), 3);
  for (std::size_t k = 0; k < 3; k++) pose.set(k, poses[first + k], 1);
  return pose;
}

}  // namespace

double mean_direction(std::span<const double> angles, std::span<const double> weights) {
  const Directions of(angles);
  double sine = 0.0, cosine = 0.0;
  for (std::size_t i = 0; i < angles.size(); i++) {
    sine += weights[i] * of.sines[i];
    cosine += weights[i] * of.cosines[i];
  }
  return elementary::atan2(sine, cosine);
}

se2::Pose<double> mean_pose(const Rows& poses, std::size_t first, std::span<const double> weights) {
  const Directions of(poses.numbers(first + 2));
  const double *xs = poses[first], *ys = poses[first + 1];
  double x = 0.0, y = 0.0, sine = 0.0, cosine = 0.0;  // side by side: a sum waits for itself
  for (std::size_t i = 0; i < weights.size(); i++) {
    x += weights[i] * xs[i];
    y += weights[i] * ys[i];
    sine += weights[i] * of.sines[i];
    cosine += weights[i] * of.cosines[i];
  }
  return {x, y, elementary::atan2(sine, cosine)};
}

double sample_factor(std::span<const double> weights) {
  std::vector<double> squares(weights.size());
  for (std::size_t i = 0; i < weights.size(); i++) squares[i] = weights[i] * weights[i];
  return 1.0 / (1.0 - POSE_DEGREES * pack::min(linalg::pairwise_sum(squares), MOST_SQUARE));
}

OnGroup on_group(const Rows& poses, std::span<const double> weights) {
  const std::size_t count = poses.count(), stride = poses.stride();
  const double heading = mean_direction(poses.numbers(2), weights);
  const auto [s, c] = elementary::sin_cos(heading);
  OnGroup found{{}, Rows(count, 3)};
  std::vector<double> cotangents(stride);
  double *along = found.deviations[0], *across = found.deviations[1], *turns = found.deviations[2];
  for (std::size_t at = 0; at < stride; at += WIDTH) {
    const Pack turn = se2::wrapped(Pack(load(poses[2] + at) - heading)), a = se2::half_cotangent(turn), b = 0.5 * turn;
    const Pack x = load(poses[0] + at), y = load(poses[1] + at), ahead = c * x + s * y, left = c * y - s * x;
    store(turns + at, turn);
    store(&cotangents[at], a);
    store(along + at, a * ahead + b * left);
    store(across + at, a * left - b * ahead);
  }
  double near = 0.0, half = 0.0, x = 0.0, y = 0.0;
  for (std::size_t i = 0; i < count; i++) {
    near += weights[i] * cotangents[i];
    half += weights[i] * (0.5 * turns[i]);
    x += weights[i] * along[i];
    y += weights[i] * across[i];
  }
  const double square = near * near + half * half;
  const double ahead = (near * x - half * y) / square, left = (near * y + half * x) / square;
  for (std::size_t i = 0; i < stride; i++) {
    const double a = cotangents[i], b = 0.5 * turns[i];
    const double off_x = along[i] - (a * ahead + b * left), off_y = across[i] - (a * left - b * ahead);
    along[i] = c * off_x - s * off_y;
    across[i] = s * off_x + c * off_y;
  }
  found.mean = {c * ahead - s * left, s * ahead + c * left, heading};
  return found;
}

Gaussian moments(const Rows& poses, std::span<const double> weights, const Rows& map,
                 std::span<const std::size_t> slots, double between, bool on_se2) {
  const std::size_t count = weights.size(), p = poses.rows(), landmarks = slots.size(), n = p + 2 * landmarks;
  Gaussian found;
  found.mean.resize(n);
  Deviations D(count, n);
  center_landmarks(map, slots, weights, p, found.mean, D);
  if (!on_se2) {
    center_poses(poses, weights, found.mean, D);
  } else {
    for (std::size_t first = 0; first < p; first += 3) {
      const OnGroup pose = on_group(pose_rows(poses, first), weights);
      for (std::size_t k = 0; k < 3; k++) {
        found.mean[first + k] = pose.mean[k];
        for (std::size_t i = 0; i < count; i++) D(i, first + k) = pose.deviations[k][i];
      }
    }
  }
  std::vector<double> scaled(count);
  for (std::size_t i = 0; i < count; i++) scaled[i] = between * weights[i];
  std::vector<double> P = scatter(D, scaled);
  // A landmark's own covariance is added behind each particle's scatter: its block on the diagonal
  // is summed again.
  const std::size_t stride = D.stride;
  for (std::size_t landmark = 0; landmark < landmarks; landmark++) {
    const std::size_t j = p + 2 * landmark;
    const std::size_t own = 5 * slots[landmark] + 2;
    const double *own_xx = map[own], *own_xy = map[own + 1], *own_yy = map[own + 2];
    double xx = 0.0, xy = 0.0, yy = 0.0;
    for (std::size_t i = 0; i < count; i++) {
      const double dx = D(i, j), dy = D(i, j + 1), by_x = scaled[i] * dx, by_y = scaled[i] * dy;
      xx += by_x * dx;
      xy += by_y * dx;
      yy += by_y * dy;
      xx += weights[i] * own_xx[i];
      xy += weights[i] * own_xy[i];
      yy += weights[i] * own_yy[i];
    }
    P[j * stride + j] = xx;
    P[(j + 1) * stride + j] = xy;
    P[(j + 1) * stride + j + 1] = yy;
  }
  found.covariance.resize(n * n);
  for (std::size_t j = 0; j < n; j++)
    for (std::size_t k = 0; k <= j; k++) found.covariance[j * n + k] = found.covariance[k * n + j] = P[j * stride + k];
  return found;
}

std::vector<double> weights_of(std::span<const double> log_weights) {
  std::vector<double> weights(padded(log_weights.size()), -elementary::INF);
  std::copy(log_weights.begin(), log_weights.end(), weights.begin());
  for (std::size_t i = 0; i < weights.size(); i += WIDTH) store(&weights[i], elementary::exp(load(&weights[i])));
  weights.resize(log_weights.size());
  return weights;
}

Gaussian submap_moments(const Rows& poses, std::span<const double> log_weights, std::span<const std::uint32_t> ids,
                        const Rows& map) {
  const std::size_t n = poses.rows() + 2 * ids.size();
  const std::vector<double> weights = weights_of(log_weights);
  std::vector<std::size_t> order(ids.size());
  std::iota(order.begin(), order.end(), std::size_t{0});
  std::sort(order.begin(), order.end(), [&](std::size_t a, std::size_t b) { return ids[a] < ids[b]; });
  Gaussian found = moments(poses, weights, map, order, sample_factor(weights), true);
  for (const std::size_t slot : order) found.ids.push_back(ids[slot]);
  for (std::size_t j = 0; j < poses.rows(); j++) found.covariance[j * n + j] += POSE_JITTER[j % 3];
  found.fault = gaussian::factor_or_fault({found.covariance.data(), n, n, n}).fault;
  return found;
}

}  // namespace teamslam::window
