// Random numbers with defined bits, keyed by their use: Philox 4x64-10 (Salmon et al. 2011).
//
// A counter-based generator has no state but its key and the number of blocks drawn: each block of
// four numbers is a function of both. Normal numbers are those of Box and Muller 1958.
#pragma once

#include <algorithm>
#include <array>
#include <cstdint>
#include <vector>

#include "elementary.hpp"

namespace teamslam::random {

class Random {
 public:
  using Block = std::array<std::uint64_t, 4>;

  explicit Random(const std::array<std::uint64_t, 2>& key) : key_(key) {}

  // The block of a counter: ten rounds of two products of 64 bits each.
  Block block(std::uint64_t counter) const {
    Block x{counter, 0, 0, 0};
    std::uint64_t k0 = key_[0], k1 = key_[1];
    for (int round = 0; round < 10; round++) {
      const Product p = Product(0xD2E7470EE14C6C93u) * x[0], q = Product(0xCA5A826395121157u) * x[2];
      x = {std::uint64_t(q >> 64) ^ x[1] ^ k0, std::uint64_t(q), std::uint64_t(p >> 64) ^ x[3] ^ k1, std::uint64_t(p)};
      k0 += 0x9E3779B97F4A7C15u;
      k1 += 0xBB67AE8584CAA73Bu;
    }
    return x;
  }

  // A number in [0, 1), a multiple of 2⁻⁵³; takes a block.
  double uniform() { return double(block(++counter_)[0] >> 11) * 0x1p-53; }

  // Standard normal numbers. They are made sixteen at a time, whatever the width of a pack; those of
  // a last block that are not asked for are dropped.
  std::vector<double> normals(std::size_t asked) {
    std::vector<double> out(asked);
    constexpr std::size_t HALF = pack::LANES / 2;
    for (std::size_t begin = 0; begin < out.size(); begin += pack::LANES) {
      double numbers[pack::LANES];
      for (std::size_t i = 0; i < pack::LANES; i += 4) {
        const Block bits = block(++counter_);
        for (std::size_t j = 0; j < 4; j++) numbers[i + j] = (double(bits[j] >> 11) + 0.5) * 0x1p-53;
      }
      for (std::size_t i = 0; i < HALF; i += pack::WIDTH) {
        const pack::Pack log = elementary::log_of_normal(pack::load(numbers + i));
        const pack::Pack radius = pack::sqrt(-2.0 * log);
        const auto [sine, cosine] = elementary::sin_cos_near(elementary::TWO_PI * pack::load(numbers + HALF + i));
        pack::store(numbers + i, radius * cosine);
        pack::store(numbers + HALF + i, radius * sine);
      }
      const std::size_t count = std::min(pack::LANES, out.size() - begin);
      std::copy(numbers, numbers + count, out.begin() + std::ptrdiff_t(begin));
    }
    return out;
  }

 private:
  using Product = unsigned __int128;

  std::array<std::uint64_t, 2> key_;
  std::uint64_t counter_ = 0;
};

}  // namespace teamslam::random
