// Fields of uniformly magnetised cuboids, cylinders, rings and spheres at points outside them, in units of mu_0/4pi.
//
// The potential phi(d) = (1/V) integral of 1/|d - d'| over the body gives B = (second derivatives of phi) m for a
// moment m in any direction, and third derivatives give the gradient of B. Both are closed forms, so that no number is
// a difference of larger ones near surfaces, edges or the axis. d is the point from the body's centre, in its axes.
#pragma once
#include "elementary.hpp"
#include "numbers.hpp"

MAGLOC_BEGIN
// Second and third derivatives of phi.
template <class T>
struct PotentialDerivatives {
  T second[3][3], third[3][3][3];

  MAGLOC_INLINE void scale(T factor) {
    for (auto &row : second)
      for (T &x : row) x *= factor;
    for (auto &plane : third)
      for (auto &row : plane)
        for (T &x : row) x *= factor;
  }
  // Set a derivative in all orders of its axes.
  MAGLOC_INLINE void set(int i, int j, T x) { second[i][j] = second[j][i] = x; }
  MAGLOC_INLINE void set(int i, int j, int k, T x) {
    third[i][j][k] = third[i][k][j] = third[j][i][k] = third[j][k][i] = third[k][i][j] = third[k][j][i] = x;
  }
};

// Add w times the derivatives of 1/|d|, those of a dipole.
template <class T>
MAGLOC_INLINE void add_dipole(const T (&d)[3], double w, PotentialDerivatives<T> &sum) {
  const T inverse = inverse_root(dot(d, d)), cube = w * inverse * inverse * inverse, three = 3.0 * cube * inverse;
  const T n[3] = {d[0] * inverse, d[1] * inverse, d[2] * inverse};
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) {
      sum.second[i][j] += cube * (3.0 * n[i] * n[j] - (i == j));
      for (int k = 0; k < 3; ++k)
        sum.third[i][j][k] +=
            three * (double(i == j) * n[k] + double(j == k) * n[i] + double(k == i) * n[j] - 5.0 * n[i] * n[j] * n[k]);
    }
}

// --- Cuboid
// -----------------------------------------------------------------------------------------------------------

// Integral of 1/R along an edge from w[0] to w[1] at the offset (u, v), and its derivatives by u and v. Distances to
// its ends are r. Their sum exceeds the edge's length by `excess`, which is not computed as that difference.
template <class T>
struct EdgeIntegral {
  T value, by_u, by_v;

  MAGLOC_INLINE EdgeIntegral(T u, T v, T beyond, const T (&w)[2], T r0, T r1, double length) {
    const T square = u * u + v * v;
    const T excess = square / (r0 + absolute(w[0])) + square / (r1 + absolute(w[1])) + 2.0 * beyond;
    value = logarithm_of_1_plus(2.0 * length / excess);
    const T slope = -2.0 * length * (1.0 / r0 + 1.0 / r1) / (excess * (excess + 2.0 * length));
    by_u = slope * u, by_v = slope * v;
  }
};

// Solid angle of a rectangle at the distance u, negative for negative u. r[j][k] is the distance to the corner at v[j],
// w[k].
template <class T>
MAGLOC_INLINE T rectangle_angle(T u, const T (&v)[2], const T (&w)[2], const T (&r)[2][2]) {
  const T distance = absolute(u);
  T angle[2];
  for (int k = 0; k < 2; ++k)
    angle[k] = arc_tangent(distance * w[k] * (v[1] * r[0][k] - v[0] * r[1][k]),
                           u * u * r[0][k] * r[1][k] + v[0] * v[1] * w[k] * w[k]);
  const T sum = angle[1] - angle[0];
  return choose(u < 0.0, -sum, sum);
}

// A cuboid with the given halves of its edges.
template <class T>
inline void fill_cuboid(const double (&half)[3], const T (&d)[3], PotentialDerivatives<T> &phi) {
  T x[3][2], beyond[3], r[2][2][2], by_xyz{};
  for (int i = 0; i < 3; ++i) {
    x[i][0] = d[i] - half[i], x[i][1] = d[i] + half[i];
    beyond[i] = maximum(absolute(d[i]) - half[i], T{});
  }
  for (int corner = 0; corner < 8; ++corner) {
    const int i = corner >> 2, j = corner >> 1 & 1, k = corner & 1;
    r[i][j][k] = square_root(x[0][i] * x[0][i] + x[1][j] * x[1][j] + x[2][k] * x[2][k]);
    by_xyz += double((i + j + k) % 2 ? 1 : -1) / r[i][j][k];
  }
  phi.set(0, 1, 2, by_xyz);
  for (int k = 0; k < 3; ++k) {
    const int i = (k + 1) % 3, j = (k + 2) % 3;
    T by_ij{}, by_iij{}, by_ijj{};
    for (int edge = 0; edge < 4; ++edge) {
      const int a = edge >> 1, b = edge & 1;
      int low[3], high[3];
      low[i] = high[i] = a, low[j] = high[j] = b, low[k] = 0, high[k] = 1;
      const EdgeIntegral<T> along(x[i][a], x[j][b], beyond[k], x[k], r[low[0]][low[1]][low[2]],
                                  r[high[0]][high[1]][high[2]], 2.0 * half[k]);
      const double sign = a == b ? 1.0 : -1.0;
      by_ij += sign * along.value, by_iij += sign * along.by_u, by_ijj += sign * along.by_v;
    }
    phi.set(i, j, by_ij), phi.set(i, i, j, by_iij), phi.set(i, j, j, by_ijj);
  }
  for (int i = 0; i < 2; ++i) {
    T angle[2];
    for (int a = 0; a < 2; ++a) {
      T distance[2][2];  // of the other axes in order
      for (int j = 0; j < 2; ++j)
        for (int k = 0; k < 2; ++k) distance[j][k] = i ? r[j][a][k] : r[a][j][k];
      angle[a] = rectangle_angle(x[i][a], x[1 - i], x[2], distance);
    }
    phi.set(i, i, angle[0] - angle[1]);
  }
  phi.set(2, 2, -(phi.second[0][0] + phi.second[1][1]));
  for (int i = 0; i < 3; ++i) {
    const int j = (i + 1) % 3, k = (i + 2) % 3;
    phi.set(i, i, i, -(phi.third[i][j][j] + phi.third[i][k][k]));
  }
  phi.scale(broadcast<T>(1.0 / (8.0 * half[0] * half[1] * half[2])));
}

// The same far away: dipoles at Gauss's 4 x 4 x 4 points, which have the moments of the cuboid up to the seventh order.
template <class T>
inline void fill_far_cuboid(const double (&half)[3], const T (&d)[3], PotentialDerivatives<T> &phi) {
  constexpr double place[4] = {-0.8611363115940526, -0.3399810435848563, 0.3399810435848563, 0.8611363115940526};
  constexpr double weight[4] = {0.1739274225687269, 0.3260725774312731, 0.3260725774312731, 0.1739274225687269};
  phi = {};
  for (int point = 0; point < 64; ++point) {
    const int at[3] = {point >> 4, point >> 2 & 3, point & 3};
    T from[3];
    for (int i = 0; i < 3; ++i) from[i] = d[i] - half[i] * place[at[i]];
    add_dipole(from, weight[at[0]] * weight[at[1]] * weight[at[2]], phi);
  }
}

// --- Cylinder and ring
// ------------------------------------------------------------------------------------------------

// With s = x^2 + y^2 an axisymmetric phi has the derivatives F = (1/rho) d phi/d rho by the radius, and those of F by s
// and z. They are smooth on the axis and give all others.
template <class T>
struct RadialDerivatives {
  T f, f_s, f_z, f_ss, f_sz, f_zz;

  MAGLOC_INLINE void add(double w, const RadialDerivatives &other) {
    f += w * other.f, f_s += w * other.f_s, f_z += w * other.f_z;
    f_ss += w * other.f_ss, f_sz += w * other.f_sz, f_zz += w * other.f_zz;
  }
  MAGLOC_INLINE void fill(const T (&d)[3], PotentialDerivatives<T> &phi) const {
    const T s = d[0] * d[0] + d[1] * d[1];
    for (int i = 0; i < 2; ++i) {
      for (int j = 0; j <= i; ++j) {
        phi.set(i, j, double(i == j) * f + 2.0 * f_s * d[i] * d[j]);
        phi.set(i, j, 2, double(i == j) * f_z + 2.0 * f_sz * d[i] * d[j]);
        for (int k = 0; k <= j; ++k)
          phi.set(i, j, k,
                  2.0 * f_s * (double(i == j) * d[k] + double(j == k) * d[i] + double(k == i) * d[j]) +
                      4.0 * f_ss * d[i] * d[j] * d[k]);
      }
      phi.set(i, 2, f_z * d[i]);
      phi.set(i, 2, 2, f_zz * d[i]);
    }
    phi.set(2, 2, -2.0 * (f + s * f_s));
    phi.set(2, 2, 2, -2.0 * (f_z + s * f_sz));
  }
};

// Complete elliptic integrals of the modulus k with k'^2 = 1 - k^2, by the arithmetic-geometric mean: K, E,
// excess = (2 (K - E)/k^2 - K)/k^2, and Bulirsch's third = g cel(k', g^2, 0, 1) for g >= 0. Sums have positive terms.
template <class T>
struct EllipticIntegrals {
  T first, second, excess, third;

  MAGLOC_INLINE EllipticIntegrals(T k_square, T complement, T g) {
    constexpr double right_angle = 1.5707963267948966;
    T x = broadcast<T>(1.0), y = complement, a{}, b = broadcast<T>(1.0), p = maximum(g, broadcast<T>(1e-100));
    T c = 0.5 / (1.0 + complement), sum{};  // c = (x - y)/2k^2 of the last step
    double power = 1.0;
    for (int step = 0; step < 40; ++step) {
      const bool is_last = !any_lane(x - y > 1e-8 * x);
      const T product = x * y, inverse = 1.0 / p, before = a;
      a = 0.5 * (a + b * inverse);
      b = 0.5 * (b + before * product * inverse);
      p = 0.5 * (p + product * inverse);
      x = 0.5 * (x + y), y = square_root(product);
      if (step) c = k_square * c * c / (4.0 * x);
      power *= 2.0;
      sum += power * c * c;
      if (is_last) break;
    }
    first = right_angle / x;
    excess = first * sum;
    second = first * (1.0 - 0.5 * k_square * (1.0 + k_square * sum));
    third = right_angle * (b + a * x) / (x * (x + p));
  }
};

// Derivatives for one end face: phi of a cylinder is the difference of those of its ends, with F = -T(z). z is the
// point's height above the face, a its radius. With the solid angle of the face as N = T + s dT/ds, all derivatives of
// N and T are those of a ring of current.
template <class T>
MAGLOC_INLINE RadialDerivatives<T> end_face(double a, T s, T z) {
  const T rho = square_root(s), wide = a + rho, narrow = a - rho, z_square = z * z;
  const T sum = wide * wide + z_square, distance = narrow * narrow + z_square, inverse = inverse_root(sum);
  const EllipticIntegrals<T> e(4.0 * a * rho / sum, square_root(distance) * inverse, absolute(narrow) / wide);
  const T inverse_s = 1.0 / s, ratio = e.second / distance;
  // D = (K - E)/k^2 without a small divisor.
  const T d = 0.5 * (e.first + 4.0 * a * rho * inverse * inverse * e.excess);
  const T side = choose(narrow < 0.0, broadcast<T>(-1.0), broadcast<T>(1.0));
  const T n = 2.0 * a * z * inverse / wide * (e.first + side * (2.0 * rho / wide) * e.third);
  const T n_z = inverse * (e.first + (a * a - s - z_square) * ratio);
  RadialDerivatives<T> t;
  t.f = 4.0 * a * z * inverse / rho * (d - absolute(narrow) / wide * e.third);
  t.f_z = 16.0 * a * a * inverse * inverse * inverse * e.excess;
  t.f_zz = -2.0 * z * inverse * inverse_s * ((a * a + s + z_square) * ratio - e.first);
  t.f_s = (n - t.f) * inverse_s;
  t.f_sz = (n_z - t.f_z) * inverse_s;
  t.f_ss = (-0.25 * t.f_zz - 2.0 * t.f_s) * inverse_s;
  return t;
}

// The same near the axis and within the radius, where the formulas above divide by s: T = sum of c_n s^n, in which
// Laplace's equation gives c_0 = pi dR/dz and c_n+1 = -c_n''/(4 (n + 1) (n + 2)) with R^2 = a^2 + z^2.
template <class T>
MAGLOC_INLINE RadialDerivatives<T> end_face_near_axis(double a, T s, T z) {
  constexpr int n_terms = 5;
  const T square = 1.0 / (a * a + z * z), inverse = square_root(square);
  T taylor[2 * n_terms + 2];  // (1/j!) d^j R/dz^j
  taylor[1] = z * inverse, taylor[2] = 0.5 * a * a * square * inverse;
  for (int j = 2; j < 2 * n_terms + 1; ++j)
    taylor[j + 1] = (1.0 / (j + 1)) * square * ((1.0 - 2 * j) * z * taylor[j] + (2.0 - j) * taylor[j - 1]);
  RadialDerivatives<T> t{};
  T power[3] = {broadcast<T>(3.141592653589793), T{}, T{}};  // s^n and its derivatives, with factors of c_n
  double factor = 1.0;
  for (int n = 0; n < n_terms; ++n) {
    const T c = taylor[2 * n + 1], c_z = (2 * n + 2.0) * taylor[2 * n + 2];
    t.f += power[0] * c, t.f_s += power[1] * c, t.f_ss += power[2] * c;
    t.f_z += power[0] * c_z, t.f_sz += power[1] * c_z;
    t.f_zz += power[0] * ((2 * n + 2) * (2 * n + 3.0)) * taylor[2 * n + 3];
    factor = -(2 * n + 3.0) / (2 * (n + 2));
    power[2] = factor * (s * power[2] + 2.0 * power[1]);
    power[1] = factor * (s * power[1] + power[0]);
    power[0] = factor * s * power[0];
  }
  return t;
}

// A ring of the given radii and half height; a cylinder if the inner radius is zero.
template <class T>
inline void fill_ring(const double (&size)[3], const T (&d)[3], PotentialDerivatives<T> &phi) {
  constexpr double near_axis = 1e-3, pi = 3.141592653589793;
  const T s = d[0] * d[0] + d[1] * d[1];
  RadialDerivatives<T> f{};
  for (int radius = 0; radius < 2; ++radius)
    for (int end = 0; end < 2; ++end) {
      const double a = size[radius];
      if (a == 0.0) continue;
      const T z = end ? d[2] + size[2] : d[2] - size[2];
      const auto is_near = s < minimum(near_axis * (a * a + z * z), broadcast<T>(a * a));
      RadialDerivatives<T> t{};
      if (any_lane(is_near)) t = end_face_near_axis(a, s, z);
      if (!all_lanes(is_near)) {
        const RadialDerivatives<T> far = end_face(a, s, z);
        t.f = choose(is_near, t.f, far.f), t.f_s = choose(is_near, t.f_s, far.f_s);
        t.f_z = choose(is_near, t.f_z, far.f_z), t.f_ss = choose(is_near, t.f_ss, far.f_ss);
        t.f_sz = choose(is_near, t.f_sz, far.f_sz), t.f_zz = choose(is_near, t.f_zz, far.f_zz);
      }
      f.add(radius == end ? -1.0 : 1.0, t);
    }
  f.fill(d, phi);
  phi.scale(broadcast<T>(1.0 / (2.0 * pi * (size[1] - size[0]) * (size[1] + size[0]) * size[2])));
}

// Multipoles of a ring along its axis up to the tenth order, the mean of r^n P_n(z/r) over the body; odd ones are zero.
constexpr int n_multipoles = 11;
inline void fill_multipoles(const double (&size)[3], double (&q)[n_multipoles]) {
  const double inner = size[0] * size[0], outer = size[1] * size[1], height = size[2] * size[2];
  for (int n = 0; n < n_multipoles; n += 2) {
    q[n] = 0.0;
    double factor = 1.0;  // (-1)^k n!/((n - 2k)! k!^2 4^k)
    for (int k = 0; 2 * k <= n; ++k) {
      double axial = 1.0 / (n - 2 * k + 1), radial = 0.0;  // means of z^(n - 2k) and rho^2k
      for (int i = 0; i < n / 2 - k; ++i) axial *= height;
      for (int i = 0; i <= k; ++i) {
        double term = 1.0 / (k + 1);
        for (int j = 0; j < k; ++j) term *= j < i ? inner : outer;
        radial += term;
      }
      q[n] += factor * axial * radial;
      factor *= -double(n - 2 * k) * (n - 2 * k - 1) / (4.0 * (k + 1) * (k + 1));
    }
  }
}

// A ring far away. Derivatives of P_n(c)/r^(n+1) by z and s are Gegenbauer polynomials of c over powers of r.
template <class T>
inline void fill_far_ring(const double (&q)[n_multipoles], const T (&d)[3], PotentialDerivatives<T> &phi) {
  const T inverse = inverse_root(dot(d, d)), c = d[2] * inverse;
  RadialDerivatives<T> f{};
  T before[3] = {}, gegenbauer[3], scale[3];  // (-1)^k P_(n+k)^(k)/r^(n+2k+1) = (2k-1)!! C_n^(k+1/2) scale
  T power = inverse;
  const double double_factorial[3] = {-1.0, 3.0, -15.0};
  for (int k = 0; k < 3; ++k) {
    power = power * inverse * inverse;
    gegenbauer[k] = broadcast<T>(1.0), scale[k] = double_factorial[k] * power;
  }
  for (int n = 0; n < n_multipoles + 2; ++n) {
    T term[3];
    for (int k = 0; k < 3; ++k) term[k] = scale[k] * gegenbauer[k];
    if (n % 2) {
      f.f_z -= n * q[n - 1] * term[0], f.f_sz -= 0.5 * n * q[n - 1] * term[1];
    } else {
      if (n < n_multipoles) f.f += q[n] * term[0], f.f_s += 0.5 * q[n] * term[1], f.f_ss += 0.25 * q[n] * term[2];
      if (n > 0) f.f_zz += (n - 1.0) * n * q[n - 2] * term[0];
    }
    for (int k = 0; k < 3; ++k) {
      const double order = k + 1.5;
      const T next = (1.0 / (n + 1)) * (2.0 * (n + order) * c * gegenbauer[k] - (n + 2.0 * order - 1.0) * before[k]);
      before[k] = gegenbauer[k], gegenbauer[k] = next, scale[k] = scale[k] * inverse;
    }
  }
  f.fill(d, phi);
}
MAGLOC_END
