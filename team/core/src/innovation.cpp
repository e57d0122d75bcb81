#include "innovation.hpp"

#include <memory>

namespace teamslam::window {

using pack::LANES, pack::LaneSum, pack::load, pack::Pack, pack::store, pack::WIDTH;

namespace {

// Rows of one component, a range or a bearing, of one block of LANES particles, times √w: three of
// Hₓ L, one of d, two of Hₗ, two of Σ Hₗᵀ. Before the mean is known the row of d is the innovation.
enum Row : std::size_t { MOTION = 0, DEVIATION = 3, JACOBIAN = 4, SPREAD = 6, ROWS = 8 };

// Weighted sums of a measurement: its noise, its innovations, the direction of its bearing's.
struct Sums {
  LaneSum rr, rb, bb, ranges, bearings, sines, cosines;
};

struct Known {
  std::size_t slot;
  Reading reading;
};

// Every number is written before it is read, so none is zero at first.
class Components {
 public:
  Components(std::size_t components, std::size_t stride)
      : components_(components),
        rows_(std::make_unique_for_overwrite<double[]>(components * ROWS * stride)),
        roots_(std::make_unique_for_overwrite<double[]>(stride)) {}

  // A row's lanes of a component from particle `at` on.
  double* row(std::size_t component, std::size_t row, std::size_t at) {
    return &rows_[((at / LANES * components_ + component) * ROWS + row) * LANES + at % LANES];
  }
  double* root(std::size_t at) { return &roots_[at]; }

 private:
  std::size_t components_;
  std::unique_ptr<double[]> rows_, roots_;
};

[[gnu::always_inline]] inline void add(Sums& sums, std::size_t part, const Pack& weight, const Prediction<Pack>& p) {
  sums.rr.part[part] += weight * p.rr;
  sums.rb.part[part] += weight * p.rb;
  sums.bb.part[part] += weight * p.bb;
  sums.ranges.part[part] += weight * p.of_range;
  sums.bearings.part[part] += weight * p.of_bearing;
  sums.sines.part[part] += weight * p.sine_off;
  sums.cosines.part[part] += weight * p.cosine_off;
}

void store_rows(Components& to, std::size_t k, std::size_t at, const Pack& root, const Lower3& L,
                const Landmark<Pack>& mark, const Prediction<Pack>& p) {
  const std::size_t range = 2 * k, bearing = 2 * k + 1;
  const Pack per = 1.0 / p.distance, u = root * p.u, v = root * p.v;
  store(to.row(range, MOTION, at), -u * L.l00 - v * L.l10);
  store(to.row(range, MOTION + 1, at), -v * L.l11);
  store(to.row(range, MOTION + 2, at), Pack{});
  store(to.row(bearing, MOTION, at), (v * L.l00 - u * L.l10) * per - root * L.l20);
  store(to.row(bearing, MOTION + 1, at), -u * L.l11 * per - root * L.l21);
  store(to.row(bearing, MOTION + 2, at), -root * L.l22);
  store(to.row(range, DEVIATION, at), p.of_range);
  store(to.row(bearing, DEVIATION, at), p.of_bearing);
  Pack x = root * p.ex, y = root * p.ey;
  for (const std::size_t component : {range, bearing}) {
    store(to.row(component, JACOBIAN, at), x);
    store(to.row(component, JACOBIAN + 1, at), y);
    store(to.row(component, SPREAD, at), mark.xx * x + mark.xy * y);
    store(to.row(component, SPREAD + 1, at), mark.xy * x + mark.yy * y);
    const Pack ahead = x;
    x = -y * per;
    y = ahead * per;
  }
}

// Σ w (Hₓ Q Hₓᵀ + d dᵀ) of two components; of one landmark also Σ w Hₗ Σ Hₗᵀ.
double product_of(Components& rows, std::size_t j, std::size_t k, std::size_t stride, bool is_same) {
  LaneSum sum;
  for (std::size_t at = 0; at < stride; at += WIDTH) {
    const auto product = [&](std::size_t a, std::size_t b) { return load(rows.row(j, a, at)) * load(rows.row(k, b, at)); };
    Pack& part = sum.part[at % LANES / WIDTH];
    part += (product(MOTION, MOTION) + product(MOTION + 1, MOTION + 1) + product(MOTION + 2, MOTION + 2)) +
            product(DEVIATION, DEVIATION);
    if (is_same) part += product(JACOBIAN, SPREAD) + product(JACOBIAN + 1, SPREAD + 1);
  }
  return sum.value();
}

}  // namespace

Innovation innovation_of(const Particles& particles, const Motion& motion, const Lower3& L,
                         std::span<const std::size_t> slots, std::span<const Reading> readings) {
  std::vector<Known> known;
  for (std::size_t k = 0; k < slots.size(); k++)
    if (slots[k] < particles.landmarks()) known.push_back({slots[k], readings[k]});
  const std::size_t n = known.size(), m = 2 * n, stride = particles.stride();
  Innovation found;
  if (!n) return found;
  Components rows(m, stride);
  std::vector<Sums> sums(n);
  const auto of_turn = elementary::sin_cos(motion.turn);
  for (std::size_t at = 0; at < stride; at += WIDTH) {
    const Pack weight = elementary::exp(load(&particles.log_weights[at])), root = pack::sqrt(weight);
    store(rows.root(at), root);
    const Directed<Pack> pose = se2::driven(particles.pose_at(at), motion, of_turn);
    for (std::size_t k = 0; k < n; k++) {
      const Landmark<Pack> mark = particles.landmark(known[k].slot, at);
      const Prediction<Pack> p = predict(pose, mark, known[k].reading);
      store_rows(rows, k, at, root, L, mark, p);
      add(sums[k], at % LANES / WIDTH, weight, p);
    }
  }
  std::vector<double>&error = found.error, &S = found.S;
  error.resize(m);
  S.resize(m * m);
  for (std::size_t k = 0; k < n; k++) {
    const std::size_t r = 2 * k, b = r + 1;
    const bool is_point = known[k].reading.is_point;
    S[r * m + r] = sums[k].rr.value();
    S[b * m + r] = sums[k].rb.value();
    S[b * m + b] = sums[k].bb.value();
    error[r] = sums[k].ranges.value();
    // The mean of the innovations is on the circle; they lie near zero, where it is well defined.
    error[b] = is_point ? sums[k].bearings.value() : elementary::atan2(sums[k].sines.value(), sums[k].cosines.value());
    for (std::size_t at = 0; at < stride; at += WIDTH) {
      double *range = rows.row(r, DEVIATION, at), *bearing = rows.row(b, DEVIATION, at);
      const Pack root = load(rows.root(at)), off = load(bearing) - error[b];
      store(range, (load(range) - error[r]) * root);
      store(bearing, (is_point ? off : se2::wrapped(off)) * root);
    }
  }
  for (std::size_t j = 0; j < m; j++)
    for (std::size_t k = 0; k <= j; k++) {
      S[j * m + k] += product_of(rows, j, k, stride, known[j / 2].slot == known[k / 2].slot);
      S[k * m + j] = S[j * m + k];
    }
  found.squared = linalg::normalised_square(error, S);
  return found;
}

}  // namespace teamslam::window
