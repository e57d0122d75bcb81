// Hash of all results of made-up maps and chains of submaps: one number for every compiler and processor (see bits.cpp).
#include "bits.hpp"
#include "chain.hpp"

using namespace teamslam;

namespace {

using bits::add, bits::normal, bits::uniform;

struct RandomMap {
  std::vector<std::uint32_t> ids;
  std::vector<double> mean;
  dense::Matrix covariance;

  maps::LocalMap view() const { return {ids, mean, covariance}; }
};

// A submap that observes some of twenty landmarks from a pose, which moves on.
RandomMap random_map(double (&pose)[3]) {
  RandomMap made;
  const double turn = 0.5 * normal(), ahead = 3.0 + uniform();
  const auto [s, c] = elementary::sin_cos(pose[2]);
  made.mean = {ahead + 0.05 * normal(), 0.05 * normal(), turn + 0.02 * normal()};
  for (std::uint32_t id = 0; id < 20; id++) {
    if (uniform() < 0.6) continue;
    const double x = 5.0 * double(id % 5) - pose[0], y = 4.0 * double(id / 5) - pose[1];
    made.ids.push_back(id);
    made.mean.push_back(c * x + s * y + 0.1 * normal());
    const double sigma = uniform() < 0.03 ? 3.0 : 0.1;
    made.mean.push_back(c * y - s * x + sigma * normal());
  }
  const std::size_t n = made.mean.size();
  dense::Matrix root(n, n + 2);
  for (std::size_t i = 0; i < n; i++)
    for (std::size_t j = 0; j < n + 2; j++) root[i][j] = (i == j ? 0.1 : 0.02) * normal();
  made.covariance = dense::product(root, dense::transposed(root));
  for (std::size_t i = 0; i < n; i++) made.covariance[i][i] += 1e-3;
  pose[0] += c * ahead;
  pose[1] += s * ahead;
  pose[2] += turn;
  return made;
}

void run_map(int number) {
  double pose[3] = {};
  const RandomMap first = random_map(pose);
  maps::WholeMap map{first.ids, first.mean, first.covariance};
  maps::Chain chain(first.view());
  for (int k = 0; k < 2 + number % 5; k++) {
    const RandomMap next = random_map(pose);
    for (const double gate : {elementary::INF, 20.0}) {
      const maps::TiedPose at = maps::end_pose(map, next.view(), gate);
      add(at.pose);
      add(at.covariance);
      add(double(at.known + 100 * at.refused));
    }
    chain.append(next.view());
    maps::WholeMap joined;
    if (maps::join(map, next.view(), joined) == maps::Fault::NONE) map = joined;
    add(map.mean);
    add(std::move(joined.covariance).numbers());
  }
  maps::ChainSolution found = chain.solve(50, 1e-6);
  add(found.map.mean);
  add(std::move(found.map.covariance).numbers());
  add(found.landmark_chi2);
  add(found.cost);
}

}  // namespace

int main() {
  for (int number = 0; number < 40; number++) run_map(number);
  bits::print();
}
