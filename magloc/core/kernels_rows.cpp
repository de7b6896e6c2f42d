// Steps of a filter of several sources. An item is a Gaussian, a trajectory, or a row of a track.
#include "magloc/smoother.hpp"
#include "magloc/track.hpp"

using namespace magloc;

MAGLOC_KERNEL(predict_row, row_prediction) {
  const magloc_sources &before = *problem->before, &after = *problem->after;
  Workspace space(workspace);
  RowFilter<Lanes> filter(before, *problem->rows, space);
  SourceMotion motion(*problem->motion, before.n_states, before.n_nuisances, space);
  const Padded<Lanes> wide = filter.wide(motion, space);
  if (!workspace) return space.size();
  filter.set_row(problem->row);
  for (int64_t i = begin; i < end; ++i) {
    filter.load(before, i);
    filter.predict(motion, problem->motion->step_of_row[problem->row], i, problem->centroid, wide);
    filter.store(after, i);
  }
  return 0;
}

MAGLOC_KERNEL(update_row, row_update) {
  const magloc_row_update &p = *problem;
  const int64_t k = p.rows->n_readings;
  Workspace space(workspace);
  RowFilter<Lanes> filter(*p.before, *p.rows, space);
  const Padded<Lanes> wide(space, p.innovation ? k : 0, filter.N + k), triangle(space, p.innovation ? k : 0, k);
  if (!workspace) return space.size();
  filter.set_row(p.row);
  for (int64_t i = begin; i < end; ++i) {
    filter.load(*p.before, i);
    filter.update(*p.convergence, p.bends && p.bends[i], p.least_share);
    if (p.sensor_chi2) filter.fill_sensor_chi2(p.followed, p.sensor_chi2 + p.rows->n_sensors * i);
    if (p.innovation) filter.fill_innovation(wide, triangle, p.innovation + k * i);
    filter.finish_update();
    filter.store(*p.after, i);
    p.nis[i] = filter.nis;
    p.chi2[i] = filter.chi2;
    p.log_evidence[i] = filter.log_evidence;
    p.iterations[i] = filter.iterations;
    p.converged[i] = filter.converged;
  }
  return 0;
}

MAGLOC_KERNEL(bend_row, row_bends) {
  const int64_t axes = n_measured * problem->sources->n_sources;
  Workspace space(workspace);
  RowFilter<Lanes> filter(*problem->sources, *problem->rows, space);
  if (!workspace) return space.size();
  filter.set_row(problem->row);
  for (int64_t i = begin; i < end; ++i) {
    filter.load(*problem->sources, i);
    filter.fill_bends(problem->memory, problem->bends + axes * i, problem->directions + axes * filter.N * i);
  }
  return 0;
}

MAGLOC_KERNEL(follow_sources, track) {
  Workspace space(workspace);
  Track<Lanes> track(*problem, space);
  if (!workspace) return space.size();
  for (int64_t i = begin; i < end && problem->progress[1]; ++i) {
    problem->progress[1] = track.follow(problem->progress[0]);
    problem->progress[0] += problem->progress[1];
  }
  return 0;
}

MAGLOC_KERNEL(smooth_rows, smoothing) {
  Workspace space(workspace);
  Smoother<Lanes> smoother(*problem, space);
  if (!workspace) return space.size();
  for (int64_t i = begin; i < end; ++i) smoother.run(i);
  return 0;
}
