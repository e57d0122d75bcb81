#include "particles.hpp"

#include <algorithm>

namespace teamslam::window {

using elementary::INF;
using pack::load, pack::Pack, pack::store, pack::WIDTH;

namespace {

// Σ exp(factor · log w), in the particles' order; `terms` gets its terms.
double sum_of_weights(std::span<const double> log_weights, double factor, std::vector<double>& terms) {
  const std::size_t count = log_weights.size();
  terms.assign(pack::padded(count), -INF);
  std::copy(log_weights.begin(), log_weights.end(), terms.begin());
  for (std::size_t i = 0; i < terms.size(); i += WIDTH) store(&terms[i], elementary::exp(Pack(factor * load(&terms[i]))));
  double sum = 0.0;
  for (std::size_t i = 0; i < count; i++) sum += terms[i];
  return sum;
}

}  // namespace

double effective_sample_size(std::span<const double> log_weights) {
  std::vector<double> terms;
  return 1.0 / sum_of_weights(log_weights, 2.0, terms);
}

double normalise(std::span<double> log_weights) {
  const double largest = *std::max_element(log_weights.begin(), log_weights.end());
  double sum = 0.0;
  std::vector<double> terms(pack::padded(log_weights.size()), -INF);
  for (std::size_t i = 0; i < log_weights.size(); i++) terms[i] = log_weights[i] - largest;
  for (std::size_t i = 0; i < terms.size(); i += WIDTH) store(&terms[i], elementary::exp(load(&terms[i])));
  for (std::size_t i = 0; i < log_weights.size(); i++) sum += terms[i];
  const double log_sum = largest + elementary::log(sum);
  for (double& each : log_weights) each -= log_sum;
  return log_sum;
}

std::vector<std::size_t> systematic_parents(std::span<const double> log_weights, double uniform) {
  const std::size_t count = log_weights.size();
  std::vector<double> weights;
  sum_of_weights(log_weights, 1.0, weights);
  std::vector<std::size_t> parents(count);
  std::size_t parent = 0;
  double cumulated = weights[0];
  for (std::size_t k = 0; k < count; k++) {
    while ((double(k) + uniform) / double(count) >= cumulated && parent < count - 1) cumulated += weights[++parent];
    parents[k] = parent;
  }
  return parents;
}

Particles::Particles(std::size_t count) : pose(count, 3), log_weights(pose.stride(), -INF), map(count) { forget_weights(); }

std::size_t Particles::slot_of(std::uint32_t id) const {
  return std::size_t(std::find(ids.begin(), ids.end(), id) - ids.begin());
}

void Particles::forget_weights() {
  std::fill_n(log_weights.begin(), count(), -elementary::log(double(count())));
}

void Particles::resample(double uniform, std::initializer_list<Rows*> others) {
  std::vector<std::size_t> parents = systematic_parents({log_weights.data(), count()}, uniform);
  parents.resize(stride(), parents.back());
  pose.copy_from(parents);
  map.copy_from(parents);
  for (Rows* rows : others) rows->copy_from(parents);
  forget_weights();
}

std::vector<ScanMeasurement> Particles::find(std::span<const std::uint32_t> observed, std::span<const Reading> readings) {
  const std::size_t before = landmarks();
  std::vector<ScanMeasurement> scan;
  scan.reserve(observed.size());
  for (std::size_t k = 0; k < observed.size(); k++) {
    const std::size_t slot = slot_of(observed[k]);
    const bool is_first = slot == landmarks();
    if (is_first) ids.push_back(observed[k]);
    scan.push_back({slot, slot < before, is_first, readings[k]});
  }
  map.resize(5 * landmarks());
  return scan;
}

void Particles::step(const Motion& motion, const Lower3& L, bool improved, std::span<const ScanMeasurement> scan,
                     std::span<const double> normals) {
  Rows drawn(count(), 3);
  for (std::size_t j = 0; j < 3; j++) drawn.set(j, &normals[j], 3);
  const auto of_turn = elementary::sin_cos(motion.turn);
  for (std::size_t at = 0; at < stride(); at += WIDTH) {
    const Directed<Pack> start = se2::driven(pose_at(at), motion, of_turn);
    MotionNoise<Pack> noise;
    Pack log_weight{};
    if (improved)
      for (const ScanMeasurement& each : scan)
        if (each.is_known) {
          const Landmark<Pack> mark = landmark(each.slot, at);
          log_weight += condition(noise, L, mark, predict(se2::moved_by_noise(start, L, noise.m), mark, each.reading));
        }
    const Pack normal[3] = {load(drawn[0] + at), load(drawn[1] + at), load(drawn[2] + at)};
    log_weight += draw(noise, normal);
    const Directed<Pack> end = se2::moved_by_noise(start, L, noise.m);
    for (const ScanMeasurement& each : scan) {
      Landmark<Pack> mark;
      if (each.is_first) {
        mark = models::place(end, each.reading);
      } else {
        mark = landmark(each.slot, at);
        log_weight += models::update(mark, predict(end, mark, each.reading));
      }
      set_landmark(each.slot, at, mark);
    }
    store(pose[0] + at, end.x);
    store(pose[1] + at, end.y);
    store(pose[2] + at, end.heading);
    store(&log_weights[at], load(&log_weights[at]) + log_weight);
  }
  std::fill(log_weights.begin() + std::ptrdiff_t(count()), log_weights.end(), -INF);
}

}  // namespace teamslam::window
