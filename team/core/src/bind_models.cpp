// Bindings of the measurement model and of a sensor's calibration.
#include "binding_scan.hpp"
#include "calibration.hpp"

namespace teamslam::binding {

using models::Calibration, models::Polar;

namespace {

using Pose = se2::Pose<double>;

template <std::size_t N>
void append(std::vector<double>& to, const std::array<std::array<double, N>, 2>& rows) {
  for (const auto& row : rows) to.insert(to.end(), row.begin(), row.end());
}

void bind_calibration(nb::module_& m) {
  nb::class_<Calibration>(m, "Calibration", "Correction of a raw measurement of range and bearing, and its limits.")
      .def(
          "__init__",
          [](Calibration* self, double range_offset, double range_scale, double bearing_offset,
             std::optional<std::array<double, 3>> lens, std::optional<double> optical_axis, std::array<double, 2> ranges,
             double half_field) {
            check(range_scale > 0.0, "range_scale must be positive");
            new (self) Calibration{range_offset, range_scale, bearing_offset, lens, optical_axis, ranges[0], ranges[1], half_field};
          },
          "range_offset"_a, "range_scale"_a, "bearing_offset"_a, "lens"_a.none(), "optical_axis"_a.none(), "ranges"_a, "half_field"_a,
          "lens: coefficients of the bearing's error b (l0 + l1 b + l2 b^2); optical_axis [rad]: of a camera whose\n"
          "range is a depth along it; ranges: (least, most) of raw ranges [m]; half_field: half of the field of view [rad].")
      .def(
          "correct",
          [](const Calibration& self, const Numbers& ranges, const Numbers& bearings) {
            const std::size_t n = ranges.size();
            check(bearings.size() == n, "ranges and bearings must have one length");
            std::vector<double> distances(n), turned(n);
            std::vector<bool> mask(n);
            for (std::size_t k = 0; k < n; k++) {
              const auto [range, bearing, is_accepted] = self.correct(ranges(k), bearings(k));
              distances[k] = range, turned[k] = bearing, mask[k] = is_accepted;
            }
            return std::tuple(std::move(mask), std::move(distances), std::move(turned));
          },
          "ranges"_a, "bearings"_a,
          "Return which raw measurements are accepted, and all of them corrected: ((r - range_offset)/range_scale,\n"
          "b - bearing_offset - lens(b)).\n\n"
          "A depth is divided by cos(b - optical_axis), too, and NaN where that is below 0.17. Accepted are those\n"
          "in the ranges and the field of view whose corrected range is positive.");
}

}  // namespace

void bind_models(nb::module_& m) {
  bind_calibration(m);
  m.attr("NEAREST_M") = models::NEAREST_M;
  m.def(
      "predicted",
      [](const Pose& pose, const se2::Point<double>& landmark) {
        const Polar z = models::polar(pose, landmark);
        return std::tuple(z.range, z.bearing);
      },
      "pose"_a, "landmark"_a,
      "Predict range [m] and bearing [rad] of a point landmark from a pose, both in the map frame.\n\n"
      "range = max(|landmark - (x, y)|, NEAREST_M), bearing = atan2(dy, dx) - heading in (-pi, pi].");
  m.def(
      "predict",
      [](const Pose& from, const Table& landmarks) {
        check(landmarks.shape(1) == 2, "landmarks must be (L, 2)");
        const std::size_t L = landmarks.shape(0);
        std::vector<double> measurements, by_pose, by_landmark;
        for (std::size_t k = 0; k < L; k++) {
          const Polar z = models::polar(from, {landmarks(k, 0), landmarks(k, 1)});
          measurements.insert(measurements.end(), {z.range, z.bearing});
          append(by_pose, models::pose_jacobian(z.range, z.bearing));
          append(by_landmark, models::landmark_jacobian(z.range, from.heading + z.bearing));
        }
        return std::tuple(made<double, nb::ndim<2>>(std::move(measurements), {L, 2}),
                          made<double, nb::ndim<3>>(std::move(by_pose), {L, 2, 3}),
                          made<double, nb::ndim<3>>(std::move(by_landmark), {L, 2, 2}));
      },
      "pose"_a, "landmarks"_a,
      "Predict the measurements h (L, 2) of landmarks (L, 2), with dh/dxi (L, 2, 3) of h(pose o Exp(xi), landmark) at\n"
      "xi = 0 and dh/dlandmark (L, 2, 2).");
  m.def(
      "located", [](const Pose& pose, double range, double bearing) { return models::located(pose, {range, bearing}); }, "pose"_a,
      "range"_a, "bearing"_a, "Invert the model: the point at (range, bearing) from a pose, in the pose's map frame.");
  m.def(
      "place",
      [](const Pose& pose, const Table& measurements, const std::array<double, 5>& noise, const Table& own) {
        const std::size_t n = measurements.shape(0);
        check(measurements.shape(1) == 2, "measurements must be (n, 2)");
        const models::Noise sensor = noise_of(noise);
        const std::span<const models::Claim> claims = claims_of(own, n);
        std::vector<double> means, covariances;
        for (std::size_t k = 0; k < n; k++) {
          const models::Claim claim = claims.empty() ? models::OF_SENSOR : claims[k];
          const auto placed =
              models::place(pose, models::reading_of(measurements(k, 0), measurements(k, 1), sensor, claim));
          means.insert(means.end(), {placed.x, placed.y});
          covariances.insert(covariances.end(), {placed.xx, placed.xy, placed.yy});
        }
        return std::tuple(made<double, nb::ndim<2>>(std::move(means), {n, 2}),
                          made<double, nb::ndim<2>>(std::move(covariances), {n, 3}));
      },
      "pose"_a, "measurements"_a, "noise"_a, "own"_a,
      "Initialise landmarks: means (n, 2) and covariances (xx, xy, yy) (n, 3) of measurements (n, 2).\n\n"
      "noise: as of `Window`; own: (n, 4) covariances of the measurements, or (n, 0).");
}

}  // namespace teamslam::binding
