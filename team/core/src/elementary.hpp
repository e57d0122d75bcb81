// Sine, logarithm and the like, with the same bits on every processor.
//
// A C library takes other paths on other processors. These functions are sums, products, quotients
// and square roots in one order, so IEEE 754 leaves one result. Their errors, in units of the last
// place, are what tests/core/test_elementary.py finds them to be against forty digits. Reductions by
// Cody and Waite 1980; coefficients of fdlibm (Sun Microsystems 1993).
#pragma once

#include <limits>

#include "pack.hpp"

namespace teamslam::elementary {

using pack::all, pack::Bits, pack::bits_as, pack::copysign, pack::floor, pack::max, pack::min, pack::select;

inline constexpr double PI = 3.141592653589793, TWO_PI = 2.0 * PI;
inline constexpr double INF = std::numeric_limits<double>::infinity();
inline constexpr double NOT_A_NUMBER = std::numeric_limits<double>::quiet_NaN();
inline constexpr double EPSILON = std::numeric_limits<double>::epsilon();
// π/2 in three parts, the first two of 33 bits: products with integers below 2²⁰ are exact.
inline constexpr double PI_2_1 = 1.57079632673412561417, PI_2_2 = 6.07710050630396597660e-11,
                        PI_2_3 = 2.02226624879595063154e-21;
inline constexpr double FARTHEST = 1e6;  // angles beyond it are taken modulo the double nearest to 2π
inline constexpr double PI_LOW = 1.2246467991473532072e-16;  // π less the double nearest to it
inline constexpr double LN2 = 0.6931471805599453, PER_LN2 = 1.4426950408889634;
inline constexpr double LN2_HIGH = 6.93147180369123816490e-01, LN2_LOW = 1.90821492927058770002e-10;
inline constexpr double SPLIT = 134217729.0;  // 2²⁷ + 1: parts a double into halves (Veltkamp)

template <class T>
struct SineCosine {
  T sine, cosine;
};

// Sine and cosine of an angle of at most FARTHEST [rad], without a branch.
template <class T>
inline SineCosine<T> sin_cos_near(T angle) {
  const T quarters = floor(angle * (2.0 / PI) + 0.5);
  const T first = angle - quarters * PI_2_1, second = quarters * PI_2_2;
  const T high = first - second, back = first - high;
  const T low = (first - (high + back)) + (back - second) - quarters * PI_2_3;
  const T x = high + low, y = low - (x - high), z = x * x;
  T r = 8.33333333332248946124e-03 +
        z * (-1.98412698298579493134e-04 +
             z * (2.75573137070700676789e-06 + z * (-2.50507602534068634195e-08 + z * 1.58969099521155010221e-10)));
  const T sine = x - ((z * (0.5 * y - z * x * r) - y) - z * x * -1.66666666666666324348e-01);
  r = z * (4.16666666666666019037e-02 + z * (-1.38888888888741095749e-03 + z * 2.48015872894767294178e-05)) +
      z * z * z * z * (-2.75573143513906633035e-07 + z * (2.08757232129817482790e-09 + z * -1.13596475577881948265e-11));
  const T half = 0.5 * z, w = 1.0 - half;
  const T cosine = w + (((1.0 - w) - half) + (z * r - x * y));
  const T quarter = quarters - 4.0 * floor(0.25 * quarters);
  const auto one = quarter == 1.0, two = quarter == 2.0, three = quarter == 3.0;
  const T s = select(one | three, cosine, sine), c = select(one | three, sine, cosine);
  return {select(two | three, -s, s), select(one | two, -c, c)};
}

// An angle of at most FARTHEST [rad] of the same direction; NaN of what is not finite.
inline double near(double angle) { return std::fabs(angle) > FARTHEST ? std::fmod(angle, TWO_PI) : angle; }

inline SineCosine<double> sin_cos(double angle) { return sin_cos_near(near(angle)); }

inline double sin(double angle) { return sin_cos(angle).sine; }
inline double cos(double angle) { return sin_cos(angle).cosine; }
inline double tan(double angle) {
  const auto [s, c] = sin_cos(angle);
  return s / c;
}

// atan2(y, x) of y ≥ 0, the larger coordinate in 1e-240 … 1e270, without a branch.
//
// With the smaller coordinate over the larger one, turned by π/4 if that exceeds tan(π/8), it is
// C ± atan(q), |q| ≤ tan(π/8), C a multiple of π/4. What rounding takes from q is computed (Dekker
// 1971) and goes into the sum.
template <class T>
inline T direction_near(T y, T x) {
  const T ax = pack::abs(x), ay = y;
  const auto steep = ay > ax;
  T n = min(ax, ay), d = max(ax, ay);
  const auto turned = n > 0.4142135623730950488 * d;
  const T difference = n - d, total = n + d;
  const T lost_n = select(turned, n - (difference + d), 0.0), lost_d = select(turned, n - (total - d), 0.0);
  n = select(turned, difference, n);
  d = select(turned, total, d);
  T q = n / d;
  T wide = SPLIT * q;
  const T q1 = wide - (wide - q);
  wide = SPLIT * d;
  const T d1 = wide - (wide - d), q2 = q - q1, d2 = d - d1;
  const T product = q * d;
  const T lost = ((q1 * d1 - product) + q1 * d2 + q2 * d1) + q2 * d2;
  T rest = (((n - product) - lost) + (lost_n - q * lost_d)) / d;
  const T z = q * q, w = z * z;
  const T odd =
      z * (3.33333333333329318027e-01 +
           w * (1.42857142725034663711e-01 +
                w * (9.09088713343650656196e-02 +
                     w * (6.66107313738753120669e-02 + w * (4.97687799461593236017e-02 + w * 1.62858201153657823623e-02)))));
  const T even =
      w * (-1.99999999998764832476e-01 +
           w * (-1.11111104054623557880e-01 +
                w * (-7.69187620504482999495e-02 + w * (-5.83357013379057348645e-02 + w * -3.65315727442169155270e-02))));
  rest = rest * (1.0 - z + w) - q * (odd + even);
  T eighths = select(turned, all<T>(1.0), all<T>(0.0));
  T sign = select(steep, all<T>(-1.0), all<T>(1.0));
  eighths = select(steep, 2.0 - eighths, eighths);
  const T behind = copysign(all<T>(1.0), x);
  sign *= behind;
  eighths = select(behind < 0.0, 4.0 - eighths, eighths);
  const T high = eighths * (0.25 * PI);
  q *= sign;
  const T angle = high + q;
  return angle + (((high - angle) + q) + (eighths * (0.25 * PI_LOW) + sign * rest));
}

// The direction of (x, y) in [−π, π], signs of zeros as in IEEE 754.
inline double atan2(double y, double x) {
  if (x != x || y != y) return NOT_A_NUMBER;
  double ax = std::fabs(x), ay = std::fabs(y);
  const double larger = max(ax, ay);
  if (larger > 1e270 || larger < 1e-240) {
    if (larger == INF) {
      ax = ax == INF ? 1.0 : 0.0;
      ay = ay == INF ? 1.0 : 0.0;
    } else if (larger == 0.0) {
      ax = 1.0;
    } else {
      const double scale = larger > 1.0 ? 0x1p-700 : 0x1p300;
      ax *= scale;
      ay *= scale;
    }
  }
  return copysign(direction_near(ay, copysign(ax, x)), y);
}

// 2 to the power of an integer in −1022 … 1023, by its bits.
template <class T>
inline T power_of_two(T exponent) {
  return bits_as<T>(bits_as<Bits<T>>(T(exponent + (1023.0 + 0x1p52))) << 52);
}

// eˣ; 0 below −745.2, infinite above 709.8.
template <class T>
inline T exp(T x) {
  x = select(x == x, min(max(x, all<T>(-800.0)), all<T>(800.0)), x);
  const T k = floor(x * PER_LN2 + 0.5);
  const T high = x - k * LN2_HIGH, low = k * LN2_LOW, r = high - low, t = r * r;
  const T c = r - t * (1.66666666666666019037e-01 +
                       t * (-2.77777777770155933842e-03 +
                            t * (6.61375632143793436117e-05 + t * (-1.65339022054652515390e-06 + t * 4.13813679705723846039e-08))));
  const T y = 1.0 - ((low - (r * c) / (2.0 - c)) - high);
  const T half = floor(0.5 * k);
  return y * power_of_two(half) * power_of_two(T(k - half));
}

// The natural logarithm of a positive number that is neither subnormal nor infinite.
template <class T>
inline T log_of_normal(T x) {
  using B = Bits<T>;
  const B bits = bits_as<B>(x);
  const B above = ((bits & INT64_C(0x000FFFFFFFFFFFFF)) + INT64_C(0x95F6400000000)) & INT64_C(0x0010000000000000);
  const T exponent = bits_as<T>(B(((bits >> 52) + (above >> 52)) | INT64_C(0x4330000000000000)));
  const T k = exponent - (0x1p52 + 1023.0);
  T f = bits_as<T>(B((bits & INT64_C(0x000FFFFFFFFFFFFF)) | (above ^ INT64_C(0x3FF0000000000000))));
  f -= 1.0;
  const T s = f / (2.0 + f), z = s * s, w = z * z;
  const T even = w * (3.999999999940941908e-01 + w * (2.222219843214978396e-01 + w * 1.531383769920937332e-01));
  const T odd = z * (6.666666666666735130e-01 +
                     w * (2.857142874366239149e-01 + w * (1.818357216161805012e-01 + w * 1.479819860511658591e-01)));
  const T half = 0.5 * f * f;
  return k * LN2_HIGH - ((half - (s * (half + (even + odd)) + k * LN2_LOW)) - f);
}

// The natural logarithm; −∞ of 0, NaN of what is negative.
inline double log(double x) {
  if (x > 2.3e-308 && x < INF) return log_of_normal(x);
  if (x == 0.0) return -INF;
  if (!(x > 0.0) || x == INF) return x > 0.0 ? x : NOT_A_NUMBER;
  return log_of_normal(x * 0x1p54) - 54.0 * LN2;
}

// log(1 + x), x > −1, to the last places of a small x (Kahan).
inline double log1p(double x) {
  const double u = 1.0 + x;
  if (u == 1.0 || u == INF) return x;
  if (u == 0.0) return -INF;
  return log(u) + (x - (u - 1.0)) / u;
}

// eˣ − 1, to the last places of a small x (Kahan).
inline double expm1(double x) {
  const double u = exp(x);
  if (u == 1.0) return x;
  if (u == INF || u - 1.0 == -1.0) return u - 1.0;
  return (u - 1.0) * x / log(u);
}

// The length of (x, y); infinite where one of them is.
inline double hypot(double x, double y) {
  double ax = std::fabs(x), ay = std::fabs(y);
  const double larger = max(ax, ay);
  if (larger == INF || ay == INF) return INF;
  if (larger > 1e150 || larger < 1e-140) {
    const double scale = larger > 1.0 ? 0x1p-600 : 0x1p600;
    ax *= scale;
    ay *= scale;
    return pack::sqrt(ax * ax + ay * ay) / scale;
  }
  return pack::sqrt(ax * ax + ay * ay);
}

// The probability that a standard normal variable stays below x: ½ + φ(x) (x + x³/3 + x⁵/15 + …),
// Marsaglia 2004; 0 and 1 beyond ±9.
inline double normal_below(double x) {
  if (!(std::fabs(x) < 9.0)) return x != x ? x : x > 0.0 ? 1.0 : 0.0;
  double term = x, total = x, k = 1.0;
  while (std::fabs(term) > 1e-17 * std::fabs(total)) {
    k += 2.0;
    term *= x * x / k;
    total += term;
  }
  const double density = exp(-0.5 * x * x) / pack::sqrt(TWO_PI);
  return min(max(0.5 + density * total, 0.0), 1.0);
}

}  // namespace teamslam::elementary
