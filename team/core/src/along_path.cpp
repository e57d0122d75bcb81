#include "along_path.hpp"

namespace teamslam::window {

using elementary::INF;
using pack::load, pack::Pack, pack::select, pack::store, pack::WIDTH;

namespace {

constexpr double SOLVED = 1e-6;  // a step of squared Mahalanobis length below it changes nothing
constexpr int STEPS = 3;

// Sums over the measurements of a landmark: cost, gradient and Hessian; what range and bearing share
// with their constant errors; and the variances of the last measurement.
template <class T>
struct Sums {
  T cost{}, gx{}, gy{}, xx{}, xy{}, yy{};
  T rx{}, ry{}, bx{}, by{}, range_sum{}, bearing_sum{}, range_weight{}, bearing_weight{}, cross{};
  T range_variance{}, bearing_variance{};
};

// A measurement of one landmark.
struct Seen {
  std::size_t keyframe;
  Reading reading;
  bool is_claimed;
};

// A landmark seen from a path: its distance and direction, and the innovations.
template <class T>
struct Sight : models::Innovation<T> {
  T distance, ex, ey;
};

template <class T>
Sight<T> sight(const se2::Pose<T>& pose, T x, T y, const Reading& z) {
  const models::Line<T> line = models::line_to(pose, x, y);
  const T off = se2::wrapped(T(z.bearing + pose.heading - line.direction));
  return {models::innovation_of(z, line.distance, off), line.distance, line.dx / line.distance, line.dy / line.distance};
}

// Adds a measurement's terms by its innovations and weights; what it shares with constant errors where
// there are such.
template <class T>
[[gnu::always_inline]] inline void add(Sums<T>& s, const Sight<T>& at, T wr, T wb, bool is_white) {
  const T distance = at.distance, ex = at.ex, ey = at.ey, of_range = at.of_range, of_bearing = at.of_bearing;
  s.cost += wr * of_range * of_range + wb * of_bearing * of_bearing;
  const T wr_r = wr * of_range, wb_b = wb * of_bearing / distance, wt = wb / (distance * distance);
  s.gx += wr_r * ex - wb_b * ey;
  s.gy += wr_r * ey + wb_b * ex;
  s.xx += wr * ex * ex + wt * ey * ey;
  s.xy += (wr - wt) * ex * ey;
  s.yy += wr * ey * ey + wt * ex * ex;
  if (is_white) return;
  s.rx += wr * ex;
  s.ry += wr * ey;
  s.bx -= wb * ey / distance;
  s.by += wb * ex / distance;
  s.range_sum += wr_r;
  s.range_weight += wr;
  s.bearing_sum += wb * of_bearing;
  s.bearing_weight += wb;
}

// Adds a measurement's terms by the covariance that it brings, with those between range and bearing.
template <class T>
void add_claim(Sums<T>& s, const Sight<T>& at, const Noise& noise) {
  const auto& [of_range, of_bearing, rr, rb, bb] = static_cast<const models::Innovation<T>&>(at);
  const T distance = at.distance, ex = at.ex, ey = at.ey;
  const T between = rb * pack::sqrt(noise.range_white * noise.bearing_white);
  const T r = noise.range_white * rr, b = noise.bearing_white * bb;
  const T determinant = r * b - between * between, wr = b / determinant, w = -between / determinant, wb = r / determinant;
  const T along = w * of_bearing, across = w * of_range;
  s.cost += 2.0 * along * of_range;
  s.gx += along * ex - across * ey / distance;
  s.gy += along * ey + across * ex / distance;
  s.xx -= 2.0 * w * ex * ey / distance;
  s.xy += w * (ex * ex - ey * ey) / distance;
  s.yy += 2.0 * w * ex * ey / distance;
  s.rx -= w * ey / distance;
  s.ry += w * ex / distance;
  s.bx += w * ex;
  s.by += w * ey;
  s.range_sum += along;
  s.bearing_sum += across;
  s.cross += w;
  add(s, at, wr, wb, noise.is_white());
}

// Subtracts the share of an eliminated error, whose sums are total and (x, y), from the landmark's.
template <class T>
void deduct(Sums<T>& s, const T& share, const T& total, const T& x, const T& y) {
  s.cost -= share * total * total;
  s.gx -= share * total * x;
  s.gy -= share * total * y;
  s.xx -= share * x * x;
  s.xy -= share * x * y;
  s.yy -= share * y * y;
}

// Eliminates the constant errors of range and bearing, one after the other, by Schur's complement.
template <class T>
void eliminate_errors(Sums<T>& s, const Noise& noise) {
  if (noise.range_white < 1.0) {
    const T constant = (1.0 - noise.range_white) * s.range_variance, share = 1.0 / (s.range_weight + 1.0 / constant);
    const T total = s.range_sum, rx = s.rx, ry = s.ry, cross = s.cross;
    deduct(s, share, total, rx, ry);
    s.bearing_sum -= share * cross * total;
    s.bx -= share * cross * rx;
    s.by -= share * cross * ry;
    s.bearing_weight -= share * cross * cross;
  }
  if (noise.bearing_white < 1.0) {
    const T constant = (1.0 - noise.bearing_white) * s.bearing_variance, share = 1.0 / (s.bearing_weight + 1.0 / constant);
    deduct(s, share, T(s.bearing_sum), T(s.bx), T(s.by));
  }
}

// Solves one landmark of some particles. pose_at: their poses at a keyframe; range_weights: as many
// as there are measurements, of the range as the first evaluation predicts it.
template <class T, class Path>
Landmark<T> solve(const Landmark<T>& start, std::span<const Seen> measurements, const Noise& noise, Path&& pose_at,
                  std::span<T> range_weights) {
  Landmark<T> best = start;
  T at_x = start.x, at_y = start.y, least = pack::all<T>(INF);
  auto goes_on = least == INF;
  const bool is_white = noise.is_white();
  const T bearing_weight = pack::all<T>(1.0 / (noise.bearing_white * noise.bearing_variance));
  for (int step = 0; step <= STEPS; step++) {
    Sums<T> s;
    s.bearing_variance = pack::all<T>(noise.bearing_variance);
    for (std::size_t k = 0; k < measurements.size(); k++) {
      const Seen& z = measurements[k];
      const Sight<T> at = sight<T>(pose_at(z.keyframe), at_x, at_y, z.reading);
      s.range_variance = at.rr;
      s.bearing_variance = at.bb;
      if (z.is_claimed) {
        add_claim(s, at, noise);
        continue;
      }
      if (step == 0) range_weights[k] = 1.0 / (noise.range_white * at.rr);
      add(s, at, range_weights[k], bearing_weight, is_white);
    }
    eliminate_errors(s, noise);
    const T determinant = s.xx * s.yy - s.xy * s.xy;
    const auto better = (s.cost < least) & (determinant > 0.0) & goes_on;
    const T step_x = (s.yy * s.gx - s.xy * s.gy) / determinant, step_y = (s.xx * s.gy - s.xy * s.gx) / determinant;
    least = select(better, s.cost, least);
    best.x = select(better, at_x, best.x);
    best.y = select(better, at_y, best.y);
    best.xx = select(better, T(s.yy / determinant), best.xx);
    best.xy = select(better, T(-s.xy / determinant), best.xy);
    best.yy = select(better, T(s.xx / determinant), best.yy);
    goes_on = better & pack::negation(step_x * s.gx + step_y * s.gy < SOLVED);
    at_x = select(goes_on, T(at_x + step_x), at_x);
    at_y = select(goes_on, T(at_y + step_y), at_y);
    if (!pack::any(goes_on)) break;
  }
  return best;
}

}  // namespace

void solve_along_paths(std::uint32_t id, std::size_t slot, const Rows& starts, const Rows& path,
                       std::span<const WindowMeasurement> measurements, const Noise& noise, Rows& solved) {
  std::vector<Seen> of_one;
  for (const WindowMeasurement& each : measurements)
    if (each.id == id)
      of_one.push_back({each.keyframe, models::reading_of(each.range, each.bearing, noise, each.claim), each.claim.is_made()});
  std::vector<Pack> range_weights(of_one.size());
  for (std::size_t at = 0; at < starts.stride(); at += WIDTH) {
    const auto row = [&](std::size_t k) { return load(starts[5 * slot + k] + at); };
    const auto pose_at = [&](std::size_t keyframe) {
      return se2::Pose<Pack>{load(path[3 * keyframe] + at), load(path[3 * keyframe + 1] + at),
                             load(path[3 * keyframe + 2] + at)};
    };
    const Landmark<Pack> found =
        solve<Pack>({row(0), row(1), row(2), row(3), row(4)}, of_one, noise, pose_at, range_weights);
    std::size_t k = 5 * slot;
    for (const Pack& each : {found.x, found.y, found.xx, found.xy, found.yy}) store(solved[k++] + at, each);
  }
}

}  // namespace teamslam::window
