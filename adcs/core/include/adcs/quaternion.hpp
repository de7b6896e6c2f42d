// Vectors and unit quaternions of attitude: Hamilton's product, scalar part first. adcs/quaternion.py is the readable
// reference.
#pragma once
#include <magloc/numbers.hpp>

MAGLOC_BEGIN
struct Vector {
  double x, y, z;

  static Vector load(const double *values) { return {values[0], values[1], values[2]}; }
  void store(double *values) const { values[0] = x, values[1] = y, values[2] = z; }
};
inline Vector operator+(const Vector &a, const Vector &b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
inline Vector operator-(const Vector &a, const Vector &b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
inline Vector operator*(double s, const Vector &a) { return {s * a.x, s * a.y, s * a.z}; }
inline double dot(const Vector &a, const Vector &b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
inline Vector cross(const Vector &a, const Vector &b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
inline Vector unit(const Vector &a) { return inverse_root(dot(a, a)) * a; }
// Whether no component is NaN, as those of a missing reading are.
inline bool is_read(const Vector &a) { return dot(a, a) >= 0.0; }

struct Quaternion {
  double w, x, y, z;

  static Quaternion load(const double *values) { return {values[0], values[1], values[2], values[3]}; }
  void store(double *values) const { values[0] = w, values[1] = x, values[2] = y, values[3] = z; }
};
constexpr Quaternion identity = {1.0, 0.0, 0.0, 0.0};
// The rotation q, then p.
inline Quaternion operator*(const Quaternion &p, const Quaternion &q) {
  return {p.w * q.w - p.x * q.x - p.y * q.y - p.z * q.z, p.w * q.x + p.x * q.w + p.y * q.z - p.z * q.y,
          p.w * q.y - p.x * q.z + p.y * q.w + p.z * q.x, p.w * q.z + p.x * q.y - p.y * q.x + p.z * q.w};
}
inline Quaternion conjugate(const Quaternion &q) { return {q.w, -q.x, -q.y, -q.z}; }
inline Quaternion normalised(const Quaternion &q) {
  const double s = inverse_root(q.w * q.w + q.x * q.x + q.y * q.y + q.z * q.z);
  return {s * q.w, s * q.x, s * q.y, s * q.z};
}
// q v q*: of q_frame_from_body and a vector in body axes, its components in the frame.
inline Vector rotate(const Quaternion &q, const Vector &v) {
  const Vector axis = {q.x, q.y, q.z}, twice = 2.0 * cross(axis, v);
  return v + q.w * twice + cross(axis, twice);
}
inline Vector rotate_back(const Quaternion &q, const Vector &v) { return rotate(conjugate(q), v); }

// (cos t/2, n sin t/2) of a rotation vector t n, by power series of h = t/2, exact to rounding up to h^2 = 0.04. A
// longer rotation is halved until it is short enough, and its quaternion squared as often.
inline Quaternion exponential(Vector v) {
  double square = 0.25 * dot(v, v);
  int halved = 0;
  for (; square > 0.04 && halved < 64; ++halved) v = 0.5 * v, square *= 0.25;
  double cosine = 1.0, sine = 1.0;  // cos h and sin(h)/h
#pragma GCC unroll 5
  for (int i = 10; i > 0; i -= 2) {
    cosine = 1.0 - square * (1.0 / (i * (i - 1))) * cosine;
    sine = 1.0 - square * (1.0 / (i * (i + 1))) * sine;
  }
  Quaternion q = {cosine, 0.5 * sine * v.x, 0.5 * sine * v.y, 0.5 * sine * v.z};
  for (; halved > 0; --halved) q = q * q;
  return q;
}

// Vector part of q_estimated* q with the sign that makes its scalar part positive: half of a small angle of error.
inline Vector error_vector(const Quaternion &q_estimated, const Quaternion &q) {
  const Quaternion e = conjugate(q_estimated) * q;
  return (e.w < 0.0 ? -1.0 : 1.0) * Vector{e.x, e.y, e.z};
}
MAGLOC_END
