#include "sensitivity.hpp"

#include <algorithm>

#include "arrow.hpp"

namespace teamslam::window {

namespace {

using se2::Point;

// Time [s] on each side of a keyframe over which its twist is averaged, where the window has it.
constexpr double TWIST_S = 0.25;

// Added to each motion's variances [m², m², rad²].
constexpr double JITTER[3] = {1e-7, 1e-7, 1e-9};

// Step [s] of the central difference by the clock's offset: of the size of offsets that matter.
constexpr double LATE_S = 0.2;

using Shifts = std::array<double, BIASES>;  // a number's derivative by each bias

// Range or bearing of a measurement: ∂h by the pose's error and by the landmark, its variance, and the
// derivative of its residual by each bias at fixed pose and landmark.
struct Line {
  double H[5], variance;
  Shifts shifts{};
};

// A measurement, linearised. The bearing's line is less its regression on the range's, so that both are
// independent.
struct Sight {
  std::size_t keyframe, landmark;
  Line range, bearing;
};

// The path and the landmarks of a window, of the sensor.
struct Solution {
  std::vector<Pose<double>> path;
  std::vector<Point<double>> landmarks;
};

// Derivative of a solution by each bias, a column each: errors ξ of the poses, shifts of the landmarks.
struct Response {
  dense::Matrix path, landmarks;
  Fault fault = Fault::NONE;
};

// The twist (forward, left, turn per second) at each pose: that of the motion from TWIST_S before to
// TWIST_S after. Both sides have one weight, so that the pose's own error has none.
std::vector<se2::Motion> twists_of(const std::vector<Pose<double>>& path, std::span<const WindowMotion> motions) {
  std::vector<se2::Motion> found(path.size());
  for (std::size_t k = 0; k < path.size(); k++) {
    std::size_t first = k + 1, last = k;  // the motions between them; pose k is the end of motion k
    double before = 0.0, after = 0.0;
    while (first > 0 && before < TWIST_S) before += motions[--first].seconds;
    while (last + 1 < path.size() && after < TWIST_S) after += motions[++last].seconds;
    if (!(before + after > 0.0)) continue;
    const auto [forward, left, turn] = se2::logarithm(se2::between(first ? path[first - 1] : Pose<double>{}, path[last]));
    const double rate = 1.0 / (before + after);
    found[k] = {rate * forward, rate * left, rate * turn};
  }
  return found;
}

// Linearises a measurement that was made `delay` [s] before its stamp, at pose ∘ Exp(−delay · twist).
Sight sight_of(const WindowMeasurement& z, std::size_t landmark, const Pose<double>& stamped, const Point<double>& at,
               const Noise& noise, const se2::Motion& twist, double delay) {
  Pose<double> pose = stamped, since{};
  if (delay != 0.0) {
    since = se2::exponential({delay * twist.forward, delay * twist.left, delay * twist.turn});
    pose = se2::compose(stamped, se2::inverse(since));
  }
  const auto [dx, dy, d, direction] = models::line_to(pose, at.x, at.y);
  const auto of_pose = models::pose_jacobian(d, direction - pose.heading);
  const auto of_landmark = models::landmark_jacobian(d, direction);
  const double range_variance = noise.range_variance + noise.range_per_m2 * d * d;
  Sight sight{z.keyframe, landmark, {{}, range_variance}, {{}, noise.bearing_variance}};
  const auto set = [](Line& line, const std::array<double, 3>& by_pose, const std::array<double, 2>& by_landmark) {
    std::copy(by_pose.begin(), by_pose.end(), line.H);
    std::copy(by_landmark.begin(), by_landmark.end(), line.H + 3);
  };
  set(sight.range, of_pose[0], of_landmark[0]);
  set(sight.bearing, of_pose[1], of_landmark[1]);
  double slope = 0.0;  // of the regression
  if (z.claim.is_made()) {
    slope = z.claim.rb / z.claim.rr;
    sight.range.variance = z.claim.rr;
    sight.bearing.variance = z.claim.bb - slope * z.claim.rb;
    for (std::size_t i = 0; i < 5; i++) sight.bearing.H[i] -= slope * sight.range.H[i];
  }
  sight.range.shifts[RANGE_OFFSET] = 1.0;
  sight.range.shifts[RANGE_SCALE] = d;
  sight.bearing.shifts[BEARING] = 1.0;
  sight.bearing.shifts[RANGE_OFFSET] = -slope;
  sight.bearing.shifts[RANGE_SCALE] = -slope * d;
  for (Line* line : {&sight.range, &sight.bearing}) {
    line->shifts[CLOCK_OFFSET] = -(line->H[0] * twist.forward + line->H[1] * twist.left + line->H[2] * twist.turn);
    if (delay == 0.0) continue;
    const Matrix3 Ad = se2::adjoint(since);
    const std::array<double, 3> of_pose{line->H[0], line->H[1], line->H[2]};
    for (std::size_t j = 0; j < 3; j++) line->H[j] = of_pose[0] * Ad[0][j] + of_pose[1] * Ad[1][j] + of_pose[2] * Ad[2][j];
  }
  return sight;
}

// Adds the residual h(pose, landmark) + g b of a measurement to A X = B; chain: the poses' unknowns.
void add_sight(dense::View A, dense::View B, const Sight& z, std::size_t chain) {
  const std::size_t pose = 3 * z.keyframe, landmark = chain + 2 * z.landmark;
  const std::size_t at[5] = {pose, pose + 1, pose + 2, landmark, landmark + 1};
  for (const Line* line : {&z.range, &z.bearing})
    for (std::size_t i = 0; i < 5; i++) {
      const double weighted = line->H[i] / line->variance;
      for (std::size_t j = 0; j < 5; j++) A[at[i]][at[j]] += weighted * line->H[j];
      for (std::size_t b = 0; b < BIASES; b++) B[at[i]][b] -= weighted * line->shifts[b];
    }
}

// Sums over the measurements of one landmark, given the derivatives of their residuals.
struct GivenPath {
  double A[2][2] = {}, B[2][BIASES] = {};

  // Adds ranges or bearings, of whose variance the share that is not white is one constant error,
  // eliminated by Schur's complement.
  void add(std::span<const Line* const> lines, std::span<const Shifts> shifts, double white) {
    double column[2] = {}, error[BIASES] = {}, total = 0.0;
    for (std::size_t n = 0; n < lines.size(); n++) {
      const double weight = 1.0 / (white * lines[n]->variance), *H = lines[n]->H + 3;
      total += weight;
      for (std::size_t b = 0; b < BIASES; b++) error[b] += weight * shifts[n][b];
      for (std::size_t i = 0; i < 2; i++) {
        column[i] += weight * H[i];
        for (std::size_t b = 0; b < BIASES; b++) B[i][b] -= weight * H[i] * shifts[n][b];
        for (std::size_t j = 0; j < 2; j++) A[i][j] += weight * H[i] * H[j];
      }
    }
    if (white == 1.0 || lines.empty()) return;
    const double share = 1.0 / (total + 1.0 / ((1.0 - white) * lines.back()->variance));
    for (std::size_t i = 0; i < 2; i++) {
      for (std::size_t b = 0; b < BIASES; b++) B[i][b] += share * column[i] * error[b];
      for (std::size_t j = 0; j < 2; j++) A[i][j] -= share * column[i] * column[j];
    }
  }

  Point<double> solved(std::size_t b) const {
    const double determinant = A[0][0] * A[1][1] - A[0][1] * A[1][0], x = B[0][b], y = B[1][b];
    return {(A[1][1] * x - A[0][1] * y) / determinant, (A[0][0] * y - A[1][0] * x) / determinant};
  }
};

// Adds the derivative of a residual through its pose, whose error ξ by each bias is a column.
void add_path(Shifts& shifts, const Line& line, dense::Const xi, std::size_t keyframe) {
  const double* H = line.H;
  for (std::size_t b = 0; b < BIASES; b++)
    shifts[b] += H[0] * xi[3 * keyframe][b] + H[1] * xi[3 * keyframe + 1][b] + H[2] * xi[3 * keyframe + 2][b];
}

// The derivative of a landmark that is solved along the path, given the path's derivative ξ.
GivenPath landmark_given(dense::Const xi, std::span<const Sight> sights, std::size_t landmark, const Noise& noise) {
  std::vector<const Line*> ranges, bearings;
  std::vector<Shifts> of_ranges, of_bearings;
  for (const Sight& z : sights) {
    if (z.landmark != landmark) continue;
    Shifts range = z.range.shifts, bearing = z.bearing.shifts;
    add_path(range, z.range, xi, z.keyframe);
    add_path(bearing, z.bearing, xi, z.keyframe);
    ranges.push_back(&z.range);
    bearings.push_back(&z.bearing);
    of_ranges.push_back(range);
    of_bearings.push_back(bearing);
  }
  GivenPath sums;
  sums.add(ranges, of_ranges, noise.range_white);
  sums.add(bearings, of_bearings, noise.bearing_white);
  return sums;
}

std::vector<std::uint32_t> sorted_ids(const Window& window) {
  std::vector<std::uint32_t> ids = window.particles().ids;
  std::sort(ids.begin(), ids.end());
  return ids;
}

// The poses at the keyframes, and at the window's end where the robot moved after the last of them.
std::vector<Pose<double>> path_to(const Pose<double>& end, const Window& window) {
  std::vector<Pose<double>> path = window.mean_path();
  if (window.motions().size() > path.size()) path.push_back(end);
  return path;
}

// The derivative of the solution if measurements were made `delay` before their stamps.
Response response_of(const Window& window, const Solution& at, double delay) {
  const Noise& noise = window.settings().noise;
  const std::vector<std::uint32_t> ids = sorted_ids(window);
  const std::size_t chain = 3 * at.path.size(), L = ids.size();
  dense::Matrix A(chain + 2 * L, chain + 2 * L), B(chain + 2 * L, BIASES);
  const std::vector<se2::Motion> twists = twists_of(at.path, window.motions());
  std::vector<Sight> sights;
  for (const WindowMeasurement& z : window.measurements()) {
    const std::size_t landmark = std::size_t(std::lower_bound(ids.begin(), ids.end(), z.id) - ids.begin());
    sights.push_back(
        sight_of(z, landmark, at.path[z.keyframe], at.landmarks[landmark], noise, twists[z.keyframe], delay));
  }
  for (std::size_t k = 0; k < at.path.size(); k++) {
    const WindowMotion& motion = window.motions()[k];
    const std::optional<Matrix3> metric = metric_of(motion.covariance, JITTER);
    if (!metric) return {{}, {}, Fault::NOT_POSITIVE};
    add_motion(A.view(), B.view(), FORWARD_SCALE, k, k ? at.path[k - 1] : Pose<double>{}, at.path[k], *metric, motion.shift);
  }
  for (const Sight& z : sights) add_sight(A.view(), B.view(), z, chain);
  if (const Fault fault = solve_arrow(A, B.view(), at.path.size()); fault != Fault::NONE) return {{}, {}, fault};
  dense::Matrix landmarks(2 * L, BIASES);
  for (std::size_t landmark = 0; landmark < L; landmark++) {
    const GivenPath sums = landmark_given(B, sights, landmark, noise);
    for (std::size_t b = 0; b < BIASES; b++) {
      const auto [x, y] = sums.solved(b);
      landmarks[2 * landmark][b] = x;
      landmarks[2 * landmark + 1][b] = y;
    }
  }
  return {std::move(B), std::move(landmarks)};
}

// The solution with a bias larger by `by`.
Solution displaced(const Solution& at, const Response& response, Bias bias, double by) {
  Solution moved = at;
  for (std::size_t k = 0; k < at.path.size(); k++) {
    const auto xi = [&](std::size_t i) { return by * response.path[3 * k + i][bias]; };
    moved.path[k] = se2::compose(at.path[k], se2::exponential({xi(0), xi(1), xi(2)}));
  }
  for (std::size_t l = 0; l < at.landmarks.size(); l++) {
    moved.landmarks[l].x += by * response.landmarks[2 * l][bias];
    moved.landmarks[l].y += by * response.landmarks[2 * l + 1][bias];
  }
  return moved;
}

// The derivative by one bias as a row over (end pose, pose nodes, landmarks), in the base's frame.
void set_row(double* row, const Solution& at, const Response& response, Bias bias, std::span<const std::size_t> nodes,
             const se2::Mount& mount) {
  const auto set_pose = [&](double* to, std::size_t k) {
    const auto [s, c] = elementary::sin_cos(at.path[k].heading);
    const double x = response.path[3 * k][bias], y = response.path[3 * k + 1][bias];
    const Pose<double> shift{c * x - s * y, s * x + c * y, response.path[3 * k + 2][bias]};
    const auto [dx, dy, turn] = mount.is_mounted() ? mount.base_shift(shift, at.path[k]) : shift;
    to[0] = dx;
    to[1] = dy;
    to[2] = turn;
  };
  if (!at.path.empty()) set_pose(row, at.path.size() - 1);
  for (std::size_t k = 0; k < nodes.size(); k++) set_pose(row + 3 + 3 * k, nodes[k]);
  for (std::size_t l = 0; l < at.landmarks.size(); l++) {
    const Point<double> shift{response.landmarks[2 * l][bias], response.landmarks[2 * l + 1][bias]};
    const auto [x, y] = mount.is_mounted() ? mount.base_vector(shift) : shift;
    row[3 + 3 * nodes.size() + 2 * l] = x + 0.0;  // a zero is positive
    row[3 + 3 * nodes.size() + 2 * l + 1] = y + 0.0;
  }
}

}  // namespace

Sensitivity Sensitivity::rounded() && {
  for (dense::Matrix* each : {&rows, &curvature})
    for (std::size_t i = 0; i < each->rows(); i++)
      for (std::size_t j = 0; j < each->columns(); j++) (*each)[i][j] = double(float((*each)[i][j]));
  return std::move(*this);
}

Sensitivity sensitivity_of(const Window& window, std::span<const double> mean, bool with_nodes) {
  window.check_of_sensor();
  const se2::Mount& mount = window.settings().mount;
  const se2::Mount away = mount.inverse();
  const std::span<const std::size_t> nodes = with_nodes ? window.nodes() : std::span<const std::size_t>();
  const std::size_t first = 3 + 3 * nodes.size();
  const Pose<double> end{mean[0], mean[1], mean[2]};
  Solution at{path_to(mount.is_mounted() ? away.base_pose(end) : end, window), {}};
  for (std::size_t i = first; i < mean.size(); i += 2) {
    const Point<double> landmark{mean[i], mean[i + 1]};
    at.landmarks.push_back(mount.is_mounted() ? away.base_point(landmark) : landmark);
  }
  const Response response = response_of(window, at, 0.0);
  if (response.fault != Fault::NONE) return {{}, {}, response.fault};
  Sensitivity found{dense::Matrix(BIASES, mean.size()), dense::Matrix(BIASES, mean.size())};
  for (std::size_t b = 0; b < BIASES; b++) set_row(found.rows[b], at, response, Bias(b), nodes, mount);
  if (!with_nodes) return found;
  dense::Matrix rows(2, mean.size());  // later, earlier
  for (std::size_t side = 0; side < 2; side++) {
    const double by = side ? -LATE_S : LATE_S;
    const Solution there = displaced(at, response, CLOCK_OFFSET, by);
    const Response changed = response_of(window, there, by);
    if (changed.fault != Fault::NONE) return {{}, {}, changed.fault};
    set_row(rows[side], there, changed, CLOCK_OFFSET, nodes, mount);
  }
  for (std::size_t i = 0; i < mean.size(); i++)
    found.curvature[CLOCK_OFFSET][i] = (rows[0][i] - rows[1][i]) / (2.0 * LATE_S);
  return found;
}

}  // namespace teamslam::window
