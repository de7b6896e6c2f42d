// Elementary functions, to a few units in the last place, by +, -, *, / and square roots alone: lanes can compute them,
// and kernels use no C library.
#pragma once
#include "numbers.hpp"

MAGLOC_BEGIN
// The arc tangent. tan(a/2) = t/(1 + sqrt(1 + t^2)) halves the angle until its series converges fast.
template <class T>
inline T arc_tangent(T x) {
  const T size = choose(x < 0.0, -x, x), inverse = 1.0 / size;
  T t = choose(size > 1.0, inverse, size);
  for (int halving = 0; halving < 2; ++halving) t = t / (1.0 + square_root(1.0 + t * t));  // at most tan(pi/16)
  const T square = t * t;
  T series{};
  for (int k = 25; k >= 1; k -= 2) series = 1.0 / k - square * series;
  const T angle = 4.0 * t * series;
  constexpr double right_angle = 1.5707963267948966;
  const T positive = choose(size > 1.0, right_angle - angle, angle);
  return choose(x < 0.0, -positive, positive);
}

// The angle of the vector (x, y), from -pi to pi; zero of a vector that is zero.
template <class T>
inline T arc_tangent(T y, T x) {
  constexpr double pi = 3.141592653589793;
  const T height = absolute(y), width = absolute(x), acute = arc_tangent(height / width);
  const T angle = choose(height + width > 0.0, choose(x < 0.0, pi - acute, acute), height + width);
  return choose(y < 0.0, -angle, angle);
}

// The hyperbolic tangent of a number that is not negative. tanh(2x) = 2t/(1 + t^2) doubles a small one.
template <class T>
inline T hyperbolic_tangent(T x) {
  constexpr int doublings = 6;
  const T small = choose(x > 20.0, broadcast<T>(20.0), x) * (1.0 / (1 << doublings)), square = small * small;
  T fraction = broadcast<T>(15.0);
  for (int odd = 13; odd >= 1; odd -= 2) fraction = double(odd) + square / fraction;
  T t = small / fraction;
  for (int doubling = 0; doubling < doublings; ++doubling) t = 2.0 * t / (1.0 + t * t);
  return t;
}

// Write a positive number as 2^exponent m with 1 <= m < 2.
inline void split_exponent(double x, double &exponent, double &m) {
  uint64_t bits;
  __builtin_memcpy(&bits, &x, sizeof bits);
  exponent = double(int(bits >> 52) - 1023);
  bits = (bits & 0xfffffffffffff) | 0x3ff0000000000000;
  __builtin_memcpy(&m, &bits, sizeof m);
}
#if MAGLOC_LANES > 1
inline void split_exponent(Lanes x, Lanes &exponent, Lanes &m) {
  const Mask bits = (Mask)x;
  exponent = (Lanes)((bits >> 52) | 0x4330000000000000) - (0x1p52 + 1023.0);  // an integer to a double without a loop
  m = (Lanes)((bits & 0xfffffffffffff) | 0x3ff0000000000000);
}
#endif

// Logarithm of 2^exponent (1 + s)/(1 - s): exponent log(2) + 2 (s + s^3/3 + s^5/5 + ...).
template <class T>
MAGLOC_INLINE T logarithm_of_ratio(T exponent, T s) {
  const T square = s * s;  // up to 0.03
  T series{};
  for (int k = 21; k >= 3; k -= 2) series = 1.0 / k + square * series;
  // log(2) in two parts, of which the first one times an exponent is exact.
  constexpr double log_2_high = 0x1.62e42feep-1, log_2_low = 0x1.a39ef35793c76p-33;
  return exponent * log_2_high + (exponent * log_2_low + 2.0 * s * square * series + 2.0 * s);
}

// The natural logarithm; NaN of a negative number.
inline double logarithm(double x) {
  if (!(x > 0.0 && x < infinity)) return x == 0.0 ? -infinity : x > 0.0 ? x : nan;
  double less = 0.0, exponent, m;
  if (x < 0x1p-1022) x *= 0x1p54, less = 54.0;
  split_exponent(x, exponent, m);
  if (m > 1.4142135623730951) m *= 0.5, exponent += 1.0;
  return logarithm_of_ratio(exponent - less, (m - 1.0) / (m + 1.0));
}

// The natural logarithm of 1 + x for x >= 0, to a few units in the last place also of a small one.
template <class T>
inline T logarithm_of_1_plus(T x) {
  T exponent, m;
  split_exponent(1.0 + x, exponent, m);
  const auto is_large = m > 1.4142135623730951;
  m = choose(is_large, 0.5 * m, m);
  exponent = choose(is_large, exponent + 1.0, exponent);
  return logarithm_of_ratio(exponent, choose(exponent > 0.0, m - 1.0, x) / choose(exponent > 0.0, m + 1.0, 2.0 + x));
}

// Sine and cosine of an angle up to pi/2 in size: power series of half of it, then the formulas of the double angle.
inline void fill_sine_and_cosine(double x, double &sine, double &cosine) {
  const double half = 0.5 * x, square = half * half;  // up to 0.62
  double s = 1.0, c = 1.0;
  for (int i = 20; i > 0; i -= 2) {
    s = 1.0 - square / (i * (i + 1)) * s;
    c = 1.0 - square / (i * (i - 1)) * c;
  }
  s *= half;
  sine = 2.0 * s * c;
  cosine = 1.0 - 2.0 * s * s;
}

// Sine and cosine of any angle that is not negative; NaN where it is beyond all turns.
inline void fill_sine_and_cosine_of_any(double angle, double &sine, double &cosine) {
  if (!(angle < 1e9)) {
    sine = cosine = nan;
    return;
  }
  const int64_t quarters = (int64_t)(angle * 0.6366197723675814 + 0.5);  // NOLINT(bugprone-incorrect-roundings)
  const double turned = (double)quarters;
  double s, c;
  fill_sine_and_cosine(angle - turned * 0x1.921fb54442d18p0 - turned * 0x1.1a62633145c07p-54, s, c);
  const double sign = quarters & 2 ? -1.0 : 1.0;
  sine = sign * (quarters & 1 ? c : s);
  cosine = sign * (quarters & 1 ? -s : c);
}

// Exponential; zero below -700 and infinite above 709. x = n log 2 + r, and the power series of e^r.
inline double exponential(double x) {
  if (x < -700.0) return 0.0;
  if (!(x <= 709.0)) return x + infinity;
  const int64_t n = (int64_t)(x * 1.4426950408889634 + (x < 0.0 ? -0.5 : 0.5));
  const double whole = (double)n, r = (x - whole * 0x1.62e42fee00000p-1) - whole * 0x1.a39ef35793c76p-33;
  double sum = 1.0;
  for (int i = 14; i > 0; --i) sum = 1.0 + r / i * sum;
  const uint64_t bits = (uint64_t)(n + 1023) << 52;
  double power;
  __builtin_memcpy(&power, &bits, sizeof power);
  return power * sum;
}

// Complementary error function of x >= 0, to 1e-12 of it: a power series, from 2 on a continued fraction.
inline double complementary_error(double x) {
  const double square = x * x, density = exponential(-square);
  if (x < 2.0) {
    double sum = 1.0;
    for (int i = 71; i > 1; i -= 2) sum = 1.0 + 2.0 * square / i * sum;
    return 1.0 - 1.1283791670955126 * density * x * sum;
  }
  double below = x;
  for (int i = 40; i > 0; --i) below = x + 0.5 * i / below;
  return 0.5641895835477563 * density / below;
}

// Fill the rotation by an angle about its axis, and column by column the turns after it that follow from small changes
// of the angle.
inline void fill_rotation(const double (&angle)[3], double (&rotation)[3][3], double (&turns)[3][3]) {
  const double square = dot(angle, angle), size = square_root(square);
  // sin(a)/a, (1 - cos(a))/a^2 and (a - sin(a))/a^3, by series where they cancel.
  double first = 1.0 - square / 6.0, half = 0.5 - square / 24.0, third = 1.0 / 6.0 - square / 120.0;
  if (!(size <= 1e-2)) {
    double sine, cosine;
    fill_sine_and_cosine_of_any(0.5 * size, sine, cosine);
    first = 2.0 * sine * cosine / size;
    half = 2.0 * sine * sine / square;
    third = (1.0 - first) / square;
  }
  const double crossed[3][3] = {{0.0, -angle[2], angle[1]}, {angle[2], 0.0, -angle[0]}, {-angle[1], angle[0], 0.0}};
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) {
      const double one = i == j, of_square = angle[i] * angle[j] - square * one;
      rotation[i][j] = one + first * crossed[i][j] + half * of_square;
      turns[j][i] = one + half * crossed[i][j] + third * of_square;
    }
}
MAGLOC_END
