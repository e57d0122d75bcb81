// FastSLAM with known data association: particles over paths, an EKF for each landmark of each.
//
// p(path, landmarks | z) = p(path | z) Π p(landmark | path, z): the first factor is the weighted
// particles, the second the landmarks' 2 × 2 Gaussians. Montemerlo 2003; Thrun et al. 2005, ch. 13.
#pragma once

#include <initializer_list>

#include "proposal.hpp"
#include "rows.hpp"

namespace teamslam::window {

using models::Claim, models::Noise, models::Reading;
using se2::Directed, se2::Motion;

// One measurement of a scan: the slot of its landmark, and whether it is its first sight.
struct ScanMeasurement {
  std::size_t slot;
  bool is_known, is_first;  // is_known: from before the scan
  Reading reading;
};

// 1/Σ w² of normalised log weights.
double effective_sample_size(std::span<const double> log_weights);

// Subtracts log Σ w from each log weight and returns it; the largest weight is factored out.
double normalise(std::span<double> log_weights);

// Systematic resampling: particle i is copied ⌊M w_i⌋ or ⌈M w_i⌉ times, M w_i on average.
//
// The M points (k + uniform)/M fall into the intervals of the cumulated weights; 0 ≤ uniform < 1.
// Kitagawa 1996; Thrun et al. 2005, table 4.4.
std::vector<std::size_t> systematic_parents(std::span<const double> log_weights, double uniform);

struct Particles {
  explicit Particles(std::size_t count);

  std::size_t count() const { return pose.count(); }
  std::size_t stride() const { return pose.stride(); }
  std::size_t landmarks() const { return ids.size(); }

  // The slot of a landmark; as many as there are landmarks where it is not known.
  std::size_t slot_of(std::uint32_t id) const;

  Landmark<pack::Pack> landmark(std::size_t slot, std::size_t at) const {
    const double* row = map[5 * slot] + at;
    const std::size_t stride = map.stride();
    const auto load = [&](std::size_t k) { return pack::load(row + k * stride); };
    return {load(0), load(1), load(2), load(3), load(4)};
  }
  void set_landmark(std::size_t slot, std::size_t at, const Landmark<pack::Pack>& landmark) {
    double* row = map[5 * slot] + at;
    for (const pack::Pack& each : {landmark.x, landmark.y, landmark.xx, landmark.xy, landmark.yy}) {
      pack::store(row, each);
      row += map.stride();
    }
  }
  se2::Pose<pack::Pack> pose_at(std::size_t at) const {
    return {pack::load(pose[0] + at), pack::load(pose[1] + at), pack::load(pose[2] + at)};
  }

  // Equal weights.
  void forget_weights();

  // Copies each particle from its parent, with its numbers in other rows; equal weights.
  void resample(double uniform, std::initializer_list<Rows*> others);

  // Finds the scan's landmarks, and makes room for those that are new.
  std::vector<ScanMeasurement> find(std::span<const std::uint32_t> ids, std::span<const Reading> readings);

  // Poses pose ∘ motion ∘ Exp(L ε), then every landmark of the scan given them.
  //
  // ε is drawn from the prior N(0, I) (FastSLAM 1.0) or, `improved`, from N(m, A Aᵀ): the prior
  // conditioned on the measurements of known landmarks one after another, each linearised where the
  // ones before it have brought m (FastSLAM 2.0). Added to the log weights, at the sampled pose:
  //
  //     log p(z | pose, landmarks marginalised) + log N(ε; 0, I) − log N(ε; m, A Aᵀ).
  //
  // A first sight has a flat prior and adds nothing; a second measurement of it in the same scan
  // updates it, but has no part in the proposal. normals: (M, 3).
  void step(const Motion& motion, const Lower3& L, bool improved, std::span<const ScanMeasurement> scan,
            std::span<const double> normals);

  Rows pose;                        // x [m], y [m], heading [rad]
  std::vector<double> log_weights;  // padded as the rows are, with −∞
  std::vector<std::uint32_t> ids;   // in order of first sight
  Rows map;                         // of each slot x, y [m], xx, xy, yy [m²]
};

}  // namespace teamslam::window
