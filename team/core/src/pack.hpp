// Lanes side by side: a formula is written once for a type T, a double or a Pack.
//
// A Pack holds one quantity of WIDTH particles. No lane reads another, so neither the width of a
// register nor a particle's place changes a bit. The two builds of this library differ in WIDTH
// only: 2 doubles per register on x86-64-v2, 4 with AVX2.
#pragma once

#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstring>

#if defined(__SSE4_1__)
#include <immintrin.h>
#endif

namespace teamslam::pack {

#if defined(__AVX__)
inline constexpr std::size_t IN_REGISTER = 4;
#else
inline constexpr std::size_t IN_REGISTER = 2;
#endif
#if defined(__clang__)  // two chains of operations fill the pipeline; g++ 12 gains nothing by them
inline constexpr std::size_t REGISTERS = 2;
#else
inline constexpr std::size_t REGISTERS = 1;
#endif
inline constexpr std::size_t WIDTH = IN_REGISTER * REGISTERS;
// Rows are padded to whole multiples of LANES, and a sum over particles goes by LANES partial sums,
// whatever WIDTH is.
inline constexpr std::size_t LANES = 16;
static_assert(LANES % WIDTH == 0);

inline constexpr std::size_t padded(std::size_t count) { return (count + LANES - 1) / LANES * LANES; }

typedef double Numbers __attribute__((vector_size(8 * IN_REGISTER)));
typedef std::int64_t Integers __attribute__((vector_size(8 * IN_REGISTER)));

template <class Register, class Lane>
struct Parts {
  Register part[REGISTERS];

  Parts() = default;
  Parts(Lane x) : Parts(of([&](std::size_t) { return x - Register{}; })) {}

  template <class F>
  static Parts of(F&& register_of) {
    Parts made;
#pragma GCC unroll 4
    for (std::size_t i = 0; i < REGISTERS; i++) made.part[i] = register_of(i);
    return made;
  }
};

using Pack = Parts<Numbers, double>;
using PackBits = Parts<Integers, std::int64_t>;  // bits of a Pack; as a mask all or none of a lane

#define TEAMSLAM_LANEWISE(op, P) \
  inline P operator op(const P& a, const P& b) { return P::of([&](std::size_t i) { return a.part[i] op b.part[i]; }); }
TEAMSLAM_LANEWISE(+, Pack)
TEAMSLAM_LANEWISE(-, Pack)
TEAMSLAM_LANEWISE(*, Pack)
TEAMSLAM_LANEWISE(/, Pack)
TEAMSLAM_LANEWISE(&, PackBits)
TEAMSLAM_LANEWISE(|, PackBits)
TEAMSLAM_LANEWISE(^, PackBits)
TEAMSLAM_LANEWISE(+, PackBits)
#undef TEAMSLAM_LANEWISE

#define TEAMSLAM_COMPARISON(op)                                                              \
  inline PackBits operator op(const Pack& a, const Pack& b) {                                \
    return PackBits::of([&](std::size_t i) { return Integers(a.part[i] op b.part[i]); });    \
  }
TEAMSLAM_COMPARISON(<)
TEAMSLAM_COMPARISON(>)
TEAMSLAM_COMPARISON(>=)
TEAMSLAM_COMPARISON(==)
#undef TEAMSLAM_COMPARISON

inline Pack operator-(const Pack& a) { return Pack::of([&](std::size_t i) { return -a.part[i]; }); }
inline PackBits operator~(const PackBits& a) { return PackBits::of([&](std::size_t i) { return ~a.part[i]; }); }
inline PackBits operator<<(const PackBits& a, int n) { return PackBits::of([&](std::size_t i) { return a.part[i] << n; }); }
inline PackBits operator>>(const PackBits& a, int n) { return PackBits::of([&](std::size_t i) { return a.part[i] >> n; }); }
inline Pack& operator+=(Pack& a, const Pack& b) { return a = a + b; }
inline Pack& operator-=(Pack& a, const Pack& b) { return a = a - b; }
inline Pack& operator*=(Pack& a, const Pack& b) { return a = a * b; }

// The bits of a T, and the same bits as another type.
template <class T> struct BitsOf { using type = PackBits; };
template <> struct BitsOf<double> { using type = std::int64_t; };
template <class T> using Bits = typename BitsOf<T>::type;
template <class To> inline To bits_as(double x) { return __builtin_bit_cast(To, x); }
template <class To> inline To bits_as(std::int64_t x) { return __builtin_bit_cast(To, x); }
template <class To> inline To bits_as(const Pack& x) { return To::of([&](std::size_t i) { return (Integers)x.part[i]; }); }
template <class To> inline To bits_as(const PackBits& x) { return To::of([&](std::size_t i) { return (Numbers)x.part[i]; }); }

// chosen ? a : b in each lane; of a Pack both are computed.
inline double select(bool chosen, double a, double b) { return chosen ? a : b; }
inline Pack select(const PackBits& chosen, const Pack& a, const Pack& b) {
  return Pack::of([&](std::size_t i) { return chosen.part[i] ? a.part[i] : b.part[i]; });
}
inline bool negation(bool chosen) { return !chosen; }
inline PackBits negation(const PackBits& chosen) { return ~chosen; }
inline bool any(bool chosen) { return chosen; }
inline bool any(const PackBits& chosen) {
  std::int64_t found = 0;
  for (const Integers& part : chosen.part)
    for (std::size_t i = 0; i < IN_REGISTER; i++) found |= part[i];
  return found != 0;
}

inline double sqrt(double x) { return __builtin_sqrt(x); }
inline double floor(double x) { return __builtin_floor(x); }

inline Numbers sqrt(Numbers x) {
#if defined(__AVX__)
  return (Numbers)_mm256_sqrt_pd((__m256d)x);
#elif defined(__SSE4_1__)
  return (Numbers)_mm_sqrt_pd((__m128d)x);
#else
  for (std::size_t i = 0; i < IN_REGISTER; i++) x[i] = __builtin_sqrt(x[i]);
  return x;
#endif
}
inline Numbers floor(Numbers x) {
#if defined(__AVX__)
  return (Numbers)_mm256_floor_pd((__m256d)x);
#elif defined(__SSE4_1__)
  return (Numbers)_mm_floor_pd((__m128d)x);
#else
  for (std::size_t i = 0; i < IN_REGISTER; i++) x[i] = __builtin_floor(x[i]);
  return x;
#endif
}
inline Pack sqrt(const Pack& x) { return Pack::of([&](std::size_t i) { return sqrt(x.part[i]); }); }
inline Pack floor(const Pack& x) { return Pack::of([&](std::size_t i) { return floor(x.part[i]); }); }

inline constexpr std::int64_t SIGN = INT64_MIN, MAGNITUDE = INT64_MAX;
inline double abs(double x) { return std::fabs(x); }
inline double copysign(double x, double sign) { return std::copysign(x, sign); }
inline Pack abs(const Pack& x) { return bits_as<Pack>(bits_as<PackBits>(x) & MAGNITUDE); }
inline Pack copysign(const Pack& x, const Pack& sign) {
  return bits_as<Pack>((bits_as<PackBits>(x) & MAGNITUDE) | (bits_as<PackBits>(sign) & SIGN));
}
// Where one of both is not a number it is a, unlike std::fmin.
template <class T> inline T min(T a, T b) { return select(b < a, b, a); }
template <class T> inline T max(T a, T b) { return select(b > a, b, a); }
template <class T> inline T all(double x) { return T(x); }

inline Pack load(const double* from) {
  return Pack::of([&](std::size_t i) {
    Numbers x;
    std::memcpy(&x, from + i * IN_REGISTER, sizeof x);
    return x;
  });
}
inline void store(double* to, const Pack& x) {
#pragma GCC unroll 4
  for (std::size_t i = 0; i < REGISTERS; i++) std::memcpy(to + i * IN_REGISTER, &x.part[i], sizeof(Numbers));
}

// A sum over particles by LANES partial sums, which are added in pairs at the end.
struct LaneSum {
  Pack part[LANES / WIDTH] = {};

  double value() const {
    double lanes[LANES];
    for (std::size_t q = 0; q < LANES / WIDTH; q++) store(lanes + q * WIDTH, part[q]);
    for (std::size_t half = LANES / 2; half; half /= 2)
      for (std::size_t j = 0; j < half; j++) lanes[j] += lanes[j + half];
    return lanes[0];
  }
};

}  // namespace teamslam::pack
