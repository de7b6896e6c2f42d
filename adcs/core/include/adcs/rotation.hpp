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
// e_i, the unit vector of axis i.
template <class T>
MAGLOC_INLINE Vector<T> unit_vector(int i) {
  return {{broadcast<T>(i == 0), broadcast<T>(i == 1), broadcast<T>(i == 2)}};
}
template <class T>
MAGLOC_INLINE Vector<T> broadcast(const Vector<double> &v) {
  return {{broadcast<T>(v[0]), broadcast<T>(v[1]), broadcast<T>(v[2])}};
}

// A constant matrix: row i is row[i].
struct Matrix {
  Vector<double> row[3];

  MAGLOC_INLINE double operator()(int i, int j) const { return row[i][j]; }
};

template <class T>
MAGLOC_INLINE Vector<T> operator*(const Matrix &m, const Vector<T> &v) {
  Vector<T> product;
  for (int i = 0; i < 3; ++i) product[i] = m(i, 0) * v[0] + m(i, 1) * v[1] + m(i, 2) * v[2];
  return product;
}

template <class T>
struct Quaternion {
  T scalar;
  Vector<T> vector;
};

template <class T>
MAGLOC_INLINE Quaternion<T> operator+(const Quaternion<T> &p, const Quaternion<T> &q) {
  return {p.scalar + q.scalar, p.vector + q.vector};
}
template <class S, class T>
MAGLOC_INLINE Quaternion<T> operator*(const S &scale, const Quaternion<T> &q) {
  return {scale * q.scalar, scale * q.vector};
}
template <class T>
MAGLOC_INLINE Quaternion<T> conjugate(const Quaternion<T> &q) {
  return {q.scalar, -1.0 * q.vector};
}

// The product p q of Hamilton.
template <class T>
MAGLOC_INLINE Quaternion<T> multiply(const Quaternion<T> &p, const Quaternion<T> &q) {
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
  const Quaternion<T> turn = multiply(conjugate(from), to);
  return choose(turn.scalar < 0.0, broadcast<T>(-1.0), broadcast<T>(1.0)) * turn.vector;
}
MAGLOC_END
