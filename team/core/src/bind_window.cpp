// Bindings of the window and of the functions on its particles.
#include <algorithm>
#include <numeric>

#include <nanobind/stl/vector.h>

#include "binding_scan.hpp"
#include "own_map.hpp"
#include "sensitivity.hpp"

namespace teamslam::binding {

using window::Gaussian, window::Keyframe, window::Particles, window::Rows, window::Scan, window::Window;

namespace {

using MadeGaussian = std::tuple<MadeIds, MadeNumbers, MadeTable, int>;
using MadeParticles = std::tuple<MadeTable, MadeNumbers, MadeIds, MadeStack, MadeStack>;

// Log weights may be −∞.
std::span<const double> log_weights_of(const Numbers& logs) {
  check(logs.size() > 0, "there must be a particle");
  for (std::size_t i = 0; i < logs.size(); i++)
    if (!(logs(i) < elementary::INF)) throw NotFiniteError("log_weights must be numbers below infinity");
  return {logs.data(), logs.size()};
}

// (M, k) of k rows.
MadeTable made_table(const Rows& rows, std::size_t first, std::size_t k) {
  std::vector<double> values(rows.count() * k);
  for (std::size_t j = 0; j < k; j++)
    for (std::size_t i = 0; i < rows.count(); i++) values[i * k + j] = rows[first + j][i];
  return made<double, nb::ndim<2>>(std::move(values), {rows.count(), k});
}

// (M, L, width) of the landmarks' rows from `offset` on.
MadeStack made_landmarks(const Rows& map, std::size_t offset, std::size_t width) {
  const std::size_t M = map.count(), L = map.rows() / 5;
  std::vector<double> values(M * L * width);
  for (std::size_t l = 0; l < L; l++)
    for (std::size_t k = 0; k < width; k++) {
      const double* row = map[5 * l + offset + k];
      for (std::size_t i = 0; i < M; i++) values[(i * L + l) * width + k] = row[i];
    }
  return made<double, nb::ndim<3>>(std::move(values), {M, L, width});
}

MadeGaussian made_gaussian(Gaussian&& g) {
  const std::size_t n = g.mean.size(), L = g.ids.size();
  return {made<std::uint32_t, nb::ndim<1>>(std::move(g.ids), {L}), made_numbers(std::move(g.mean)),
          made<double, nb::ndim<2>>(std::move(g.covariance), {n, n}), int(g.fault)};
}

MadeParticles made_particles(const Particles& p) {
  return {made_table(p.pose, 0, 3),
          made_numbers({p.log_weights.begin(), p.log_weights.begin() + std::ptrdiff_t(p.count())}),
          made<std::uint32_t, nb::ndim<1>>(std::vector<std::uint32_t>(p.ids), {p.landmarks()}),
          made_landmarks(p.map, 0, 2), made_landmarks(p.map, 2, 3)};
}

// Rows of landmarks from (M, L, 2) means and (M, L, 3) covariances.
Rows map_of(std::size_t count, const Stack& means, const Stack& covariances) {
  const std::size_t L = means.shape(1);
  check(means.shape(0) == count && means.shape(2) == 2, "means must be (M, L, 2)");
  check(covariances.shape(0) == count && covariances.shape(1) == L && covariances.shape(2) == 3,
        "covariances must be (M, L, 3)");
  finite(means, "means");
  finite(covariances, "covariances");
  Rows map(count, 5 * L);
  for (std::size_t l = 0; l < L; l++) {
    for (std::size_t k = 0; k < 2; k++) map.set(5 * l + k, means.data() + 2 * l + k, 2 * L);
    for (std::size_t k = 0; k < 3; k++) map.set(5 * l + 2 + k, covariances.data() + 3 * l + k, 3 * L);
  }
  return map;
}

Particles particles_of(const Table& poses, const Numbers& log_weights, const Ids& ids, const Stack& means,
                       const Stack& covariances) {
  const std::size_t count = poses.shape(0);
  check(count > 0 && poses.shape(1) == 3, "poses must be (M, 3), M > 0");
  check(log_weights.size() == count, "log_weights must be (M,)");
  check(means.shape(1) == ids.size(), "means must be (M, L, 2)");
  finite(poses, "poses");
  const std::span<const double> logs = log_weights_of(log_weights);
  std::vector<std::uint32_t> sorted(ids.data(), ids.data() + ids.size());
  std::sort(sorted.begin(), sorted.end());
  check(std::adjacent_find(sorted.begin(), sorted.end()) == sorted.end(), "ids must differ");
  Particles particles(count);
  for (std::size_t k = 0; k < 3; k++) particles.pose.set(k, poses.data() + k, 3);
  std::copy(logs.begin(), logs.end(), particles.log_weights.begin());
  particles.ids.assign(ids.data(), ids.data() + ids.size());
  particles.map = map_of(count, means, covariances);
  return particles;
}

// Rows x, y, heading of each keyframe from (K, M, 3).
Rows path_of(const Stack& paths, std::size_t count) {
  check(paths.shape(1) == count && paths.shape(2) == 3, "paths must be (K, M, 3)");
  finite(paths, "paths");
  Rows path(count, 3 * paths.shape(0));
  for (std::size_t k = 0; k < paths.shape(0); k++)
    for (std::size_t j = 0; j < 3; j++) path.set(3 * k + j, paths.data() + 3 * count * k + j, 3);
  return path;
}

std::span<const double> normals_of(const Table& normals, std::size_t count) {
  check(normals.shape(0) == count && normals.shape(1) == 3, "normals must be (M, 3)");
  return finite(normals, "normals");
}

Rows pose_rows_of(const Table& poses, std::size_t count) {
  check(poses.shape(0) == count && poses.shape(1) % 3 == 0, "poses must be (M, 3 k)");
  finite(poses, "poses");
  const std::size_t k = poses.shape(1);
  Rows rows(count, k);
  for (std::size_t j = 0; j < k; j++) rows.set(j, poses.data() + j, k);
  return rows;
}

window::Sensitivity rounded_sensitivity(const Window& of, std::span<const double> mean, bool with_nodes) {
  const std::size_t nodes = with_nodes ? of.nodes().size() : 0;
  check(mean.size() == 3 + 3 * nodes + 2 * of.particles().landmarks(), "mean must be of this window");
  check_finite(mean.data(), mean.size(), "mean");
  return window::sensitivity_of(of, mean, with_nodes).rounded();
}

void bind_particles(nb::module_& m) {
  m.def(
      "effective_sample_size",
      [](const Numbers& log_weights) { return window::effective_sample_size(log_weights_of(log_weights)); }, "log_weights"_a,
      "Compute 1/sum(w^2) of normalised log weights.");
  m.def(
      "normalise",
      [](const Numbers& log_weights) {
        const std::span<const double> logs = log_weights_of(log_weights);
        std::vector<double> normalised(logs.begin(), logs.end());
        const double log_sum = window::normalise(normalised);
        return std::tuple(made_numbers(std::move(normalised)), log_sum);
      },
      "log_weights"_a, "Return (log w - log sum(w), log sum(w)), with the largest weight factored out of the sum.");
  m.def(
      "systematic_parents",
      [](const Numbers& log_weights, double uniform) {
        check(uniform >= 0.0 && uniform < 1.0, "uniform must be in [0, 1)");
        const std::vector<std::size_t> parents = window::systematic_parents(log_weights_of(log_weights), uniform);
        return Places{{parents.begin(), parents.end()}};
      },
      "log_weights"_a, "uniform"_a,
      "Resample systematically: particle i is the parent of floor(M w_i) or ceil(M w_i) particles.\n\n"
      "The M points (k + uniform)/M fall into the intervals of the cumulated weights; 0 <= uniform < 1.\n"
      "Kitagawa 1996; Thrun et al. 2005, table 4.4.");
  m.def(
      "mean_direction",
      [](const Numbers& angles, const Numbers& weights) {
        check(angles.size() == weights.size(), "angles and weights must have one length");
        return window::mean_direction(finite(angles, "angles"), finite(weights, "weights"));
      },
      "angles"_a, "weights"_a, "Compute the direction of sum(w_i (cos a_i, sin a_i)).");
  m.def(
      "sample_factor", [](const Numbers& weights) { return window::sample_factor(finite(weights, "weights")); }, "weights"_a,
      "Compute the factor N/(N - 5) for the scatter of N = 1/sum(w^2) particles, N at least 10.\n\n"
      "With it the inverse of the scatter is right on average (Anderson 2003, section 7.7).");
  m.def(
      "on_group",
      [](const Table& poses, const Numbers& weights) {
        check(poses.shape(1) == 3 && poses.shape(0) == weights.size() && weights.size() > 0, "poses must be (M, 3), weights (M,)");
        window::OnGroup found = window::on_group(pose_rows_of(poses, weights.size()), finite(weights, "weights"));
        return std::tuple(made_numbers({found.mean.begin(), found.mean.end()}), made_table(found.deviations, 0, 3));
      },
      "poses"_a, "weights"_a, "Compute the mean pose on SE(2), and each pose's deviation from it in (x, y, theta).");
  m.def(
      "moments",
      [](const Table& poses, const Numbers& weights, const Stack& means, const Stack& covariances, double between) {
        check(weights.size() > 0, "there must be a particle");
        const Rows map = map_of(weights.size(), means, covariances);
        std::vector<std::size_t> slots(means.shape(1));
        std::iota(slots.begin(), slots.end(), std::size_t{0});
        Gaussian found =
            window::moments(pose_rows_of(poses, weights.size()), finite(weights, "weights"), map, slots, between, false);
        const std::size_t n = found.mean.size();
        return std::tuple(made_numbers(std::move(found.mean)), made<double, nb::ndim<2>>(std::move(found.covariance), {n, n}));
      },
      "poses"_a, "weights"_a, "means"_a, "covariances"_a, "between"_a,
      "Compute mean and covariance of the mixture sum(w_i N(mu_i, blkdiag(0, S_1, ..., S_L))).\n\n"
      "poses: (M, 3 k), k poses (x, y, theta) of each particle; headings on the circle. The scatter between\n"
      "the particles is taken times `between`: 1 for the mixture itself.");
  m.def(
      "landmarks_along_paths",
      [](const Ids& ids, const Stack& means, const Stack& covariances, const Stack& paths,
         const nb::ndarray<const std::int64_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>& keyframes, const Ids& seen,
         const Table& measurements, const Table& own, const std::array<double, 5>& noise) {
        const std::size_t n = seen.size();
        check(keyframes.size() == n && measurements.shape(0) == n && measurements.shape(1) == 2,
              "keyframes and seen must be (N,), measurements (N, 2)");
        check(means.shape(0) > 0 && means.shape(1) == ids.size(), "means must be (M, L, 2), M > 0");
        finite(measurements, "measurements");
        const std::span<const models::Claim> claims = claims_of(own, n);
        std::vector<window::WindowMeasurement> taken;
        for (std::size_t k = 0; k < n; k++) {
          check(keyframes(k) >= 0 && std::size_t(keyframes(k)) < paths.shape(0), "a keyframe is not in the paths");
          taken.push_back({seen(k), std::size_t(keyframes(k)), measurements(k, 0), measurements(k, 1),
                            claims.empty() ? models::OF_SENSOR : claims[k]});
        }
        const Rows starts = map_of(means.shape(0), means, covariances), path = path_of(paths, means.shape(0));
        Rows solved(starts.count(), starts.rows());
        for (std::size_t slot = 0; slot < ids.size(); slot++)
          window::solve_along_paths(ids(slot), slot, starts, path, taken, noise_of(noise), solved);
        return std::tuple(made_landmarks(solved, 0, 2), made_landmarks(solved, 2, 3));
      },
      "ids"_a.noconvert(), "means"_a, "covariances"_a, "paths"_a, "keyframes"_a.noconvert(), "seen"_a.noconvert(), "measurements"_a, "own"_a, "noise"_a,
      "Solve each landmark of each particle by Gauss-Newton over its measurements, given the particle's path.\n\n"
      "ids: of the L landmarks, whose means and covariances are the starts. Of each of N measurements\n"
      "keyframes is its place in the paths (K, M, 3), and seen its landmark. Returns means and covariances.");
  m.def(
      "normalised_square",
      [](const Numbers& error, const Table& S) {
        check(S.shape(0) == error.size() && S.shape(1) == error.size(), "S must be (m, m)");
        return linalg::normalised_square({error.data(), error.size()}, {S.data(), S.size()});
      },
      "error"_a, "S"_a, "Compute e' inv(S) e by the Cholesky factor of S; NaN if a pivot is not above rounding.");
}

}  // namespace

void bind_window(nb::module_& m) {
  bind_particles(m);
  nb::class_<window::Step>(m, "Step", "Statistics of one keyframe.")
      .def_ro("log_evidence", &window::Step::log_evidence, "log p(z | earlier z) by the particles.")
      .def_ro("squared", &window::Step::squared,
              "NIS of the measurements that were predicted; NaN where a pivot of S is not above rounding.")
      .def_ro("dof", &window::Step::dof, "Degrees of freedom of `squared`.");

  nb::class_<Window>(m, "Window",
                     "Particles since a window's start, their paths, and the measurements that they have used.\n\n"
                     "Poses are the sensor's, in the frame of the window's start of the sensor; the Gaussians are of the\n"
                     "base, in the frame of its start. Brooks and Bailey 2009, HybridSLAM.")
      .def(
          "__init__",
          [](Window* self, std::size_t particles, const std::array<double, 5>& noise, bool improved,
             const std::array<double, 3>& mount, double resample_below) {
            new (self) Window(settings_of(particles, noise, improved, mount, resample_below));
          },
          "particles"_a, "noise"_a, "improved"_a = true, "mount"_a = std::array<double, 3>{0.0, 0.0, 0.0}, "resample_below"_a = 0.0,
          "Open a window: every particle exactly at zero, without landmarks or measurements.\n\n"
          "noise: (range_variance, range_per_m2, range_white, bearing_variance, bearing_white), as of\n"
          "`models.Noise`. improved: the proposal of FastSLAM 2.0. mount: of the sensor on the base. resample_below: the\n"
          "share of effective particles below which they are resampled.")
      .def_static(
          "of_particles",
          [](const Table& poses, const Numbers& log_weights, const Ids& ids, const Stack& means, const Stack& covariances,
             const std::array<double, 5>& noise, bool improved) {
            Particles particles = particles_of(poses, log_weights, ids, means, covariances);
            Window opened({particles.count(), improved, noise_of(noise), {}});
            opened.replace(std::move(particles), Rows(poses.shape(0)));
            return opened;
          },
          "poses"_a, "log_weights"_a, "ids"_a.noconvert(), "means"_a, "covariances"_a, "noise"_a, "improved"_a = true,
          "Make a window whose particles are these, without a keyframe.")
      .def(
          "advance",
          [](Window& self, const Keyframe& keyframe, random::Random& random) {
            return self.advance(keyframe.increment(), scan_of(keyframe), random);
          },
          "keyframe"_a, "random"_a,
          "Add a keyframe: the motion since the last one, then its measurements, if any.\n\n"
          "The particles are resampled first if too few are effective. random: draws a uniform number for that, then\n"
          "three normal ones for each particle. Raises MotionError, and leaves the window unchanged.")
      .def(
          "step",
          [](Window& self, const Keyframe& keyframe, const Table& normals) {
            return self.step(keyframe.increment(), scan_of(keyframe), normals_of(normals, self.settings().particles));
          },
          "keyframe"_a, "normals"_a,
          "Add a keyframe as `advance` does, without resampling and innovation; returns the log evidence.\n\n"
          "Raises MotionError, and leaves the window unchanged.")
      .def(
          "move",
          [](Window& self, const Keyframe& rest, random::Random& random) { self.move(rest.increment(), random); }, "rest"_a,
          "random"_a, "Move the particles by the motion after the last keyframe; the weights stay. Raises MotionError.")
      .def("mark", &Window::mark, "stamp_ns"_a, "Make the particles' poses at the last keyframe a pose node at this team time [ns].")
      .def(
          "innovation",
          [](const Window& self, const Keyframe& keyframe) {
            window::Innovation found = self.innovation(keyframe.increment(), scan_of(keyframe));
            const std::size_t n = found.error.size();
            return std::tuple(found.squared, made_numbers(std::move(found.error)),
                              made<double, nb::ndim<2>>(std::move(found.S), {n, n}));
          },
          "keyframe"_a, "Predict the measurements of known landmarks; returns (v' inv(S) v, v, S), v = z - h. Raises MotionError.")
      .def("close", [](Window& self) { return made_gaussian(self.close()); },
           "Match moments with the landmarks solved again along the paths: the submap of the window.\n\n"
           "Returns ids, mean and covariance of (end pose, pose nodes, landmarks by ascending id), and the index in\n"
           "`gaussian.FAULTS` of why they are no Gaussian.")
      .def(
          "run",
          [](Window& self) {
            Gaussian found = self.run();
            const std::size_t n = found.mean.size();
            dense::Matrix covariance(dense::Const{found.covariance.data(), n, n, n});
            return std::tuple(maps::WholeMap{std::move(found.ids), std::move(found.mean), std::move(covariance)}, int(found.fault));
          },
          "Match moments of (end pose, landmarks) so far, which are not fused; as `close` without pose nodes.\n\n"
          "Where all errors of the sensor are white the landmarks are those that the particles hold. Returns a map, and\n"
          "the index in `gaussian.FAULTS` of why it is no Gaussian.")
      .def(
          "corrected",
          [](const Window& self, const maps::WholeMap& map, double factor,
             const std::vector<std::tuple<double, double, std::size_t>>& errors) {
            std::vector<maps::SharedError> shared;
            for (const auto& [value, sigma, row] : errors) {
              check(row < window::BIASES, "there is no such error");
              shared.push_back({value, sigma, row});
            }
            window::Sensitivity found;
            if (!shared.empty()) found = rounded_sensitivity(self, map.mean, false);
            maps::WholeMap corrected = map;
            if (found.fault == gaussian::Fault::NONE)
              maps::correct(corrected.mean, corrected.covariance.view(), factor, shared, found.rows, found.curvature);
            return std::tuple(std::move(corrected), int(found.fault));
          },
          "map"_a, "factor"_a, "errors"_a,
          "Correct the map of `run` by errors (b, sigma, row of `sensitivity`), as the function `corrected` does.\n\n"
          "Returns it, and the index in `gaussian.FAULTS` of why it has no derivatives.")
      .def(
          "replace",
          [](Window& self, const Stack& paths, const Numbers& log_weights, const Stack& means, const Stack& covariances) {
            Particles particles = self.particles();
            const std::size_t count = particles.count();
            check(log_weights.size() == count, "log_weights must be (M,)");
            check(paths.shape(0) == self.keyframes() && paths.shape(0) > 0, "paths must be (K, M, 3)");
            check(means.shape(1) == particles.landmarks(), "means must be (M, L, 2)");
            const std::span<const double> logs = log_weights_of(log_weights);
            Rows path = path_of(paths, count);
            for (std::size_t k = 0; k < 3; k++) particles.pose.set(k, path[path.rows() - 3 + k], 1);
            std::copy(logs.begin(), logs.end(), particles.log_weights.begin());
            particles.map = map_of(count, means, covariances);
            self.replace(std::move(particles), std::move(path));
          },
          "paths"_a, "log_weights"_a, "means"_a, "covariances"_a,
          "Replace the paths (K, M, 3), with the particles at their ends, the weights and the landmarks.")
      .def(
          "sensitivity",
          [](const Window& self, const Numbers& mean, bool with_nodes) {
            window::Sensitivity found = rounded_sensitivity(self, {mean.data(), mean.size()}, with_nodes);
            return std::tuple(made_matrix(std::move(found.rows)), made_matrix(std::move(found.curvature)), int(found.fault));
          },
          "mean"_a, "with_nodes"_a,
          "Differentiate the mean of `close`, or of `run` without nodes, by errors that windows share.\n\n"
          "Returns a row for each of bearing, clock_offset, forward_scale, range_offset and range_scale, by the window's smoother\n"
          "about the particles' mean path; rows of second derivatives, that of clock_offset with nodes, else zero; and the index in `gaussian.FAULTS` of why there are none.\n"
          "Numbers are in single precision, as in a message.")
      .def_prop_ro(
          "has_shifts",
          [](const Window& self) {
            const auto is_shifted = [](const window::WindowMotion& each) { return each.shift != std::array<double, 3>{}; };
            return std::any_of(self.motions().begin(), self.motions().end(), is_shifted);
          },
          "Whether an error of the scale of speed shifts one of the motions.")
      .def("of_base", &Window::of_base,
           "Copy the window as one of the base: poses and landmarks in the frame of the base's start.")
      .def("particles", [](const Window& self) { return made_particles(self.particles()); },
           "Copy (poses (M, 3), log_weights (M,), ids (L,), means (M, L, 2), covariances (M, L, 3)).")
      .def(
          "paths",
          [](const Window& self) {
            const Rows& path = self.path();
            const std::size_t M = path.count(), K = self.keyframes();
            std::vector<double> values(3 * K * M);
            for (std::size_t j = 0; j < 3 * K; j++)
              for (std::size_t i = 0; i < M; i++) values[(j / 3 * M + i) * 3 + j % 3] = path[j][i];
            return made<double, nb::ndim<3>>(std::move(values), {K, M, 3});
          },
          "Copy the pose (K, M, 3) of each particle's line of descent at each of the K keyframes.")
      .def(
          "mean_path",
          [](const Window& self) {
            std::vector<double> means;
            for (const auto& [x, y, heading] : self.mean_path()) means.insert(means.end(), {x, y, heading});
            return made<double, nb::ndim<2>>(std::move(means), {self.keyframes(), 3});
          },
          "Compute the weighted mean (K, 3) of the poses at each keyframe, headings on the circle.")
      .def(
          "measurements",
          [](const Window& self) {
            const std::span<const window::WindowMeasurement> taken = self.measurements();
            const std::size_t n = taken.size();
            const bool has_claims =
                std::any_of(taken.begin(), taken.end(), [](const window::WindowMeasurement& each) { return each.claim.is_made(); });
            std::vector<std::int64_t> keyframes;
            std::vector<std::uint32_t> ids;
            std::vector<double> measurements, own;
            for (const window::WindowMeasurement& each : taken) {
              keyframes.push_back(std::int64_t(each.keyframe));
              ids.push_back(each.id);
              measurements.insert(measurements.end(), {each.range, each.bearing});
              if (has_claims) own.insert(own.end(), {each.claim.rr, each.claim.rb, each.claim.bb, each.claim.form});
            }
            return std::tuple(Places{std::move(keyframes)},
                              made<std::uint32_t, nb::ndim<1>>(std::move(ids), {n}),
                              made<double, nb::ndim<2>>(std::move(measurements), {n, 2}),
                              made<double, nb::ndim<2>>(std::move(own), {n, has_claims ? 4u : 0u}));
          },
          "Copy the measurements: keyframes (N,), ids (N,), (range, bearing) (N, 2), and their own covariances\n"
          "(N, 4), or (N, 0).")
      .def(
          "ids",
          [](const Window& self) {
            const auto& ids = self.particles().ids;
            return made<std::uint32_t, nb::ndim<1>>(std::vector<std::uint32_t>(ids), {ids.size()});
          },
          "Copy the landmarks' numbers in order of first observation.")
      .def(
          "nodes",
          [](const Window& self) {
            const auto nodes = self.nodes();
            return Places{{nodes.begin(), nodes.end()}};
          },
          "Copy the keyframe of each pose node.")
      .def("node_stamps", &Window::node_stamps, "Copy the team time [ns] of each pose node.")
      .def_prop_ro(
          "innovated", [](const Window& self) { return std::tuple(self.innovated().squared, self.innovated().dof); },
          "Sum of the innovations of all keyframes: NIS, and its degrees of freedom.")
      .def_prop_ro("landmarks", [](const Window& self) { return self.particles().landmarks(); }, "Number of landmarks.")
      .def_prop_ro("keyframes", &Window::keyframes, "Number of keyframes.");
}

}  // namespace teamslam::binding
