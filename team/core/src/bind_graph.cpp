// Bindings of the submap graph.
#include "binding.hpp"
#include "submap_factor.hpp"

namespace teamslam::binding {

namespace {

using graph::Submap;

Submap submap_of(const Numbers& mean, const Table& information, const Table& landmarks, const Table& sensitivity,
                 const Indices& range_power) {
  const std::size_t n = mean.size(), L = landmarks.shape(0);
  check(landmarks.shape(1) == 3, "a landmark's covariance is (xx, xy, yy)");
  check(n >= 3 + 2 * L && (n - 2 * L) % 3 == 0, "a submap has poses of three numbers, then landmarks of two");
  check(information.shape(0) == n && information.shape(1) == n, "the information matrix must have the mean's size");
  check(sensitivity.shape(0) == range_power.size() && (range_power.size() == 0 || sensitivity.shape(1) == n),
        "a sensitivity has a row of the mean's size for each bias");
  Submap submap{Numbers_of(mean), dense::Matrix(matrix_of(information)), {}, dense::Matrix(matrix_of(sensitivity)), {}};
  for (std::size_t l = 0; l < L; l++) submap.landmarks.push_back({landmarks(l, 0), landmarks(l, 1), landmarks(l, 2)});
  for (std::size_t b = 0; b < range_power.size(); b++) {
    check(range_power(b) >= graph::NO_POWER && range_power(b) <= 1, "a bias grows with power 0 or 1 of a range");
    submap.range_power.push_back(range_power(b));
  }
  return submap;
}
