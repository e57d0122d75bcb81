// Inputs and the hash of the programs tests/core/bits*.cpp.
//
// Inputs come from a generator of their own, since those of the standard library differ between
// libraries. Draw one number per statement, or within braces: C++ leaves the order of arguments open.
#pragma once

#include <cstdint>
#include <cstdio>
#include <span>

namespace teamslam::bits {

inline std::uint64_t state = 20210917;
inline constexpr std::uint64_t EMPTY = 1469598103934665603u;
inline std::uint64_t hash = EMPTY;

inline double uniform() {  // in [0, 1): Knuth's MMIX generator
  state = state * 6364136223846793005u + 1442695040888963407u;
  return double(state >> 11) * 0x1p-53;
}

inline double centred() { return uniform() - 0.5; }  // in [-1/2, 1/2)

inline double normal() {
  double sum = -6.0;
  for (int k = 0; k < 12; k++) sum += uniform();
  return sum;
}

inline void add(double x) {  // FNV-1a
  std::uint64_t bits = __builtin_bit_cast(std::uint64_t, x);
  for (int k = 0; k < 8; k++, bits >>= 8) hash = (hash ^ (bits & 255)) * 1099511628211u;
}

inline void add(std::span<const double> numbers) {
  for (const double x : numbers) add(x);
}

inline void print() { std::printf("%016llx\n", static_cast<unsigned long long>(hash)); }

}  // namespace teamslam::bits
