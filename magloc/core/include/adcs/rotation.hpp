// Vectors, matrices and quaternions. T is a double or lanes; adcs/quaternion.py is the readable reference.
//
// An attitude q tells how the body stands in the reference frame: a vector v of that frame is q* v q in body axes.
#pragma once
#include "magloc/numbers.hpp"

MAGLOC_BEGIN
template <class T>
struct Vector {
  T at[3];

  MAGLOC_INLINE T &operator[](int i) { return at[i]; }
  MAGLOC_INLINE const T &operator[](int i) const { return at[i]; }
};

template <class T>
MAGLOC_INLINE Vector<T> operator+(const Vector<T> &a, const Vector<T> &b) {
  return {{a[0] + b[0], a[1] + b[1], a[2] + b[2]}};
}
template <class T>
MAGLOC_INLINE Vector<T> operator-(const Vector<T> &a, const Vector<T> &b) {
  return {{a[0] - b[0], a[1] - b[1], a[2] - b[2]}};
}
template <class S, class T>
MAGLOC_INLINE Vector<T> operator*(const S &scale, const Vector<T> &v) {
  return {{scale * v[0], scale * v[1], scale * v[2]}};
}
template <class T>
MAGLOC_INLINE Vector<T> &operator+=(Vector<T> &a, const Vector<T> &b) {
  return a = a + b;
}
template <class T>
MAGLOC_INLINE Vector<T> &operator-=(Vector<T> &a, const Vector<T> &b) {
  return a = a - b;
}
template <class T>
MAGLOC_INLINE T dot(const Vector<T> &a, const Vector<T> &b) {
  return dot(a.at, b.at);
}
template <class T>
MAGLOC_INLINE Vector<T> cross(const Vector<T> &a, const Vector<T> &b) {
  Vector<T> c;
  cross(a.at, b.at, c.at);
  return c;
}
template <class T>
MAGLOC_INLINE Vector<T> normalised(const Vector<T> &v) {
  return inverse_root(dot(v, v)) * v;
}
MAGLOC_INLINE Vector<float> operator*(double scale, const Vector<float> &v) {
  const float s = (float)scale;
  return {{s * v[0], s * v[1], s * v[2]}};
}
// Whether no component is NaN, as those of a missing reading are.
MAGLOC_INLINE bool is_read(const Vector<double> &v) { return dot(v, v) >= 0.0; }
// e_i, the unit vector of axis i.
template <class T>
MAGLOC_INLINE Vector<T> unit_vector(int i) {
  return {{broadcast<T>(i == 0), broadcast<T>(i == 1), broadcast<T>(i == 2)}};
}
template <class T>
MAGLOC_INLINE Vector<T> broadcast(const Vector<double> &v) {
  return {{broadcast<T>(v[0]), broadcast<T>(v[1]), broadcast<T>(v[2])}};
}
MAGLOC_INLINE Vector<double> vector_at(const double *numbers) { return {{numbers[0], numbers[1], numbers[2]}}; }
MAGLOC_INLINE void store(const Vector<double> &v, double *numbers) { __builtin_memcpy(numbers, v.at, sizeof v.at); }

// A constant matrix: row i is row[i].
template <class Real>
struct MatrixOf {
  Vector<Real> row[3];

  MAGLOC_INLINE Real operator()(int i, int j) const { return row[i][j]; }
};
typedef MatrixOf<double> Matrix;
MAGLOC_INLINE Matrix matrix_at(const double *numbers) {
  return {{vector_at(numbers), vector_at(numbers + 3), vector_at(numbers + 6)}};
}
MAGLOC_INLINE void store(const Matrix &m, double *numbers) {
  for (int i = 0; i < 3; ++i) store(m.row[i], numbers + 3 * i);
}

template <class Real, class T>
MAGLOC_INLINE Vector<T> operator*(const MatrixOf<Real> &m, const Vector<T> &v) {
  Vector<T> product;
  for (int i = 0; i < 3; ++i) product[i] = m(i, 0) * v[0] + m(i, 1) * v[1] + m(i, 2) * v[2];
  return product;
}

template <class T>
struct Quaternion {
  T scalar;
  Vector<T> vector;
};
constexpr Quaternion<double> identity = {1.0, {}};
MAGLOC_INLINE Quaternion<double> quaternion_at(const double *numbers) { return {numbers[0], vector_at(numbers + 1)}; }
MAGLOC_INLINE void store(const Quaternion<double> &q, double *numbers) {
  numbers[0] = q.scalar;
  store(q.vector, numbers + 1);
}

template <class T>
MAGLOC_INLINE Quaternion<T> operator+(const Quaternion<T> &p, const Quaternion<T> &q) {
  return {p.scalar + q.scalar, p.vector + q.vector};
}
template <class S, class T>
MAGLOC_INLINE Quaternion<T> operator*(const S &scale, const Quaternion<T> &q) {
  return {scale * q.scalar, scale * q.vector};
}
MAGLOC_INLINE Quaternion<float> operator*(double scale, const Quaternion<float> &q) {
  return {(float)scale * q.scalar, scale * q.vector};
}
template <class T>
MAGLOC_INLINE Quaternion<T> conjugate(const Quaternion<T> &q) {
  return {q.scalar, -1.0 * q.vector};
}

// The product p q of Hamilton: the rotation q, then p.
template <class T>
MAGLOC_INLINE Quaternion<T> operator*(const Quaternion<T> &p, const Quaternion<T> &q) {
  return {p.scalar * q.scalar - dot(p.vector, q.vector),
          p.scalar * q.vector + q.scalar * p.vector + cross(p.vector, q.vector)};
}

template <class T>
MAGLOC_INLINE Quaternion<T> normalised(const Quaternion<T> &q) {
  return inverse_root(q.scalar * q.scalar + dot(q.vector, q.vector)) * q;
}

// A vector of the reference frame in body axes.
template <class T>
MAGLOC_INLINE Vector<T> rotate_back(const Quaternion<T> &q, const Vector<T> &v) {
  const Vector<T> twice = 2.0 * cross(q.vector, v);
  return v - q.scalar * twice + cross(q.vector, twice);
}
// A vector in body axes in the reference frame.
template <class T>
MAGLOC_INLINE Vector<T> rotate(const Quaternion<T> &q, const Vector<T> &v) {
  return rotate_back(conjugate(q), v);
}

// The axis i of the reference frame in body axes: rotate_back of e_i, without its products with zero.
template <class T>
MAGLOC_INLINE Vector<T> axis_back(const Quaternion<T> &q, int i) {
  const int j = (i + 1) % 3, k = (i + 2) % 3;
  const Vector<T> &p = q.vector;
  Vector<T> axis;
  axis[i] = 1.0 - 2.0 * (p[j] * p[j] + p[k] * p[k]);
  axis[j] = 2.0 * (p[i] * p[j] - q.scalar * p[k]);
  axis[k] = 2.0 * (p[i] * p[k] + q.scalar * p[j]);
  return axis;
}

// The vector part of the turn from one attitude to another, of the two turns the one below 180 degrees.
template <class T>
MAGLOC_INLINE Vector<T> error_vector(const Quaternion<T> &from, const Quaternion<T> &to) {
  const Quaternion<T> turn = conjugate(from) * to;
  return choose(turn.scalar < 0.0, broadcast<T>(-1.0), broadcast<T>(1.0)) * turn.vector;
}

// The attitude after the shortest turn that makes a direction in body axes that of the reference frame.
template <class T>
inline Quaternion<T> turned_onto(const Quaternion<T> &q, const Vector<T> &body, const Vector<T> &reference) {
  const Vector<T> there = rotate_back(q, reference);
  const T inverse = 1 / square_root(dot(body, body) * dot(reference, reference));
  const T cosine = dot(body, there) * inverse;
  Quaternion<T> turn = {1 + cosine, inverse * cross(body, there)};
  if (1.0 + cosine < 1e-12) {
    // Half a turn is one about any axis across.
    int least = 0;
    for (int i = 1; i < 3; ++i)
      if (__builtin_fabs(body[i]) < __builtin_fabs(body[least])) least = i;
    turn = {T(0), cross(body, unit_vector<T>(least))};
  }
  return normalised(q * turn);
}

// (cos t/2, n sin t/2) of a rotation vector t n, by power series of h = t/2, exact to rounding up to h^2 = 0.04. A
// longer rotation is halved until it is short enough, and its quaternion squared as often.
inline Quaternion<double> exponential(Vector<double> v) {
  double square = 0.25 * dot(v, v);
  int halved = 0;
  for (; square > 0.04 && halved < 64; ++halved) v = 0.5 * v, square *= 0.25;
  double cosine = 1.0, sine = 1.0;  // cos h and sin(h)/h
  MAGLOC_UNROLL
  for (int i = 10; i > 0; i -= 2) {
    cosine = 1.0 - square * (1.0 / (i * (i - 1))) * cosine;
    sine = 1.0 - square * (1.0 / (i * (i + 1))) * sine;
  }
  Quaternion<double> q = {cosine, 0.5 * sine * v};
  for (; halved > 0; --halved) q = q * q;
  return q;
}
inline Quaternion<float> exponential(const Vector<float> &v) {
  const Quaternion<double> q = exponential(Vector<double>{{v[0], v[1], v[2]}});
  return {(float)q.scalar, {{(float)q.vector[0], (float)q.vector[1], (float)q.vector[2]}}};
}
MAGLOC_END
