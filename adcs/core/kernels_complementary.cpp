// Filters of a gyro and two vectors, and what an inertial unit shows without a magnetometer.
#include "adcs/complementary.hpp"
#include "adcs/inertial.hpp"
#include "magloc/kernel.hpp"

using namespace magloc;

MAGLOC_KERNEL(complementary_filter, complementary) {
  const magloc_complementary &p = *problem;
  Workspace memory(workspace);
  auto *state = memory.take<ComplementaryFilter>(1);
  auto *delayed = memory.take<VectorPair>(p.delay);
  if (!workspace) return memory.size();
  ComplementaryFilter filter = *state;
  for_instants(*p.record, begin, end, [&](const RecordInstant &at) {
    const int64_t row = at.row();
    if (at.i == 0)
      filter = ComplementaryFilter::start(quaternion_at(p.q + 4 * row), vector_at(p.integral + 3 * row));
    else
      filter.turn(p, at);
    filter.correct(p, at, delayed);
    store(filter.attitude(), p.q + 4 * row);
    store(filter.integral(), p.integral + 3 * row);
    if (p.is_gauss_newton) store(filter.measured(), p.q_measured + 4 * row);
  });
  *state = filter;
  return 0;
}

MAGLOC_KERNEL(adaptive_filter, adaptive) {
  const magloc_adaptive &p = *problem;
  Workspace memory(workspace);
  auto *state = memory.take<AdaptiveFilter>(1);
  if (!workspace) return memory.size();
  AdaptiveFilter filter = *state;
  for_instants(*p.record, begin, end, [&](const RecordInstant &at) {
    const int64_t row = at.row();
    if (at.i == 0)
      filter =
          AdaptiveFilter::start(quaternion_at(p.q + 4 * row), vector_at(p.bias + 3 * row), p.covariance + 36 * row);
    else
      filter.predict(p, at);
    filter.update(p, at);
    filter.store(p, row);
  });
  *state = filter;
  return 0;
}

MAGLOC_KERNEL(gyro_attitudes, gyro) {
  if (!workspace) return 0;
  const magloc_gyro &p = *problem;
  for (int64_t i = begin; i < end; ++i) {
    Quaternion<double> q = identity;
    if (i > 0) q = normalised(quaternion_at(p.q + 4 * i - 4) * exponential(p.dt[i] * vector_at(p.rate + 3 * i)));
    store(q, p.q + 4 * i);
  }
  return 0;
}

MAGLOC_KERNEL(level_attitudes, level) {
  const magloc_level &p = *problem;
  Workspace memory(workspace);
  auto *level_from_gyro = memory.take<Quaternion<double>>(1);
  if (!workspace) return memory.size();
  if (begin == 0) *level_from_gyro = quaternion_at(p.start);
  for (int64_t i = begin; i < end; ++i) {
    const Vector<double> up = rotate(*level_from_gyro, normalised(vector_at(p.up + 3 * i)));
    const Quaternion<double> turn = exponential(Vector<double>{{p.part[i] * up[1], -p.part[i] * up[0], 0.0}});
    *level_from_gyro = normalised(turn * *level_from_gyro);
    store(*level_from_gyro * quaternion_at(p.q_gyro + 4 * i), p.q + 4 * i);
  }
  return 0;
}

MAGLOC_KERNEL(low_pass, butterworth) {
  const magloc_butterworth &p = *problem;
  Workspace memory(workspace);
  auto *columns = memory.take<LowPass<double>>(p.n_columns);
  if (!workspace) return memory.size();
  if (begin == 0)
    for (int64_t k = 0; k < p.n_columns; ++k) columns[k].start(p.start[k]);
  for (int64_t i = begin; i < end; ++i) {
    double cosine, sine;
    damped_rotation(p.steps[i], cosine, sine);
    for (int64_t k = 0; k < p.n_columns; ++k) {
      LowPass<double> &column = columns[k];
      const double value = p.values[p.n_columns * i + k], input = value == value ? value : column.input;
      if (i > 0)
        column.step(cosine, sine, input);
      else
        column.input = input;
      p.out[p.n_columns * i + k] = column.output;
    }
  }
  return 0;
}

MAGLOC_KERNEL(lag_changes, lags) {
  const magloc_lags &p = *problem;
  Workspace memory(workspace);
  auto *steady = memory.take<Vector<double>>(p.n_rows);
  if (!workspace) return memory.size();
  for (int64_t item = begin; item < end; ++item) {
    double change = 0.0;
    for (int64_t i = 0, before = 0; i < p.n_rows; ++i) {
      const double t = p.time[p.rows[i]] - p.lags[item];
      while (before + 2 < p.n_instants && p.time[before + 1] <= t) ++before;
      const double share = t > p.time[0] ? (t - p.time[before]) / (p.time[before + 1] - p.time[before]) : 0.0;
      const double *q = p.q + 4 * before, *after = share > 0.0 ? q + 4 : q;
      const Quaternion<double> then = (1.0 - share) * quaternion_at(q) + share * quaternion_at(after);
      steady[i] = rotate(normalised(then), vector_at(p.field + 3 * p.rows[i]));
      if (i < p.apart || !p.is_good[i] || !p.is_good[i - p.apart]) continue;
      const Vector<double> difference = steady[i] - steady[i - p.apart];
      change += dot(difference, difference);
    }
    p.changes[item] = change;
  }
  return 0;
}
