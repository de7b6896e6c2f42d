// Field of a dipole and its derivatives, in units of mu_0/4pi. magloc/fields/dipole.py is the readable reference; the
// equations have its numbers. d is the vector from the source to the point, in one frame with the moment m.
#pragma once
#include "numbers.hpp"

MAGLOC_BEGIN
constexpr double mu0_over_4pi = 1e-7;  // T m/A

// Direction n = d/r and inverse distance 1/r: what all formulas of one source and one point share.
template <class T>
struct Ray {
  T n[3], inverse_r;

  MAGLOC_INLINE static Ray from(const T (&d)[3]) {
    const T inverse_r = inverse_root(dot(d, d));
    return {{d[0] * inverse_r, d[1] * inverse_r, d[2] * inverse_r}, inverse_r};
  }
};

// Equation (2): B = [3 (n.m) n - m]/r^3. T may be a dual number, which gives derivatives of B, too.
template <class T, class M>
MAGLOC_INLINE void field(const Ray<T> &ray, const M (&m)[3], T (&b)[3]) {
  const T cube = ray.inverse_r * ray.inverse_r * ray.inverse_r, radial = 3.0 * dot(ray.n, m);
  for (int i = 0; i < 3; ++i) b[i] = (radial * ray.n[i] - m[i]) * cube;
}

// Equation (2): the matrix A = (3 n n^T - I)/r^3 with B = A m, so that dB/dm = A.
template <class T>
MAGLOC_INLINE void field_matrix(const Ray<T> &ray, T (&a)[3][3]) {
  const T cube = ray.inverse_r * ray.inverse_r * ray.inverse_r, three = 3.0 * cube;
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j <= i; ++j) a[i][j] = a[j][i] = three * ray.n[i] * ray.n[j];
  for (int i = 0; i < 3; ++i) a[i][i] -= cube;
}

// Equation (3): G = dB/ds = 3/r^4 [(n.m) I + n m^T + m n^T - 5 (n.m) n n^T], symmetric and without trace; dB/dp = -G.
template <class T, class M>
MAGLOC_INLINE void gradient(const Ray<T> &ray, const M (&m)[3], T (&g)[3][3]) {
  const T square = ray.inverse_r * ray.inverse_r, scale = 3.0 * square * square;
  const T radial = dot(ray.n, m), five = 5.0 * radial;
  const T n[3] = {scale * ray.n[0], scale * ray.n[1], scale * ray.n[2]};
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j <= i; ++j) g[i][j] = g[j][i] = n[i] * m[j] + n[j] * (m[i] - five * ray.n[i]);
  for (int i = 0; i < 3; ++i) g[i][i] += scale * radial;
}
MAGLOC_END
