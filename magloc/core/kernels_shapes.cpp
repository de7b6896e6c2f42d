// Fields of magnets of known shape.
#include "magloc/dipole.hpp"
#include "magloc/kernel.hpp"
#include "magloc/magnets.hpp"

using namespace magloc;

MAGLOC_KERNEL(shape_fields, magnets) {
  if (!workspace) return 0;
  const MagnetBody<Lanes> body(problem->shape, problem->size);
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

MAGLOC_KERNEL(aligned_fields, aligned_magnets) {
  if (!workspace) return 0;
  const MagnetBody<Lanes> body(problem->shape, problem->size);
  for (int64_t i = begin; i < end; i += n_lanes<Lanes>) {
    Lanes d[3], m[3];
    for (int a = 0; a < 3; ++a) {
      d[a] = load_component<Lanes>(problem->points, i, end, a);
      m[a] = load_component<Lanes>(problem->moments, i, end, a);
    }
    Lanes roll[2]{};
    for (int lane = 0; problem->rolls && lane < n_lanes<Lanes>; ++lane)
      for (int a = 0; a < 2; ++a)
        set_lane(roll[a], lane, problem->rolls[2 * (i + lane < end ? i + lane : end - 1) + a]);
    const AlignedField<Lanes> found(body, d, m, problem->rolls ? roll : nullptr);
    for (int lane = 0; lane < n_lanes<Lanes> && i + lane < end; ++lane)
      for (int a = 0; a < 3; ++a) {
        const int64_t row = 3 * (i + lane) + a;
        problem->fields[row] = mu0_over_4pi * get_lane(found.field[a], lane);
        problem->jacobians[7 * row + 6] = mu0_over_4pi * get_lane(found.by_roll[a], lane);
        for (int b = 0; b < 3; ++b) {
          problem->jacobians[7 * row + b] = mu0_over_4pi * get_lane(found.by_position[a][b], lane);
          problem->jacobians[7 * row + 3 + b] = mu0_over_4pi * get_lane(found.by_moment[a][b], lane);
        }
      }
  }
  return 0;
}
