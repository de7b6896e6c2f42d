// Heading of an inertial unit with a magnetometer.
#include "adcs/attitude_filter.hpp"
#include "magloc/kernel.hpp"

using namespace magloc;

MAGLOC_KERNEL(heading_filter, heading) {
  const magloc_heading &p = *problem;
  Workspace memory(workspace);
  auto *run = memory.take<HeadingRun<double>>(1);
  if (!workspace) return memory.size();
  if (begin == 0) {
    HeadingFilter<double> &filter = run->filter();
    __builtin_memcpy(filter.x, p.x, sizeof filter.x);
    __builtin_memcpy(filter.P, p.P, sizeof filter.P);
    run->start();
  }
  const HeadingRules<double> rules = rules_of(p);
  for (int64_t i = begin; i < end; ++i) {
    const auto outcome = run->step(rules, block_of(p, i));
    if (outcome.is_used) p.used[i] = p.known[i] = 1;
    for (int64_t k = 0; k < outcome.accepted; ++k) p.known[i - k] = k == outcome.accepted - 1 ? 2 : 1;
    for (int k = 0; k < 4; ++k) {
      const int state = told_states[k];
      p.told[4 * i + k] = run->filter().x[state];
      p.variances[4 * i + k] = run->filter().P[state][state];
    }
  }
  return 0;
}

MAGLOC_KERNEL(heading_smoother, heading) {
  const int64_t n = problem->n_blocks;
  Workspace memory(workspace);
  auto *smoother = memory.take<HeadingSmoother>(1);
  auto *filtered = memory.take<HeadingFilter<double>>(n);
  if (!workspace) return memory.size();
  if (begin == 0) smoother->start(*problem);
  for (int64_t i = begin; i < end; ++i) {
    if (i < n)
      smoother->forward(*problem, i, filtered);
    else
      smoother->backward(*problem, 2 * n - 1 - i, filtered);
  }
  return 0;
}

// With a null pointer the size of the state in doubles: the state is the workspace.
MAGLOC_KERNEL(attitude_filter, attitude) {
  const magloc_attitude &p = *problem;
  constexpr int64_t size = (sizeof(AttitudeFilter<double>) + 7) / 8;
  if (!workspace) return size;
  auto &filter = *reinterpret_cast<AttitudeFilter<double> *>(p.state);
  if (begin == 0 && !p.resume) {
    AttitudeConfig<double> config;
    static_assert(sizeof config.model == 22 * sizeof(double), "as many as adcs.HeadingModel has");
    __builtin_memcpy(static_cast<void *>(&config.model), p.model, sizeof config.model);
    config.lag_s = p.lag;
    config.is_point_sample = p.is_point_sample != 0;
    config.disturbance = (Disturbance)p.disturbance;
    filter.start(config);
  }
  for (int64_t i = begin; i < end; ++i) {
    p.status[i] = (int64_t)filter.update(p.time[i], p.rate + 3 * i, p.acceleration + 3 * i, p.field + 3 * i);
    const AttitudeEstimate<double> &now = filter.estimate();
    for (int k = 0; k < 4; ++k) p.q[4 * i + k] = now.q[k];
    p.sigma[2 * i] = now.sigma_tilt, p.sigma[2 * i + 1] = now.sigma_heading;
    for (int k = 0; k < 3; ++k) {
      p.corrected_rate[3 * i + k] = now.rate[k];
      p.bias[3 * i + k] = now.bias[k];
      p.offset[3 * i + k] = now.offset_T[k];
    }
    p.flags[i] = now.flags;
  }
  return 0;
}
