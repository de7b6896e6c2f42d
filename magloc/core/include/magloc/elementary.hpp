// Elementary functions of a double, to a few units in the last place; kernels use no C library.
#pragma once
#include <string.h>

#include "numbers.hpp"

MAGLOC_BEGIN
// Natural logarithm of a normal positive number; NaN of others. With x = 2^e m and s = (m - 1)/(m + 1) it is
// e log 2 + 2 (s + s^3/3 + s^5/5 + ...).
inline double logarithm(double x) {
  if (!(x >= 0x1p-1022 && x < infinity)) return nan;
  uint64_t bits;
  memcpy(&bits, &x, sizeof bits);
  int64_t exponent = (int64_t)(bits >> 52) - 1023;
  bits = (bits & 0xfffffffffffff) | 0x3ff0000000000000;
  double m;
  memcpy(&m, &bits, sizeof m);
  if (m > 1.4142135623730951) m *= 0.5, ++exponent;
  const double s = (m - 1.0) / (m + 1.0), square = s * s;  // up to 0.03
  double sum = 0.0;
  for (int i = 21; i > 1; i -= 2) sum = square * (1.0 / i + sum);
  // log 2 in two parts, of which the first one times an exponent is exact.
  return exponent * 0x1.62e42fee00000p-1 + (2.0 * (s + s * sum) + exponent * 0x1.a39ef35793c76p-33);
}

// Angle of the vector (x, y), from -pi to pi. tan(t/2) = tan t/(1 + sqrt(1 + tan^2 t)), until the power series of the
// arctangent is short.
inline double arctangent(double y, double x) {
  if (x == 0.0 && y == 0.0) return 0.0;
  const double size_x = __builtin_fabs(x), size_y = __builtin_fabs(y);
  double t = size_y > size_x ? size_x / size_y : size_y / size_x;
  for (int i = 0; i < 2; ++i) t /= 1.0 + __builtin_sqrt(1.0 + t * t);
  const double square = t * t;  // up to 0.04
  double sum = 0.0;
  for (int i = 23; i > 1; i -= 2) sum = square * (1.0 / i - sum);
  double angle = 4.0 * (t - t * sum);
  const double pi = 3.141592653589793;
  if (size_y > size_x) angle = 0.5 * pi - angle;
  if (x < 0.0) angle = pi - angle;
  return y < 0.0 ? -angle : angle;
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

// Exponential of a number up to 700; zero below -700. x = n log 2 + r, and the power series of e^r.
inline double exponential(double x) {
  if (x < -700.0) return 0.0;
  const int64_t n = (int64_t)(x * 1.4426950408889634 + (x < 0.0 ? -0.5 : 0.5));
  const double r = (x - n * 0x1.62e42fee00000p-1) - n * 0x1.a39ef35793c76p-33;
  double sum = 1.0;
  for (int i = 14; i > 0; --i) sum = 1.0 + r / i * sum;
  const uint64_t bits = (uint64_t)(n + 1023) << 52;
  double power;
  memcpy(&power, &bits, sizeof power);
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
MAGLOC_END
