// Hashes of all results of made-up windows, and their smoothers: the same for every compiler and processor.
//
// Built by tests/core/test_bits.py together with the sources of team/core.
#include "bits.hpp"
#include "consensus.hpp"
#include "sensitivity.hpp"

using namespace teamslam;
using window::Rows;

namespace {

using bits::add, bits::normal, bits::uniform;

void add(const Rows& rows) {
  for (std::size_t k = 0; k < rows.rows(); k++) add(rows.numbers(k));
}

void add(const window::Gaussian& g) {
  add(g.mean);
  add(g.covariance);
  add(double(int(g.fault)));
}

void run_window(int number) {
  const std::size_t particles = 1 + std::size_t(130 * uniform());
  const bool is_mounted = number % 4 == 1;
  const models::Noise noise = {number % 2 ? 4.0 : 0.01, number % 3 ? 0.0 : 0.002, number % 5 ? 1.0 : 0.6, 0.03,
                               number % 7 ? 1.0 : 0.7};
  window::Window run({particles, number % 3 != 2, noise, is_mounted ? se2::Mount(0.3, -0.2, 0.5) : se2::Mount()});
  for (int k = 0; k < 12; k++) {
    double A[3][3], covariance[9];
    for (auto& row : A)
      for (double& each : row) each = 0.05 * normal();
    for (int i = 0; i < 3; i++)
      for (int j = 0; j < 3; j++)
        covariance[3 * i + j] = A[i][0] * A[j][0] + A[i][1] * A[j][1] + (k % 2 ? A[i][2] * A[j][2] : 0.0);
    std::vector<std::uint32_t> ids;
    std::vector<double> ranges, bearings, normals;
    std::vector<models::Claim> claims;
    for (int n = int(5 * uniform()); n > 0; n--) {
      ids.push_back(std::uint32_t(9 * uniform()));
      ranges.push_back(0.0005 + 20.0 * uniform());
      bearings.push_back(elementary::PI * (2.0 * uniform() - 1.0));
      claims.push_back({0.3, 0.001, 0.02, double(int(3.0 * uniform()) - 1)});
    }
    if (number % 2) claims.clear();
    for (std::size_t i = 0; i < 3 * particles; i++) normals.push_back(normal());
    const window::Increment increment = {{1.0 + 0.2 * normal(), 0.1 * normal(), 0.3 * normal()},
                                         std::span<const double, 9>(covariance)};
    const double draw = uniform();
    const window::Step step =
        run.advance(increment, {ids, ranges, bearings, claims}, k % 3 == 2 ? draw : window::NO_RESAMPLING, normals);
    add(step.effective);
    add(step.log_evidence);
    if (step.squared == step.squared) add(step.squared);  // the bits of NaN are the processor's
    add(run.particles().pose);
    add(run.particles().map);
    add({run.particles().log_weights.data(), particles});
    if (k % 5 == 4) run.mark(k);
    add(run.run());
  }
  add(run.close());
  add(run.of_base().path());
}

// A drive along an arc among five landmarks; every fourth measurement is an outlier.
void run_smoother(int number) {
  const models::Noise noise = {0.01, number % 3 ? 0.0 : 0.002, number % 5 ? 1.0 : 0.6, 0.0004, 1.0};
  window::Window run({3, true, noise, number % 4 == 1 ? se2::Mount(0.3, -0.2, 0.5) : se2::Mount()});
  window::Consensus consensus(noise, 30.0, elementary::TWO_PI, number % 2 ? 0.3 : 0.01);
  const motion::Increment step = {{1.0, 0.05, 0.15}, {{{0.01, 0.0, 0.001}, {0.0, 0.002, 0.0}, {0.001, 0.0, 0.0009}}}};
  se2::Pose<double> pose{};
  for (int k = 0; k < 10; k++) {
    pose = se2::compose(pose, step.mean);
    std::vector<std::uint32_t> ids;
    std::vector<double> ranges, bearings, normals;
    std::vector<models::Claim> claims;
    for (int n = k == 3 ? 0 : int(6 * uniform()); n > 0; n--) {
      const std::uint32_t id = std::uint32_t(5 * uniform());
      const models::Polar seen = models::polar(pose, {3.0 * id - 1.0, id % 2 ? 4.0 : -5.0});
      const double off = uniform() < 0.25 ? 3.0 : 0.1;
      ids.push_back(id);
      ranges.push_back(std::fabs(seen.range + off * normal()));
      bearings.push_back(seen.bearing + 0.2 * off * normal());
      claims.push_back({0.02, 0.0003, 0.0005, double(int(3.0 * uniform()) - 1)});
    }
    if (number % 2) claims.clear();
    for (int i = 0; i < 9; i++) normals.push_back(normal());
    const window::Increment increment = {{step.mean.x, step.mean.y, step.mean.heading},
                                         std::span<const double, 9>(step.covariance[0], 9),
                                         {normal(), normal(), 0.1 * normal()}};
    run.advance(increment, {ids, ranges, bearings, claims}, window::NO_RESAMPLING, normals);
    consensus.add(step, {ids, ranges, bearings, claims});
    for (const bool each : consensus.agreeing()) add(each);
    if (k % 4 == 2) run.mark(k);
    if (k == 9 && number % 2) run.move(increment, normals);
  }
  for (const bool each : consensus.confirmed()) add(each);
  window::Sensitivity found = window::sensitivity_of(run, run.close().mean, true);
  add(std::move(found.rows).numbers());
  add(double(int(found.fault)));
}

std::uint64_t hash_of(void (*run)(int)) {
  bits::hash = bits::EMPTY;
  for (int number = 0; number < 40; number++) run(number);
  return bits::hash;
}

}  // namespace

int main() {
  for (const auto run : {run_window, run_smoother}) std::printf("%016llx\n", static_cast<unsigned long long>(hash_of(run)));
}
