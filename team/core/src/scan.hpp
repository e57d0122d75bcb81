// Observations of landmarks, each N(point, spread), about one place and about two.
#pragma once

#include <cstdint>
#include <optional>
#include <vector>

#include "dense.hpp"

namespace teamslam::scan {

using Index = std::int64_t;

// points: (x, y) of each observation; spread: (xx, xy, yy). most: what a wild one adds to a sum of χ².
struct Observed {
  dense::Const points, spread;
  double most;
};

// Σ χ² of each landmark's observations about their median. of: the landmark of each observation, below `count`.
std::vector<double> scatter(const Observed& observed, std::span<const Index> of, std::size_t count);

// before: the number of observations at the first place. gain: Σ χ² about one place less that about two.
struct Change {
  Index before;
  double gain;
};

// Of one landmark's observations by time: where its place changes most, with at least `least` ≥ 1 on each
// side; none with too few. The places are medians.
std::optional<Change> change(const Observed& observed, std::size_t least);

}  // namespace teamslam::scan
