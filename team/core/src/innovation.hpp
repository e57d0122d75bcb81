// The innovations of a scan, and their normalised square (NIS). Bar-Shalom, Li and Kirubarajan 2001,
// section 5.4.2.
#pragma once

#include "particles.hpp"

namespace teamslam::window {

// squared: νᵀ S⁻¹ ν, χ² of as many degrees of freedom as `error` has numbers; NaN where a pivot of S
// is not above rounding. error, S: of the measurements that were predicted, as (range, bearing, …).
struct Innovation {
  double squared = 0.0;
  std::vector<double> error, S;
};

// ν = z − ẑ in the metric of the joint predictive covariance S, before the scan's measurements.
//
// The particles predict the mixture Σ wᵢ N(ẑᵢ, Sᵢ) of all measurements of landmarks that they know;
// ẑ and S are its moments, bearings on the circle:
//
//     ẑᵢ = h(poseᵢ ∘ mean, landmarks),  Sᵢ = Hₓ Q Hₓᵀ + Hₗ Σᵢ Hₗᵀ + R,
//     S = Σ wᵢ (Sᵢ + dᵢ dᵢᵀ),  dᵢ = ẑᵢ − ẑ,  Q = L Lᵀ.
//
// A first sight has a flat prior and is left out. slots: of the scan's landmarks, as of `slot_of`.
Innovation innovation_of(const Particles& particles, const Motion& motion, const Lower3& L,
                         std::span<const std::size_t> slots, std::span<const Reading> readings);

}  // namespace teamslam::window
