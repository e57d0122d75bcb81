#include "measurements.hpp"

#include <algorithm>

namespace teamslam::window {

namespace {

// A measurement as it is seen from the keyframe's end.
struct Moved {
  std::uint32_t id;
  double range, bearing;
  const Claim* claim;  // as it is carried there; null where its scan brings none
};

void insert(std::vector<double>& ascending, double x) {
  ascending.insert(std::upper_bound(ascending.begin(), ascending.end(), x), x);
}

double median(std::span<const double> numbers) {
  const std::size_t middle = numbers.size() / 2;
  return numbers.size() % 2 ? numbers[middle] : (numbers[middle - 1] + numbers[middle]) / 2.0;
}

// The covariance of a measurement from another pose, where its point lies at a range and a bearing: that
// along and across its ray, whose direction is seen from there, converted to the point's.
Claim carried(const Claim& claim, double range, double direction, const models::Polar& to) {
  if (!claim.is_made()) return claim;
  const double reach = pack::max(range, models::NEAREST_M), far = pack::max(to.range, models::NEAREST_M);
  const auto [s, c] = elementary::sin_cos(direction - to.bearing);
  const models::Turned<double> S = models::turned(claim.rr, claim.rb * reach, claim.bb * reach * reach, s, c);
  return {S.along, S.both / far, S.across / (far * far), claim.form};
}

Claim mean_claim(std::span<const Moved> measurements) {
  Claim sum{};
  double count = 0.0;
  for (const Moved& each : measurements) {
    if (!each.claim || (count > 0.0 && each.claim->form != sum.form)) continue;
    if (count == 0.0) {
      sum = *each.claim;
    } else {
      sum.rr += each.claim->rr;
      sum.rb += each.claim->rb;
      sum.bb += each.claim->bb;
    }
    count += 1.0;
  }
  return count > 0.0 ? Claim{sum.rr / count, sum.rb / count, sum.bb / count, sum.form} : models::OF_SENSOR;
}

}  // namespace

bool Measurements::is_finite() const {
  const auto finite = [](double x) { return std::isfinite(x); };
  const auto finite_claim = [&](const Claim& each) { return finite(each.rr) && finite(each.rb) && finite(each.bb); };
  return std::all_of(ranges.begin(), ranges.end(), finite) && std::all_of(bearings.begin(), bearings.end(), finite) &&
         std::all_of(claims.begin(), claims.end(), finite_claim);
}

bool Measurements::is_unnamed() const {
  return std::any_of(ids.begin(), ids.end(), [](std::uint32_t id) { return id >= UNNAMED; });
}

Measurements Measurements::only(const std::vector<bool>& taken) const {
  Measurements chosen;
  for (std::size_t k = 0; k < size(); k++) {
    if (!taken[k]) continue;
    chosen.ids.push_back(ids[k]);
    chosen.ranges.push_back(ranges[k]);
    chosen.bearings.push_back(bearings[k]);
    if (!claims.empty()) chosen.claims.push_back(claims[k]);
  }
  return chosen;
}

Measurements Measurements::with(const Measurements& more) const {
  const auto append = [](auto& to, const auto& from) { to.insert(to.end(), from.begin(), from.end()); };
  Measurements both = *this;
  append(both.ids, more.ids);
  append(both.ranges, more.ranges);
  append(both.bearings, more.bearings);
  if (claims.empty() && more.claims.empty()) return both;
  both.claims.resize(size(), models::OF_SENSOR);
  append(both.claims, more.claims);
  both.claims.resize(both.size(), models::OF_SENSOR);
  return both;
}

Measurements of_points(std::vector<std::uint32_t> ids, std::span<const se2::Point<double>> points,
                       std::span<const std::array<double, 3>> covariances) {
  Measurements seen{std::move(ids), {}, {}, {}};
  for (const auto& [x, y] : points) {
    seen.ranges.push_back(elementary::hypot(x, y));
    seen.bearings.push_back(elementary::atan2(y, x));
  }
  for (std::size_t k = 0; k < covariances.size(); k++) {
    const auto [xx, xy, yy] = covariances[k];
    const double reach = pack::max(seen.ranges[k], models::NEAREST_M);
    const auto [s, c] = elementary::sin_cos(seen.bearings[k]);
    const models::Turned<double> S = models::turned(xx, xy, yy, -s, c);
    seen.claims.push_back({S.along, S.both / reach, S.across / (reach * reach), 1.0});
  }
  return seen;
}

Measurements reduce(std::span<const Scan> scans, std::span<const se2::Pose<double>> poses) {
  std::size_t count = 0;
  bool has_claims = false;
  for (const Scan& scan : scans) {
    count += scan.ids.size();
    has_claims = has_claims || !scan.claims.empty();
  }
  std::vector<Moved> moved;
  std::vector<Claim> claims;
  claims.reserve(count);  // it is pointed into
  for (std::size_t i = 0; i < scans.size(); i++)
    for (std::size_t k = 0; k < scans[i].ids.size(); k++) {
      const double range = scans[i].ranges[k], bearing = scans[i].bearings[k];
      const auto [x, y] = models::located(poses[i], {range, bearing});
      const models::Polar seen{elementary::hypot(x, y), elementary::atan2(y, x)};
      const Claim* claim = nullptr;
      if (!scans[i].claims.empty())
        claim = &claims.emplace_back(carried(scans[i].claims[k], range, poses[i].heading + bearing, seen));
      moved.push_back({scans[i].ids[k], seen.range, seen.bearing, claim});
    }
  std::stable_sort(moved.begin(), moved.end(), [](const Moved& a, const Moved& b) { return a.id < b.id; });
  Measurements reduced;
  std::vector<double> ranges, offsets;
  for (auto first = moved.begin(); first != moved.end();) {
    const auto last = std::find_if(first, moved.end(), [&](const Moved& each) { return each.id != first->id; });
    ranges.clear();
    offsets.clear();
    for (auto each = first; each != last; ++each) {
      insert(ranges, each->range);
      insert(offsets, se2::wrapped(each->bearing - first->bearing));
    }
    reduced.ids.push_back(first->id);
    reduced.ranges.push_back(median(ranges));
    reduced.bearings.push_back(se2::wrapped(first->bearing + median(offsets)));
    if (has_claims) reduced.claims.push_back(mean_claim({&*first, std::size_t(last - first)}));
    first = last;
  }
  return reduced;
}

}  // namespace teamslam::window
