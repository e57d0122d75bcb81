// When a Gauss-Newton step is accepted, and the damping of the next one (Levenberg 1944, Marquardt 1963).
#pragma once

#include "pack.hpp"

namespace teamslam::gauss_newton {

inline constexpr double LEAST_DAMPING = 1e-4;  // below it a step is undamped
inline constexpr double ROUNDING = 1e-10;      // relative rise of the cost that is rounding near the minimum

inline bool is_accepted(double cost, double before) { return cost <= before * (1.0 + ROUNDING) + ROUNDING; }
inline double lower_damping(double damping) { return damping > LEAST_DAMPING ? damping / 10.0 : 0.0; }
inline double raise_damping(double damping) { return pack::max(10.0 * damping, LEAST_DAMPING); }

}  // namespace teamslam::gauss_newton
