// Fields of magnets of known shape.
#include "magloc/dipole.hpp"
#include "magloc/kernel.hpp"
#include "magloc/shapes.hpp"

MAGLOC_BEGIN
// A body's shape, and the distance from which its field is a series.
class Body {
  int64_t shape_;
  double size_[3], multipoles_[n_multipoles], far_square_;

  // Fill the derivatives outside, near or far; both if lanes differ.
  template <class Near, class Far>
  MAGLOC_INLINE void fill(const Lanes (&d)[3], PotentialDerivatives<Lanes> &phi, Near near, Far far) const {
    const Mask is_far = dot(d, d) > far_square_;
    if (any_lane(is_far)) far(phi);
    if (all_lanes(is_far)) return;
    PotentialDerivatives<Lanes> other;
    near(any_lane(is_far) ? other : phi);
    if (!any_lane(is_far)) return;
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) {
        phi.second[i][j] = choose(is_far, phi.second[i][j], other.second[i][j]);
        for (int k = 0; k < 3; ++k) phi.third[i][j][k] = choose(is_far, phi.third[i][j][k], other.third[i][j][k]);
      }
  }

 public:
  explicit Body(const magloc_magnets &p) : shape_(p.shape), multipoles_{} {
    double longest = 0.0;
    for (int i = 0; i < 3; ++i) size_[i] = p.size[i], longest = maximum(longest, 2.0 * size_[i]);
    if (shape_ == 1) fill_multipoles(size_, multipoles_);
    // The errors of the series and of the rounding in the closed forms cross there, near 1e-11.
    far_square_ = shape_ == 1 ? 100.0 * (size_[1] * size_[1] + size_[2] * size_[2]) : 225.0 * longest * longest;
  }

  MAGLOC_INLINE void fill(const Lanes (&d)[3], PotentialDerivatives<Lanes> &phi) const {
    if (shape_ == 0)
      fill(
          d, phi, [&](auto &near) { fill_cuboid(size_, d, near); }, [&](auto &far) { fill_far_cuboid(size_, d, far); });
    else if (shape_ == 1)
      fill(
          d, phi, [&](auto &near) { fill_ring(size_, d, near); },
          [&](auto &far) { fill_far_ring(multipoles_, d, far); });
    else
      phi = {}, add_dipole(d, 1.0, phi);
  }

  // How far outside a point is, in one of the coordinates that bound the body; not above zero inside.
  MAGLOC_INLINE Lanes outside(const Lanes (&d)[3]) const {
    const Lanes s = d[0] * d[0] + d[1] * d[1], rho = square_root(s);
    if (shape_ == 2) return square_root(s + d[2] * d[2]) - size_[0];
    const Lanes along = absolute(d[2]) - size_[2];
    if (shape_ == 1) return maximum(along, maximum(rho - size_[1], size_[0] - rho));
    return maximum(along, maximum(absolute(d[0]) - size_[0], absolute(d[1]) - size_[1]));
  }
};
MAGLOC_END

using namespace magloc;

MAGLOC_KERNEL(shape_fields, magnets) {
  if (!workspace) return 0;
  const Body body(*problem);
  for (int64_t i = begin; i < end; i += n_lanes<Lanes>) {
    Lanes d[3], m[3];
    for (int a = 0; a < 3; ++a) {
      d[a] = load_component<Lanes>(problem->points, i, end, a);
      m[a] = load_component<Lanes>(problem->moments, i, end, a);
    }
    PotentialDerivatives<Lanes> phi;
    body.fill(d, phi);
    phi.scale(choose(body.outside(d) > 0.0, broadcast<Lanes>(mu0_over_4pi), broadcast<Lanes>(nan)));
    for (int a = 0; a < 3; ++a) {
      const Lanes field = dot(phi.second[a], m);
      for (int lane = 0; lane < n_lanes<Lanes> && i + lane < end; ++lane)
        problem->fields[3 * (i + lane) + a] = get_lane(field, lane);
      for (int b = 0; b < 3; ++b) {
        const Lanes slope = dot(phi.third[a][b], m);
        for (int lane = 0; lane < n_lanes<Lanes> && i + lane < end; ++lane) {
          problem->matrices[9 * (i + lane) + 3 * a + b] = get_lane(phi.second[a][b], lane);
          problem->gradients[9 * (i + lane) + 3 * a + b] = get_lane(slope, lane);
        }
      }
    }
  }
  return 0;
}
