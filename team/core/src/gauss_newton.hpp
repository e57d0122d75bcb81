// A Gauss-Newton step that lowers the cost, shortened or damped (Levenberg 1944, Marquardt 1963).
#pragma once

#include <optional>
#include <vector>

#include "elementary.hpp"

namespace teamslam::gauss_newton {

inline constexpr double LEAST_DAMPING = 1e-4;  // below it a step is undamped
inline constexpr double ROUNDING = 1e-10;      // relative rise of the cost that is rounding near the minimum

// state: empty where no step lowers the cost; then the damping is infinite. damping: for the next step.
// change: the largest change of a number by the full step, or by the first one where none lowers the cost;
// NaN where a number or the step is undetermined. cost: of the state.
struct Step {
  std::vector<double> state;
  double damping, change, cost;
};

// Takes the step at this damping if it lowers the cost; else, if undamped, its half, and so on; else a more
// damped one, up to most_damping.
//
// step_at(damping): the full step, none where it is undetermined. moved(step, share): the state after a
// share of it. before: the cost of the state before.
template <class StepAt, class Moved, class CostOf>
Step take_step(double damping, int halvings, double most_damping, double before, StepAt&& step_at, Moved&& moved,
               CostOf&& cost_of) {
  std::optional<double> refused;
  while (damping < most_damping) {
    const std::optional<std::vector<double>> step = step_at(damping);
    if (!step) return {{}, damping, elementary::NOT_A_NUMBER, before};
    double largest = 0.0;
    for (const double x : *step)
      if (largest == largest && !(pack::abs(x) <= largest)) largest = pack::abs(x);  // NaN stays
    double share = 1.0;
    for (int k = 0; k <= (damping > 0.0 ? 0 : halvings); k++, share *= 0.5) {
      std::vector<double> after = moved(*step, share);
      const double cost = cost_of(after);
      if (cost <= before * (1.0 + ROUNDING) + ROUNDING)
        return {std::move(after), damping > LEAST_DAMPING ? damping / 10.0 : 0.0, largest, cost};
    }
    if (!refused) refused = largest;
    damping = pack::max(10.0 * damping, LEAST_DAMPING);
  }
  return {{}, elementary::INF, refused.value_or(elementary::INF), before};
}

}  // namespace teamslam::gauss_newton
