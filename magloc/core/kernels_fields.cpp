// Fields of dipoles at many points.
#include "magloc/dipole.hpp"
#include "magloc/kernel.hpp"

MAGLOC_BEGIN
// Call use(i, ray, m) for the points i, i + 1, ..., one in each lane, and each source in order.
template <class Start, class Use, class Stop>
MAGLOC_INLINE void for_points(const magloc_dipoles &p, int64_t begin, int64_t end, Start start, Use use, Stop stop) {
  for (int64_t i = begin; i < end; i += n_lanes<Lanes>) {
    start();
    for (int64_t k = 0; k < p.n_sources; ++k) {
      Lanes d[3], m[3];
      for (int a = 0; a < 3; ++a) {
        d[a] = load_component<Lanes>(p.points, i, end, a) - p.sources[3 * k + a];
        m[a] = broadcast<Lanes>(p.moments[3 * k + a]);
      }
      use(Ray<Lanes>::from(d), m);
    }
    for (int lane = 0; lane < n_lanes<Lanes> && i + lane < end; ++lane) stop(i + lane, lane);
  }
}
MAGLOC_END

using namespace magloc;

MAGLOC_KERNEL(dipole_fields, dipoles) {
  if (!workspace) return 0;
  Lanes sum[3];
  for_points(
      *problem, begin, end, [&] { sum[0] = sum[1] = sum[2] = Lanes{}; },
      [&](const Ray<Lanes> &ray, const Lanes(&m)[3]) {
        Lanes b[3];
        field(ray, m, b);
        for (int a = 0; a < 3; ++a) sum[a] += b[a];
      },
      [&](int64_t point, int lane) {
        for (int a = 0; a < 3; ++a) problem->out[3 * point + a] = mu0_over_4pi * get_lane(sum[a], lane);
      });
  return 0;
}

MAGLOC_KERNEL(dipole_gradients, dipoles) {
  if (!workspace) return 0;
  Lanes sum[3][3];
  for_points(
      *problem, begin, end,
      [&] {
        for (auto &row : sum) row[0] = row[1] = row[2] = Lanes{};
      },
      [&](const Ray<Lanes> &ray, const Lanes(&m)[3]) {
        Lanes g[3][3];
        gradient(ray, m, g);
        for (int a = 0; a < 3; ++a)
          for (int b = 0; b < 3; ++b) sum[a][b] += g[a][b];
      },
      [&](int64_t point, int lane) {
        for (int a = 0; a < 9; ++a) problem->out[9 * point + a] = mu0_over_4pi * get_lane(sum[a / 3][a % 3], lane);
      });
  return 0;
}
