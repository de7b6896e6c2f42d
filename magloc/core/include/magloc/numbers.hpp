// Numbers that formulas are written for: double, lanes (a vector register of doubles), and dual numbers of either.
//
// A formula is a template over its number type T. With T = double it computes one value, with T = Lanes one value in
// each lane, with T = Dual<double, n> a value and its derivatives. Lanes cannot branch: write choose(condition, a, b).
// A comparison with NaN is false, so put the result for bad input into b.
#pragma once
#include <stdint.h>

// All functions of one instruction set live in a separate namespace. Otherwise the linker merges equal functions that
// were compiled with different flags, and code for a newer processor reaches an older one.
#ifndef MAGLOC_ISA
#define MAGLOC_ISA portable
#endif
#ifndef MAGLOC_LANES
#define MAGLOC_LANES 1
#endif
#define MAGLOC_BEGIN \
  namespace magloc { \
  inline namespace MAGLOC_ISA {
#define MAGLOC_END \
  }                \
  }
#if defined(__OPTIMIZE_SIZE__)
#define MAGLOC_INLINE inline
#elif defined(__GNUC__)
#define MAGLOC_INLINE inline __attribute__((always_inline))
#else
#define MAGLOC_INLINE inline
#endif
// Before a loop of few turns: repeat its body, so that arrays with its index become registers.
#if defined(__OPTIMIZE_SIZE__)
#define MAGLOC_UNROLL
#elif defined(__clang__)
#define MAGLOC_UNROLL _Pragma("unroll")
#elif defined(__GNUC__)
#define MAGLOC_UNROLL _Pragma("GCC unroll 16")
#else
#define MAGLOC_UNROLL
#endif

MAGLOC_BEGIN
constexpr double infinity = __builtin_inf(), nan = __builtin_nan("");

MAGLOC_INLINE double square_root(double x) { return __builtin_sqrt(x); }
MAGLOC_INLINE float square_root(float x) { return __builtin_sqrtf(x); }
MAGLOC_INLINE double choose(bool condition, double a, double b) { return condition ? a : b; }
MAGLOC_INLINE double get_lane(double x, int) { return x; }
MAGLOC_INLINE void set_lane(double &x, int, double value) { x = value; }

#if MAGLOC_LANES > 1
typedef double Lanes __attribute__((vector_size(8 * MAGLOC_LANES)));
typedef decltype(Lanes{} < Lanes{}) Mask;
MAGLOC_INLINE Lanes square_root(Lanes x) {
#if defined(__clang__)
  return __builtin_elementwise_sqrt(x);
#else
  Lanes y = x;
  for (int i = 0; i < MAGLOC_LANES; ++i) y[i] = __builtin_sqrt(x[i]);
  return y;
#endif
}
MAGLOC_INLINE Lanes choose(Mask condition, Lanes a, Lanes b) { return condition ? a : b; }
MAGLOC_INLINE double get_lane(const Lanes &x, int i) { return x[i]; }
MAGLOC_INLINE void set_lane(Lanes &x, int i, double value) { x[i] = value; }
#else
typedef double Lanes;
typedef bool Mask;
#endif

template <class T>
constexpr int n_lanes = sizeof(T) / sizeof(double);
// Registers that n numbers fill.
template <class T>
constexpr int64_t n_registers(int64_t n) {
  return (n + n_lanes<T> - 1) / n_lanes<T>;
}
template <class T>
MAGLOC_INLINE T broadcast(double x) {
  return T{} + x;
}
template <class T>
MAGLOC_INLINE double sum_of_lanes(const T &x) {
  double sum = 0.0;
  for (int i = 0; i < n_lanes<T>; ++i) sum += get_lane(x, i);
  return sum;
}
template <class T>
MAGLOC_INLINE T absolute(T x) {
  return choose(x < 0.0, -x, x);
}
MAGLOC_INLINE bool any_lane(bool condition) { return condition; }
MAGLOC_INLINE bool all_lanes(bool condition) { return condition; }
#if MAGLOC_LANES > 1
MAGLOC_INLINE bool any_lane(Mask condition) {
  return sum_of_lanes(choose(condition, broadcast<Lanes>(1.0), Lanes{})) > 0.0;
}
MAGLOC_INLINE bool all_lanes(Mask condition) {
  return sum_of_lanes(choose(condition, broadcast<Lanes>(1.0), Lanes{})) == n_lanes<Lanes>;
}
#endif
template <class T>
MAGLOC_INLINE T maximum(T a, T b) {
  return choose(a > b, a, b);
}
template <class T>
MAGLOC_INLINE T minimum(T a, T b) {
  return choose(a < b, a, b);
}

// Read component `axis` of the 3-vectors i, i + 1, ... of an array (n, 3), one in each lane. Beyond the end the last
// vector is repeated.
template <class T>
MAGLOC_INLINE T load_component(const double *vectors, int64_t i, int64_t n, int axis) {
  T x{};
  for (int lane = 0; lane < n_lanes<T>; ++lane)
    set_lane(x, lane, vectors[3 * (i + lane < n ? i + lane : n - 1) + axis]);
  return x;
}

// A value and its derivatives with respect to n variables.
template <class T, int n>
struct Dual {
  T value, derivative[n];

  MAGLOC_INLINE static Dual constant(T value) {
    Dual r;
    r.value = value;
    for (T &d : r.derivative) d = T{};
    return r;
  }
  MAGLOC_INLINE static Dual variable(T value, int which) {
    Dual r = constant(value);
    r.derivative[which] = broadcast<T>(1.0);
    return r;
  }
#define MAGLOC_RULE(arguments, of_value, of_derivative)          \
  friend MAGLOC_INLINE Dual operator arguments {                 \
    Dual r;                                                      \
    r.value = of_value;                                          \
    for (int i = 0; i < n; ++i) r.derivative[i] = of_derivative; \
    return r;                                                    \
  }
  MAGLOC_RULE(+(const Dual &a, const Dual &b), a.value + b.value, a.derivative[i] + b.derivative[i])
  MAGLOC_RULE(-(const Dual &a, const Dual &b), a.value - b.value, a.derivative[i] - b.derivative[i])
  MAGLOC_RULE(*(const Dual &a, const Dual &b), a.value *b.value, a.derivative[i] * b.value + a.value * b.derivative[i])
  // S: a constant, double or of type T.
  template <class S>
  MAGLOC_RULE(-(const Dual &a, const S &b), a.value - b, a.derivative[i])
  template <class S>
  MAGLOC_RULE(*(const Dual &a, const S &b), a.value *b, a.derivative[i] * b)
  template <class S>
  MAGLOC_RULE(*(const S &a, const Dual &b), a *b.value, a *b.derivative[i])
#undef MAGLOC_RULE
  friend MAGLOC_INLINE Dual &operator+=(Dual &a, const Dual &b) {
    return a = a + b;
  }
};
template <class T>
MAGLOC_INLINE T inverse_root(T x) {
  return 1.0 / square_root(x);
}
template <class T, int n>
MAGLOC_INLINE Dual<T, n> inverse_root(const Dual<T, n> &x) {
  Dual<T, n> r;
  r.value = 1.0 / square_root(x.value);
  const T slope = -0.5 * r.value * r.value * r.value;
  for (int i = 0; i < n; ++i) r.derivative[i] = slope * x.derivative[i];
  return r;
}

template <class A, class B>
MAGLOC_INLINE auto dot(const A (&a)[3], const B (&b)[3]) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

template <class T>
MAGLOC_INLINE void cross(const T (&a)[3], const T (&b)[3], T (&c)[3]) {
  c[0] = a[1] * b[2] - a[2] * b[1];
  c[1] = a[2] * b[0] - a[0] * b[2];
  c[2] = a[0] * b[1] - a[1] * b[0];
}
MAGLOC_END
