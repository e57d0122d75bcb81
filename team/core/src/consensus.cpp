#include "consensus.hpp"

#include <algorithm>

namespace teamslam::window {

using models::Polar;
using pack::Pack, pack::WIDTH;
using se2::Point;

namespace {

// Log odds that a landmark's accepted measurements must reach; by chance they do so in one case of a
// hundred.
constexpr double EVIDENCE = 4.605170185988092;
constexpr double JITTER[3] = {1e-6, 1e-6, 1e-8};  // added to each motion's variances [m², m², rad²]
constexpr std::size_t MOST_COMPARED = 32, MOST_SMOOTHED = 100;
constexpr double MOST_REJECTED = 0.05;
constexpr int ROUNDS = 5;                         // of classifying and smoothing; two or three suffice
constexpr int LEAST_STEPS = 2, MOST_STEPS = 10;   // of Gauss-Newton in a round
constexpr double CONVERGED = 0.1;                 // largest last step, in standard deviations

// A symmetric 2 × 2 covariance of range and bearing.
struct Covariance2 {
  double rr = 0, rb = 0, bb = 0;

  double determinant() const { return rr * bb - rb * rb; }
};

// ∂h/∂(pose, landmark): rows of range and bearing.
struct Jacobian {
  double rows[2][5];
};

Jacobian jacobian_of(const Polar& predicted, double heading) {
  const models::PoseJacobian of_pose = models::pose_jacobian(predicted.range, predicted.bearing);
  const models::LandmarkJacobian of_landmark = models::landmark_jacobian(predicted.range, heading + predicted.bearing);
  Jacobian J;
  for (std::size_t i = 0; i < 2; i++) {
    std::copy(of_pose[i].begin(), of_pose[i].end(), J.rows[i]);
    std::copy(of_landmark[i].begin(), of_landmark[i].end(), J.rows[i] + 3);
  }
  return J;
}

// J P Jᵀ.
Covariance2 spread_by(const Jacobian& J, const double (&P)[5][5]) {
  Covariance2 S;
  const auto& [range, bearing] = J.rows;
  for (std::size_t p = 0; p < 5; p++)
    for (std::size_t q = 0; q < 5; q++) {
      S.rr += range[p] * P[p][q] * range[q];
      S.rb += range[p] * P[p][q] * bearing[q];
      S.bb += bearing[p] * P[p][q] * bearing[q];
    }
  return S;
}

double log(double x) { return elementary::log(x); }
Pack log(const Pack& x) {
  double numbers[WIDTH], logs[WIDTH];
  pack::store(numbers, x);
  pack::store(logs, elementary::log_of_normal(x));
  for (std::size_t i = 0; i < WIDTH; i++)
    if (!(numbers[i] > 1e-300 && numbers[i] < 1e300)) logs[i] = elementary::log(numbers[i]);
  return pack::load(logs);
}

// log N(e; 0, S), S = (rr, rb, bb).
template <class T>
T log_density(const T& e0, const T& e1, const T& rr, const T& rb, const T& bb) {
  const T determinant = rr * bb - rb * rb;
  const T squared = (bb * e0 * e0 - 2.0 * rb * e0 * e1 + rr * e1 * e1) / determinant;
  return -0.5 * (squared + log(determinant)) - models::LOG_2_PI;
}
double log_density(double e0, double e1, const Covariance2& S) { return log_density(e0, e1, S.rr, S.rb, S.bb); }

// a_from_b of b_from_a: (T Exp ξ)⁻¹ = T⁻¹ Exp(−Ad(T) ξ).
motion::Increment reversed(const motion::Increment& motion) {
  return motion::compose({{}, motion.covariance}, motion::Step({se2::inverse(motion.mean), {}}));
}

// A measurement, and another one of its landmark: where that one places it, and the motion since then.
struct Pair {
  const Reading& z;
  const models::Landmark<double>& at;
  const motion::Increment& motion;
};

// The log p(z | the other measurement, odometry) of pairs in the lanes of a T.
//
// The landmark is where the other one places it, with its noise, and is looked at after the odometry, with
// its noise and the measurement's: S = R + Hₓ C Hₓᵀ + Hₗ Σ Hₗᵀ. number(f): f of each pair. innovation: z − h
// and its noise, of h.
template <class T, class Number, class Innovation>
T log_likelihood(Number&& number, Innovation&& innovation) {
  const auto of_motion = [&](auto f) { return number([&](const Pair& each) { return f(each.motion.mean); }); };
  const auto of_place = [&](auto f) { return number([&](const Pair& each) { return f(each.at); }); };
  const Pose<T> pose{of_motion([](const auto& x) { return x.x; }), of_motion([](const auto& x) { return x.y; }),
                     of_motion([](const auto& x) { return x.heading; })};
  const models::Line<T> line = models::line_to(pose, of_place([](const auto& at) { return at.x; }), of_place([](const auto& at) { return at.y; }));
  const T distance = line.distance, bearing = se2::wrapped(T(line.direction - pose.heading));
  const auto [s, c] = elementary::sin_cos_near(bearing);
  const auto [ey, ex] = elementary::sin_cos_near(T(pose.heading + bearing));
  const T range_by[5] = {-c, -s, T{}, ex, ey};
  const T bearing_by[5] = {s / distance, -c / distance, pack::all<T>(-1.0), -ey / distance, ex / distance};
  T S_rr{}, S_rb{}, S_bb{};
  const auto add = [&](std::size_t p, std::size_t q, const T& covariance) {
    const T of_range = range_by[p] * covariance;
    S_rr += of_range * range_by[q];
    S_rb += of_range * bearing_by[q];
    S_bb += bearing_by[p] * covariance * bearing_by[q];
  };
  for (std::size_t p = 0; p < 3; p++)
    for (std::size_t q = 0; q < 3; q++) add(p, q, number([&](const Pair& each) { return each.motion.covariance[p][q]; }));
  const T xy = of_place([](const auto& at) { return at.xy; });
  add(3, 3, of_place([](const auto& at) { return at.xx; }));
  add(3, 4, xy);
  add(4, 3, xy);
  add(4, 4, of_place([](const auto& at) { return at.yy; }));
  const auto [e0, e1, rr, rb, bb] = innovation(distance, bearing);
  return log_density(e0, e1, T(S_rr + rr), T(S_rb + rb), T(S_bb + bb));
}

std::vector<double> log_likelihoods(std::span<const Pair> pairs) {
  std::vector<double> logs(pack::padded(pairs.size()));
  for (std::size_t k = 0; k < pairs.size(); k += WIDTH) {
    const std::span<const Pair> some = pairs.subspan(k, std::min(WIDTH, pairs.size() - k));
    if (std::any_of(some.begin(), some.end(), [](const Pair& each) { return each.z.is_point; })) {
      for (std::size_t i = 0; i < some.size(); i++)
        logs[k + i] = log_likelihood<double>(
            [&](auto f) { return f(some[i]); },
            [&](double distance, double bearing) { return models::innovation_of(some[i].z, Polar{distance, bearing}); });
      continue;
    }
    const auto number = [&](auto f) {
      double lanes[WIDTH];
      for (std::size_t i = 0; i < WIDTH; i++) lanes[i] = f(some[std::min(i, some.size() - 1)]);
      return pack::load(lanes);
    };
    const auto of_reading = [&](auto f) { return number([&](const Pair& each) { return f(each.z); }); };
    const auto innovation = [&](const Pack& distance, const Pack& bearing) {
      const Pack off = se2::wrapped(Pack(of_reading([](const Reading& z) { return z.bearing; }) - bearing));
      const Pack per_m2 = of_reading([](const Reading& z) { return z.rr_per_m2; });
      return models::Innovation<Pack>{of_reading([](const Reading& z) { return z.range; }) - distance, off,
                                      of_reading([](const Reading& z) { return z.rr; }) + per_m2 * distance * distance,
                                      of_reading([](const Reading& z) { return z.rb; }), of_reading([](const Reading& z) { return z.bb; })};
    };
    pack::store(&logs[k], log_likelihood<Pack>(number, innovation));
  }
  logs.resize(pairs.size());
  return logs;
}

// Log odds that a measurement is good, for this share of outliers.
double log_odds(double share) { return elementary::log((1.0 - share) / share); }

}  // namespace

Consensus::Consensus(const Noise& sensor, double max_range, double field_of_view, double share)
    : sensor_(sensor),
      max_range_(max_range),
      field_of_view_(field_of_view),
      prior_(log_odds(share)) {}

// The log odds that a measurement is good, less its log p(z).
double Consensus::odds() const {
  const double uniform = 1.0 / (std::min(max_range_, farthest_) * field_of_view_);
  return prior_ - elementary::log(uniform);
}

void Consensus::add(const motion::Increment& motion, const Scan& scan) {
  since_ = motion::compose(since_, motion::Step(motion));
  if (scan.ids.empty()) return;
  const std::size_t b = motions_.size();
  motions_.push_back(b ? since_ : motion::Increment{});
  since_ = {};
  const motion::Step step(motions_[b]);
  std::vector<motion::Increment> from_last;
  for (motion::Increment& each : to_last_) {
    each = motion::compose(each, step);
    from_last.push_back(reversed(each));
  }
  to_last_.push_back({});
  from_last.push_back({});
  for (std::size_t k = 0; k < scan.ids.size(); k++) {
    const Reading reading = models::reading_of(scan.ranges[k], scan.bearings[k], sensor_, scan.claim(k));
    farthest_ = std::max(farthest_, reading.range);
    const models::Landmark<double> placed = models::place(Pose<double>{}, reading);
    Landmark& landmark = landmarks_[scan.ids[k]];
    const bool may_place = landmark.logs.size() < MOST_COMPARED;
    std::vector<Pair> by_others, of_others;
    for (std::size_t i = 0; i < landmark.logs.size(); i++) {
      const Measurement& other = measurements_[landmark.measurements[i]];
      by_others.push_back({reading, other.placed, to_last_[other.scan]});
      if (may_place) of_others.push_back({other.reading, placed, from_last[other.scan]});
    }
    const std::vector<double> by_each = log_likelihoods(by_others);
    for (std::size_t i = 0; i < by_each.size(); i++) landmark.logs[i].push_back(by_each[i]);
    if (may_place) {
      landmark.logs.push_back(log_likelihoods(of_others));
      landmark.logs.back().push_back(0.0);
    }
    landmark.measurements.push_back(size());
    measurements_.push_back({b, reading, placed});
  }
}

Consensus::Support Consensus::support_of(const Landmark& landmark, double odds) const {
  Support found;
  for (std::size_t i = 0; i < landmark.logs.size(); i++) {
    double total = 0.0;
    for (std::size_t j = 0; j < landmark.logs[i].size(); j++)
      if (j != i) total += std::max(0.0, landmark.logs[i][j] + odds);
    if (total > found.total) found = {i, total};
  }
  return found;
}

std::vector<bool> Consensus::agreeing() const {
  std::vector<bool> taken(size());
  const double odds = this->odds();
  for (const auto& [id, landmark] : landmarks_) {
    const auto [best, total] = support_of(landmark, odds);
    if (landmark.measurements.size() == 1) taken[landmark.measurements[0]] = accepts_lone_;
    if (!(total > EVIDENCE - prior_)) continue;
    for (std::size_t j = 0; j < landmark.measurements.size(); j++)
      taken[landmark.measurements[j]] = j == best || landmark.logs[best][j] + odds > 0.0;
  }
  return taken;
}

// Poses at the scans, the first one zero, landmarks by ascending id, and their covariance without the
// first pose; slots: the landmark of each measurement.
struct Consensus::Smoothed {
  std::vector<Pose<double>> path;
  std::vector<Matrix3> metrics;  // of the motion to each pose; none of the first
  std::vector<Point<double>> landmarks;
  std::vector<std::size_t> slots;
  dense::Matrix covariance;

  std::size_t first() const { return 3 * (path.size() - 1); }

  // The unknown of each column of `jacobian_of`; the pose's are none at the first scan.
  std::array<std::size_t, 5> places(std::size_t scan, std::size_t slot) const {
    const std::size_t pose = 3 * scan - 3, landmark = first() + 2 * slot;
    return {pose, pose + 1, pose + 2, landmark, landmark + 1};
  }

  // J P Jᵀ of a landmark seen from a scan.
  Covariance2 spread(const Jacobian& J, std::size_t scan, std::size_t slot) const {
    const std::array<std::size_t, 5> at = places(scan, slot);
    double P[5][5] = {};
    for (std::size_t p = scan ? 0 : 3; p < 5; p++)
      for (std::size_t q = scan ? 0 : 3; q < 5; q++) P[p][q] = covariance[at[p]][at[q]];
    return spread_by(J, P);
  }

  // The number of taken measurements of each landmark.
  std::vector<double> counts(const std::vector<bool>& taken) const {
    std::vector<double> found(landmarks.size());
    for (std::size_t n = 0; n < slots.size(); n++)
      if (taken[n]) found[slots[n]] += 1.0;
    return found;
  }

  // The sum of their values, by landmark.
  std::vector<double> sums(std::span<const double> values, const std::vector<bool>& taken) const {
    std::vector<double> found(landmarks.size());
    for (std::size_t n = 0; n < slots.size(); n++)
      if (taken[n]) found[slots[n]] += values[n];
    return found;
  }
};

Consensus::Smoothed Consensus::started() const {
  Smoothed window;
  window.path.push_back({});
  window.metrics.push_back({});
  for (std::size_t k = 1; k < motions_.size(); k++) {
    window.path.push_back(se2::compose(window.path[k - 1], motions_[k].mean));
    const std::optional<Matrix3> metric = metric_of(motions_[k].covariance, JITTER);
    if (metric) window.metrics.push_back(*metric);
  }
  window.slots.resize(size());
  const double odds = this->odds();
  for (const auto& [id, landmark] : landmarks_) {
    for (const std::size_t n : landmark.measurements) window.slots[n] = window.landmarks.size();
    const Measurement& best = measurements_[landmark.measurements[support_of(landmark, odds).best]];
    window.landmarks.push_back(models::located(window.path[best.scan], {best.reading.range, best.reading.bearing}));
  }
  return window;
}

bool Consensus::accept() {
  std::vector<bool> agreed = agreeing();
  bool stay = true;
  for (std::size_t n = 0; n < accepted_.size(); n++) stay = stay && (agreed[n] || !accepted_[n]);
  if (stay) std::copy(accepted_.begin(), accepted_.end(), agreed.begin());
  accepted_ = std::move(agreed);
  return stay;
}

bool Consensus::confirm() {
  const std::vector<bool> before = std::exchange(accepted_, confirmed());
  return accepted_ != before;
}

std::vector<bool> Consensus::confirmed() const {
  const std::vector<bool> taken = confirmed_by_others();
  double compared = 0.0, rejected = 0.0;
  for (const auto& [id, landmark] : landmarks_)
    for (const std::size_t n : landmark.measurements)
      if (landmark.measurements.size() > 1) compared += 1.0, rejected += taken[n] ? 0.0 : 1.0;
  if (rejected <= MOST_REJECTED * compared) return taken;
  Consensus with_share = *this;
  with_share.prior_ = log_odds(std::min(rejected / compared, 0.5));
  with_share.accepts_lone_ = false;
  return with_share.confirmed_by_others();
}

std::vector<bool> Consensus::confirmed_by_others() const {
  const std::vector<bool> agreed = agreeing();
  if (agreed.empty() || motions_.size() > MOST_SMOOTHED) return agreed;
  Smoothed window = started();
  if (window.metrics.size() < window.path.size()) return agreed;
  std::vector<bool> taken = agreed;
  std::vector<double> logs;
  for (int round = 0; round < ROUNDS; round++) {
    if (!smooth(window, taken)) return agreed;
    logs = logs_of_others(window, taken);
    std::vector<bool> before = std::exchange(taken, judged(window, logs, taken));
    if (before == taken) break;
  }
  const std::vector<bool> doubtful = misread(window, logs, taken);
  for (std::size_t n = 0; n < taken.size(); n++) taken[n] = taken[n] && !doubtful[window.slots[n]];
  return taken;
}

// Gauss-Newton steps until no unknown moves by a tenth of its standard deviation, and the covariance at
// the last one; whether the normal equations are positive definite. Away from the optimum a correct
// measurement is far from its prediction, and would be rejected: odometry of a long window starts there.
// A landmark without an accepted measurement stays where it is, with the squared reach of the sensor as
// its variance.
bool Consensus::smooth(Smoothed& window, const std::vector<bool>& taken) const {
  auto& [path, metrics, landmarks, slots, covariance] = window;
  const std::size_t first = window.first(), size = first + 2 * landmarks.size();
  const std::vector<double> counts = window.counts(taken);
  double farthest = 0.0;  // squared, in variances
  for (int step = 0; step < LEAST_STEPS || (step < MOST_STEPS && farthest > CONVERGED * CONVERGED); step++) {
    dense::Matrix A(size, size), b(size, 1);
    for (std::size_t k = 1; k < path.size(); k++) {
      const auto [x, y, turn] = se2::logarithm(se2::between(motions_[k].mean, se2::between(path[k - 1], path[k])));
      add_motion(A.view(), b.view(), 0, k - 1, path[k - 1], path[k], metrics[k], {-x, -y, -turn});
    }
    for (std::size_t n = 0; n < taken.size(); n++) {
      if (!taken[n]) continue;
      const auto& [scan, reading, placed] = measurements_[n];
      const Polar predicted = models::polar(path[scan], landmarks[slots[n]]);
      const auto [e0, e1, rr, rb, bb] = models::innovation_of(reading, predicted);
      const Jacobian J = jacobian_of(predicted, path[scan].heading);
      const double determinant = rr * bb - rb * rb;
      const Covariance2 W = rb == 0.0 ? Covariance2{1.0 / rr, 0.0, 1.0 / bb}
                                      : Covariance2{bb / determinant, -rb / determinant, rr / determinant};
      const std::array<std::size_t, 5> at = window.places(scan, slots[n]);
      for (std::size_t p = scan ? 0 : 3; p < 5; p++) {
        const auto& [range, bearing] = J.rows;
        const double r = range[p] * W.rr + bearing[p] * W.rb, b_ = range[p] * W.rb + bearing[p] * W.bb;
        b[at[p]][0] += r * e0;
        b[at[p]][0] += b_ * e1;
        for (std::size_t q = scan ? 0 : 3; q < 5; q++) {
          A[at[p]][at[q]] += r * range[q];
          A[at[p]][at[q]] += b_ * bearing[q];
        }
      }
    }
    for (std::size_t slot = 0; slot < landmarks.size(); slot++)
      if (counts[slot] == 0.0)
        for (const std::size_t i : {first + 2 * slot, first + 2 * slot + 1}) A[i][i] = 1.0 / (farthest_ * farthest_);
    const std::optional<dense::Matrix> L = dense::cholesky(A);
    if (!L) return false;
    covariance = dense::inverse_from_factor(*L);
    if (!dense::is_finite(covariance)) return false;
    const dense::Matrix x = dense::product(covariance, b);
    farthest = 0.0;
    for (std::size_t i = 0; i < size; i++) farthest = std::max(farthest, x[i][0] * x[i][0] / covariance[i][i]);
    for (std::size_t k = 1; k < path.size(); k++)
      path[k] = se2::compose(path[k], se2::exponential({x[3 * k - 3][0], x[3 * k - 2][0], x[3 * k - 1][0]}));
    for (std::size_t slot = 0; slot < landmarks.size(); slot++) {
      landmarks[slot].x += x[first + 2 * slot][0];
      landmarks[slot].y += x[first + 2 * slot + 1][0];
    }
  }
  return true;
}

// The log p(measurement | all other taken measurements, odometry), linearised at the optimum.
//
// With M = J P Jᵀ a measurement that was not taken has S = R + M; of one that was, D = R − M is the
// covariance of its residual e, and without it the residual is R D⁻¹ e with S = R D⁻¹ R. It is −∞ where
// nothing else determines the landmark.
std::vector<double> Consensus::logs_of_others(const Smoothed& window, const std::vector<bool>& taken) const {
  std::vector<double> logs;
  for (std::size_t n = 0; n < taken.size(); n++) {
    const auto& [scan, reading, placed] = measurements_[n];
    const Polar predicted = models::polar(window.path[scan], window.landmarks[window.slots[n]]);
    const auto [e0, e1, rr, rb, bb] = models::innovation_of(reading, predicted);
    const Covariance2 M = window.spread(jacobian_of(predicted, window.path[scan].heading), scan, window.slots[n]);
    const Covariance2 R{rr, rb, bb}, D{rr - M.rr, rb - M.rb, bb - M.bb};
    if (!taken[n]) {
      logs.push_back(log_density(e0, e1, {rr + M.rr, rb + M.rb, bb + M.bb}));
    } else if (D.rr > 1e-9 * rr && D.bb > 1e-9 * bb && D.determinant() > 1e-12 * R.determinant()) {
      logs.push_back(log_density(e0, e1, D) + elementary::log(D.determinant() / R.determinant()));
    } else {
      logs.push_back(-elementary::INF);
    }
  }
  return logs;
}

// The measurements with odds above even, of landmarks whose measurements have enough evidence.
//
// Each of k measurements is predicted by the k − 1 others, so their odds are weighted by (k − 1)/k. A
// landmark that has lost all its measurements stays out; the only measurement of one stays in.
std::vector<bool> Consensus::judged(const Smoothed& window, std::span<const double> logs,
                                    const std::vector<bool>& before) const {
  const double odds = this->odds();
  const std::vector<double> earlier = window.counts(before), all = window.counts(std::vector<bool>(logs.size(), true));
  std::vector<bool> taken(logs.size());
  std::vector<double> of_each;
  for (std::size_t n = 0; n < logs.size(); n++) {
    of_each.push_back(logs[n] + odds);
    taken[n] = of_each[n] > 0.0 && earlier[window.slots[n]] > 0.0;
  }
  const std::vector<double> count = window.counts(taken), total = window.sums(of_each, taken);
  for (std::size_t n = 0; n < logs.size(); n++) {
    const std::size_t l = window.slots[n];
    const bool has_evidence = count[l] >= 2.0 && prior_ + total[l] * (count[l] - 1.0) / count[l] > EVIDENCE;
    taken[n] = all[l] == 1.0 ? accepts_lone_ : taken[n] && has_evidence;
  }
  return taken;
}

// The landmarks that may be another landmark of the window under a wrong identity.
//
// If k measurements that agree are all of landmark m, read k times as l, each has the probability
// ε/(L − 1) p(z | m) for the L identities in the window, against (1 − ε) p(z | l) of its own, the first
// of which is uniform. They are accepted where the odds for l reach EVIDENCE.
std::vector<bool> Consensus::misread(const Smoothed& window, std::span<const double> logs,
                                     const std::vector<bool>& taken) const {
  const std::size_t L = window.landmarks.size();
  const std::vector<double> count = window.counts(taken), total = window.sums(logs, taken);
  const double own_name = prior_ + elementary::log(double(std::max<std::size_t>(L - 1, 1)));
  std::vector<bool> doubtful(L);
  for (std::size_t m = 0; m < L; m++) {
    if (count[m] < 2.0) continue;
    std::vector<double> predicted(L);
    for (std::size_t n = 0; n < taken.size(); n++) {
      const auto& [scan, reading, placed] = measurements_[n];
      const std::size_t l = window.slots[n];
      if (!taken[n] || l == m || count[l] > count[m]) continue;
      const Polar as_other = models::polar(window.path[scan], window.landmarks[m]);
      const auto [e0, e1, rr, rb, bb] = models::innovation_of(reading, as_other);
      const Covariance2 M = window.spread(jacobian_of(as_other, window.path[scan].heading), scan, m);
      predicted[l] += log_density(e0, e1, {rr + M.rr, rb + M.rb, bb + M.bb});
    }
    for (std::size_t l = 0; l < L; l++) {
      if (l == m || count[l] == 0.0 || count[l] > count[m]) continue;
      const bool is_alone = count[l] == 1.0;
      const double by_others = is_alone ? 0.0 : total[l] * (count[l] - 1.0) / count[l];
      const double evidence = count[l] * own_name + by_others - (odds() - prior_) - predicted[l];
      if (evidence < (is_alone ? 0.0 : EVIDENCE)) doubtful[l] = true;
    }
  }
  return doubtful;
}

}  // namespace teamslam::window
