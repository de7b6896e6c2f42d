// Functions of the C library that kernels need, by +, -, *, / and square roots alone, so that lanes compute them, too.
// Each is within a few units of the last place.
#pragma once
#include "magloc/numbers.hpp"

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

// The logarithm of a positive number 2^k m: k log(2) + 2 artanh((m - 1)/(m + 1)), with m between sqrt(1/2) and sqrt(2).
inline double logarithm(double x) {
  if (!(x > 0.0 && x < infinity)) return x == 0.0 ? -infinity : x > 0.0 ? x : nan;
  int exponent = 0;
  if (x < 0x1p-1022) x *= 0x1p54, exponent = -54;
  uint64_t bits;
  __builtin_memcpy(&bits, &x, sizeof bits);
  exponent += int(bits >> 52) - 1023;
  bits = (bits & 0xfffffffffffff) | 0x3ff0000000000000;
  double m;
  __builtin_memcpy(&m, &bits, sizeof m);
  if (m > 1.4142135623730951) m *= 0.5, ++exponent;
  const double ratio = (m - 1.0) / (m + 1.0), square = ratio * ratio;
  double series = 0.0;
  for (int k = 21; k >= 3; k -= 2) series = 1.0 / k + square * series;
  constexpr double log_2_high = 0x1.62e42feep-1, log_2_low = 0x1.a39ef35793c76p-33;
  return exponent * log_2_high + (exponent * log_2_low + 2.0 * ratio * square * series + 2.0 * ratio);
}
MAGLOC_END
