// Magnets of known shape: the field of shapes.hpp outside them, and its derivatives by place and moment of a magnet
// that is magnetised along its axis.
#pragma once
#include "shapes.hpp"

MAGLOC_BEGIN
// Number of a shape in magloc.h. A dipole is a sphere without a size.
struct Shape {
  enum : int64_t { dipole, cuboid, ring, sphere };
};

// A body's shape, and the distance from which its field is a series.
template <class T>
class MagnetBody {
  int64_t shape_;
  double size_[3], multipoles_[n_multipoles], far_square_;

  // Fill the derivatives outside, near or far; both if lanes differ.
  template <class Near, class Far>
  MAGLOC_INLINE void fill(const T (&d)[3], PotentialDerivatives<T> &phi, Near near, Far far) const {
    const auto is_far = dot(d, d) > far_square_;
    if (any_lane(is_far)) far(phi);
    if (all_lanes(is_far)) return;
    PotentialDerivatives<T> other;
    near(any_lane(is_far) ? other : phi);
    if (!any_lane(is_far)) return;
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) {
        phi.second[i][j] = choose(is_far, phi.second[i][j], other.second[i][j]);
        for (int k = 0; k < 3; ++k) phi.third[i][j][k] = choose(is_far, phi.third[i][j][k], other.third[i][j][k]);
      }
  }

 public:
  MagnetBody(int64_t shape, const double (&size)[3]) : shape_(shape), multipoles_{} {
    double longest = 0.0;
    for (int i = 0; i < 3; ++i) size_[i] = size[i], longest = maximum(longest, 2.0 * size_[i]);
    if (shape_ == Shape::ring) fill_multipoles(size_, multipoles_);
    // The errors of the series and of the rounding in the closed forms cross there, near 1e-11.
    far_square_ =
        shape_ == Shape::ring ? 100.0 * (size_[1] * size_[1] + size_[2] * size_[2]) : 225.0 * longest * longest;
  }

  MAGLOC_INLINE void fill(const T (&d)[3], PotentialDerivatives<T> &phi) const {
    if (shape_ == Shape::cuboid)
      fill(
          d, phi, [&](auto &near) { fill_cuboid(size_, d, near); }, [&](auto &far) { fill_far_cuboid(size_, d, far); });
    else if (shape_ == Shape::ring)
      fill(
          d, phi, [&](auto &near) { fill_ring(size_, d, near); },
          [&](auto &far) { fill_far_ring(multipoles_, d, far); });
    else
      phi = {}, add_dipole(d, 1.0, phi);
  }

  // The same of the body rolled about z by an angle of the given cosine and sine, with a weight, added. Of third
  // derivatives only those by z of the second ones: the field of a moment along z needs no others.
  MAGLOC_INLINE void add_rolled(const T (&d)[3], T cosine, T sine, double weight, PotentialDerivatives<T> &sum) const {
    const T zero{}, turn[3][3] = {{cosine, sine, zero}, {-sine, cosine, zero}, {zero, zero, broadcast<T>(1.0)}};
    T local[3];
    for (int i = 0; i < 3; ++i) local[i] = dot(turn[i], d);
    PotentialDerivatives<T> phi;
    fill(local, phi);
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j)
        for (int a = 0; a < 3; ++a)
          for (int b = 0; b < 3; ++b) {
            const T factor = weight * turn[a][i] * turn[b][j];
            sum.second[i][j] += factor * phi.second[a][b];
            sum.third[i][j][2] += factor * phi.third[a][b][2];
          }
  }

  // Mean over rolls of a cuboid of equal edges across z: over four, which leaves a sixteenth harmonic.
  MAGLOC_INLINE void fill_mean(const T (&d)[3], PotentialDerivatives<T> &phi) const {
    if (shape_ != Shape::cuboid) {
      fill(d, phi);
      return;
    }
    phi = {};
    constexpr double half = 0.7071067811865476, more = 0.9238795325112867, less = 0.3826834323650898;
    constexpr double turns[4][2] = {{1.0, 0.0}, {more, less}, {half, half}, {less, more}};
    for (const auto &turn : turns) add_rolled(d, broadcast<T>(turn[0]), broadcast<T>(turn[1]), 0.25, phi);
  }

  // How far outside a point is, in one of the coordinates that bound the body; not above zero inside.
  MAGLOC_INLINE T outside(const T (&d)[3]) const {
    const T s = d[0] * d[0] + d[1] * d[1], rho = square_root(s);
    if (shape_ == Shape::dipole || shape_ == Shape::sphere) return square_root(s + d[2] * d[2]) - size_[0];
    const T along = absolute(d[2]) - size_[2];
    if (shape_ == Shape::ring) return maximum(along, maximum(rho - size_[1], size_[0] - rho));
    return maximum(along, maximum(absolute(d[0]) - size_[0], absolute(d[1]) - size_[1]));
  }
};

// Field of a body that is magnetised along its z axis, at d from it, and its derivatives by the body's place and by its
// moment m, with which the body turns. By default a cuboid, of equal edges across the moment, counts as the mean over
// its rolls; otherwise its roll has the given cosine and sine.
template <class T>
struct AlignedField {
  T field[3], by_position[3][3], by_moment[3][3], by_roll[3];

  MAGLOC_INLINE AlignedField(const MagnetBody<T> &body, const T (&d)[3], const T (&m)[3], const T *roll = nullptr) {
    const T inverse = inverse_root(dot(m, m)), strength = 1.0 / inverse;
    // The frame's axes by the least turn of its z axis, or of the opposite one where that is ambiguous, to the moment.
    const T n[3] = {m[0] * inverse, m[1] * inverse, m[2] * inverse}, one = broadcast<T>(1.0);
    const T sign = choose(n[2] > -0.9999, one, -one), a = -1.0 / (sign + n[2]), mixed = n[0] * n[1] * a;
    const T axes[3][3] = {{1.0 + sign * n[0] * n[0] * a, sign * mixed, -sign * n[0]},
                          {mixed, sign + n[1] * n[1] * a, -n[1]},
                          {n[0], n[1], n[2]}};
    T local[3];
    for (int i = 0; i < 3; ++i) local[i] = dot(axes[i], d);
    PotentialDerivatives<T> phi;
    if (roll)
      phi = {}, body.add_rolled(local, roll[0], roll[1], 1.0, phi);
    else
      body.fill_mean(local, phi);
    const T outside = choose(body.outside(local) > 0.0, one, broadcast<T>(nan));
    // Of B = M (phi_xz, phi_yz, phi_zz) in the body's axes: a turn w of the body changes it by w x B + M phi_z d x w.
    T b[3], slope[3][3], by_turn[3][3], by_local_moment[3][3];
    for (int i = 0; i < 3; ++i) {
      b[i] = outside * strength * phi.second[i][2];
      for (int j = 0; j < 3; ++j) slope[i][j] = outside * strength * phi.third[i][j][2];
      by_local_moment[i][2] = outside * phi.second[i][2];
    }
    for (int i = 0; i < 3; ++i) {
      cross(slope[i], local, by_turn[i]);
      const int j = (i + 1) % 3, k = (i + 2) % 3;
      by_turn[i][j] += b[k];
      by_turn[i][k] -= b[j];
      by_local_moment[i][0] = inverse * by_turn[i][1];
      by_local_moment[i][1] = -inverse * by_turn[i][0];
    }
    for (int i = 0; i < 3; ++i) {
      field[i] = axes[0][i] * b[0] + axes[1][i] * b[1] + axes[2][i] * b[2];
      by_roll[i] = axes[0][i] * by_turn[0][2] + axes[1][i] * by_turn[1][2] + axes[2][i] * by_turn[2][2];
      for (int j = 0; j < 3; ++j) {
        by_position[i][j] = by_moment[i][j] = T{};
        for (int k = 0; k < 3; ++k)
          for (int l = 0; l < 3; ++l) {
            const T turn = axes[k][i] * axes[l][j];
            by_position[i][j] -= turn * slope[k][l];
            by_moment[i][j] += turn * by_local_moment[k][l];
          }
      }
    }
  }
};
MAGLOC_END
