// BLAKE2b (Saarinen and Aumasson 2015, RFC 7693) without a key: digests without a library of cryptography,
// which would be a fifteenth of a robot's memory.
#pragma once

#include <algorithm>
#include <array>
#include <bit>
#include <cstdint>
#include <span>

namespace teamslam::blake2b {

// The number of eight bytes, the least first.
inline std::uint64_t word_of(const char* bytes) {
  std::uint64_t word = 0;
  for (int i = 7; i >= 0; i--) word = word << 8 | static_cast<unsigned char>(bytes[i]);
  return word;
}

class Hash {
 public:
  static constexpr std::size_t MOST = 64, PERSON = 16;

  // size: of the digest, 1 … MOST bytes; person: at most PERSON bytes, which separate uses.
  Hash(std::size_t size, std::span<const char> person) : size_(size) {
    std::array<char, 64> parameters{char(size), 0, 1, 1};  // one leaf
    std::copy(person.begin(), person.end(), parameters.begin() + 48);
    for (std::size_t i = 0; i < 8; i++) state_[i] = START[i] ^ word_of(&parameters[8 * i]);
  }

  std::size_t size() const { return size_; }

  void update(std::span<const char> data) {
    while (!data.empty()) {
      if (filled_ == block_.size()) compress(0);
      const std::size_t count = std::min(block_.size() - filled_, data.size());
      std::copy_n(data.begin(), count, block_.begin() + std::ptrdiff_t(filled_));
      filled_ += count;
      data = data.subspan(count);
    }
  }

  // The digest of all so far: the first `size` bytes.
  std::array<char, MOST> digest() const {
    Hash last = *this;
    std::fill(last.block_.begin() + std::ptrdiff_t(filled_), last.block_.end(), '\0');
    last.compress(~std::uint64_t(0));
    std::array<char, MOST> bytes;
    for (std::size_t i = 0; i < MOST; i++) bytes[i] = char(last.state_[i / 8] >> (8 * (i % 8)));
    return bytes;
  }

 private:
  static constexpr std::array<std::uint64_t, 8> START = {
      0x6a09e667f3bcc908, 0xbb67ae8584caa73b, 0x3c6ef372fe94f82b, 0xa54ff53a5f1d36f1,
      0x510e527fade682d1, 0x9b05688c2b3e6c1f, 0x1f83d9abfb41bd6b, 0x5be0cd19137e2179};
  static constexpr std::uint8_t ORDER[10][16] = {
      {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15}, {14, 10, 4, 8, 9, 15, 13, 6, 1, 12, 0, 2, 11, 7, 5, 3},
      {11, 8, 12, 0, 5, 2, 15, 13, 10, 14, 3, 6, 7, 1, 9, 4}, {7, 9, 3, 1, 13, 12, 11, 14, 2, 6, 5, 10, 4, 0, 15, 8},
      {9, 0, 5, 7, 2, 4, 10, 15, 14, 1, 11, 12, 6, 8, 3, 13}, {2, 12, 6, 10, 0, 11, 8, 3, 4, 13, 7, 5, 15, 14, 1, 9},
      {12, 5, 1, 15, 14, 13, 4, 10, 0, 7, 6, 3, 9, 2, 8, 11}, {13, 11, 7, 14, 12, 1, 3, 9, 5, 0, 15, 4, 8, 6, 2, 10},
      {6, 15, 14, 9, 11, 3, 0, 8, 12, 2, 13, 7, 1, 4, 10, 5}, {10, 2, 8, 4, 7, 6, 1, 5, 15, 11, 9, 14, 3, 12, 13, 0}};

  // Takes the block into the state; last: all ones for the last block, else 0.
  void compress(std::uint64_t last) {
    count_ += filled_;
    filled_ = 0;
    std::uint64_t v[16], m[16];
    for (std::size_t i = 0; i < 16; i++) m[i] = word_of(&block_[8 * i]), v[i] = i < 8 ? state_[i] : START[i - 8];
    v[12] ^= count_;
    v[14] ^= last;
    const auto mix = [&](int a, int b, int c, int d, std::uint64_t x, std::uint64_t y) {
      v[a] += v[b] + x;
      v[d] = std::rotr(v[d] ^ v[a], 32);
      v[c] += v[d];
      v[b] = std::rotr(v[b] ^ v[c], 24);
      v[a] += v[b] + y;
      v[d] = std::rotr(v[d] ^ v[a], 16);
      v[c] += v[d];
      v[b] = std::rotr(v[b] ^ v[c], 63);
    };
    for (int round = 0; round < 12; round++) {
      const std::uint8_t* at = ORDER[round % 10];
      for (int i = 0; i < 4; i++) mix(i, 4 + i, 8 + i, 12 + i, m[at[2 * i]], m[at[2 * i + 1]]);
      for (int i = 0; i < 4; i++)
        mix(i, 4 + (i + 1) % 4, 8 + (i + 2) % 4, 12 + (i + 3) % 4, m[at[8 + 2 * i]], m[at[9 + 2 * i]]);
    }
    for (std::size_t i = 0; i < 8; i++) state_[i] ^= v[i] ^ v[i + 8];
  }

  std::size_t size_, filled_ = 0;
  std::uint64_t count_ = 0;  // of bytes in the state
  std::array<std::uint64_t, 8> state_;
  std::array<char, 128> block_;
};

}  // namespace teamslam::blake2b
