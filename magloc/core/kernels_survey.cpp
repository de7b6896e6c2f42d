// Surveys: what makes their noise white, and columns of the Jacobian.
#include "magloc/dipole.hpp"
#include "magloc/kernel.hpp"

MAGLOC_BEGIN
// Fill n columns of each source: matrix(ray, m, f) computes f (n, 3), what the field's axes read of sources of moments
// m, one in each lane, and at(q, j) is the place of the column j of source q.
template <int n, class Matrix, class At>
MAGLOC_INLINE int64_t fill_columns(const magloc_survey_columns &p, int64_t begin, int64_t end, double *workspace,
                                   Matrix matrix, At at) {
  const int64_t K = p.n_measurements, n_blocks = n_registers<Lanes>(p.n_sources);
  Workspace room(workspace);
  auto *direction = room.take<double[3]>(p.n_sensors * K);  // that a measurement reads at a sensor
  auto *sum = room.take<Lanes[n]>(n_blocks * K);
  if (!workspace) return room.size();
  for (int64_t i = begin; i < end; ++i) {
    const int64_t first = p.first_row[p.groups[i]], after = p.first_row[p.groups[i] + 1];
    const double scale = 1.0 / square_root((double)(after - first));
    for (int64_t k = 0; k < n_blocks * K; ++k)
      for (Lanes &x : sum[k]) x = Lanes{};
    for (int64_t row = first; row < after; ++row) {
      for (int64_t k = 0; k < p.n_sensors * K; ++k)
        for (double &x : direction[k]) x = 0.0;
      for (int64_t c = 0; c < p.n_channels; ++c)
        for (int64_t k = 0; k < K; ++k)
          for (int a = 0; a < 3; ++a)
            direction[p.sensor_of_channel[c] * K + k][a] +=
                scale * p.mixing[k * p.n_channels + c] * p.directions[3 * (row * p.n_channels + c) + a];
      for (int64_t block = 0; block < n_blocks; ++block) {
        Lanes place[3], m[3] = {};
        for (int a = 0; a < 3; ++a) {
          place[a] = load_component<Lanes>(p.sources, block * n_lanes<Lanes>, p.n_sources, a);
          if (p.moments) m[a] = load_component<Lanes>(p.moments, block * n_lanes<Lanes>, p.n_sources, a);
        }
        for (int64_t s = 0; s < p.n_sensors; ++s) {
          Lanes d[3], f[n][3];
          for (int a = 0; a < 3; ++a) d[a] = p.sensors[3 * (row * p.n_sensors + s) + a] - place[a];
          matrix(Ray<Lanes>::from(d), m, f);
          for (int64_t k = 0; k < K; ++k) {
            const double (&u)[3] = direction[s * K + k];
            if (u[0] == 0.0 && u[1] == 0.0 && u[2] == 0.0) continue;
            for (int j = 0; j < n; ++j) sum[block * K + k][j] += dot(f[j], u);
          }
        }
      }
    }
    for (int64_t k = 0; k < K; ++k)
      for (int64_t q = 0; q < p.n_sources; ++q)
        for (int j = 0; j < n; ++j)
          p.out[(i * K + k) * n * p.n_sources + at(q, j)] =
              get_lane(sum[q / n_lanes<Lanes> * K + k][j], q % n_lanes<Lanes>);
  }
  return 0;
}

// y += a x, of n numbers.
inline void add_multiple(int64_t n, double a, const double *__restrict x, double *__restrict y) {
  MAGLOC_UNROLL
  for (int64_t i = 0; i < n; ++i) y[i] += a * x[i];
}
MAGLOC_END

using namespace magloc;

MAGLOC_KERNEL(survey_gains, survey_filter) {
  const magloc_survey_filter &p = *problem;
  const int64_t n = p.n_states;
  Workspace room(workspace);
  double *P = room.take<double>(n * n), *Ph = room.take<double>(n);
  if (!workspace) return room.size();
  if (begin == 0)
    for (int64_t a = 0; a < n; ++a)
      for (int64_t b = 0; b < n; ++b) P[a * n + b] = a == b ? p.start[a] : 0.0;
  for (int64_t i = begin; i < end; ++i) {
    const double *kept = p.kept + i * n;
    for (int64_t a = 0; a < n; ++a)
      for (int64_t b = 0; b < n; ++b) P[a * n + b] *= kept[a] * kept[b];
    for (int64_t b = 0; b < n; ++b) P[(n - 2) * n + b] += p.dt[i] * P[(n - 1) * n + b];
    for (int64_t a = 0; a < n; ++a) P[a * n + n - 2] += p.dt[i] * P[a * n + n - 1];
    for (int64_t a = 0; a < n; ++a) P[a * n + a] += p.added[i * n + a];
    for (int64_t k = i * p.n_measurements; k < (i + 1) * p.n_measurements; ++k) {
      const double *h = p.H + k * n;
      double *gains = p.gains + k * (n + 1), variance = 1.0;
      for (int64_t a = 0; a < n; ++a) Ph[a] = 0.0;
      for (int64_t b = 0; b < n; ++b)
        for (int64_t a = 0; a < n; ++a) Ph[a] += h[b] * P[b * n + a];
      for (int64_t a = 0; a < n; ++a) variance += h[a] * Ph[a];
      const double inverse = 1.0 / variance;
      for (int64_t a = 0; a < n; ++a) gains[a] = inverse * Ph[a];
      for (int64_t a = 0; a < n; ++a)
        for (int64_t b = 0; b < n; ++b) P[a * n + b] -= inverse * (Ph[a] * Ph[b]);  // this stays symmetric
      gains[n] = square_root(inverse);
    }
  }
  return 0;
}

MAGLOC_KERNEL(survey_whiten, survey_whitening) {
  const magloc_survey_filter &filter = *problem->filter;
  const int64_t n = filter.n_states, m = problem->n_columns;
  Workspace room(workspace);
  double *states = room.take<double>(n * m), *kept = room.take<double>(n);
  if (!workspace) return room.size();
  if (begin == 0) __builtin_memset(states, 0, n * m * sizeof(double));
  for (int64_t i = begin; i < end; ++i) {
    const int64_t row = problem->rows[i];
    double passed = 0.0;
    for (int64_t a = 0; a < n; ++a) kept[a] = 1.0;
    for (int64_t step = i == 0 ? 0 : problem->rows[i - 1] + 1; step <= row; ++step) {
      passed += filter.dt[step];
      for (int64_t a = 0; a < n; ++a) kept[a] *= filter.kept[step * n + a];
    }
    for (int64_t a = 0; a < n; ++a)
      if (kept[a] != 1.0)
        for (int64_t c = 0; c < m; ++c) states[a * m + c] *= kept[a];
    add_multiple(m, passed, states + (n - 1) * m, states + (n - 2) * m);
    for (int64_t k = 0; k < filter.n_measurements; ++k) {
      const double *h = filter.H + (row * filter.n_measurements + k) * n;
      const double *gains = filter.gains + (row * filter.n_measurements + k) * (n + 1);
      double *y = problem->columns + (i * filter.n_measurements + k) * m;
      for (int64_t a = 0; a < n; ++a)
        if (h[a] != 0.0) add_multiple(m, -h[a], states + a * m, y);
      for (int64_t a = 0; a < n; ++a) add_multiple(m, gains[a], y, states + a * m);
      for (int64_t c = 0; c < m; ++c) y[c] *= gains[n];
    }
  }
  return 0;
}

MAGLOC_KERNEL(survey_moments, survey_columns) {
  return fill_columns<3>(
      *problem, begin, end, workspace,
      [](const Ray<Lanes> &ray, const Lanes(&)[3], Lanes(&f)[3][3]) {
        field_matrix(ray, f);
        for (auto &row : f)
          for (Lanes &x : row) x *= mu0_over_4pi;
      },
      [&](int64_t source, int j) { return j * problem->n_sources + source; });
}

MAGLOC_KERNEL(survey_sources, survey_columns) {
  return fill_columns<6>(
      *problem, begin, end, workspace,
      [](const Ray<Lanes> &ray, const Lanes(&m)[3], Lanes(&f)[6][3]) {
        Lanes by_source[3][3], by_moment[3][3];
        gradient(ray, m, by_source);
        field_matrix(ray, by_moment);
        for (int a = 0; a < 3; ++a)
          for (int b = 0; b < 3; ++b) {
            f[a][b] = -mu0_over_4pi * by_source[a][b];
            f[3 + a][b] = mu0_over_4pi * by_moment[a][b];
          }
      },
      [](int64_t source, int j) { return 6 * source + j; });
}

MAGLOC_KERNEL(survey_poles, survey_columns) {
  return fill_columns<1>(
      *problem, begin, end, workspace,
      [](const Ray<Lanes> &ray, const Lanes(&)[3], Lanes(&f)[1][3]) {
        for (int a = 0; a < 3; ++a) f[0][a] = ray.n[a] * ray.inverse_r * ray.inverse_r;
      },
      [](int64_t source, int) { return source; });
}
