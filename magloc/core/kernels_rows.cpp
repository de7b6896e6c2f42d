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
  filter.set_pose(problem->row);
  for (int64_t i = begin; i < end; ++i) {
    filter.load(before, i);
    filter.predict(motion, problem->motion->step_of_row[problem->row], i, problem->centroid, wide);
    filter.store(after, i);
  }
  return 0;
}

MAGLOC_KERNEL(update_row, row_update) {
  const magloc_row_update &p = *problem;
  const int64_t k = p.rows->n_readings, d = n_measured * p.before->n_sources + p.before->n_nuisances;
  const bool is_linearised = p.misfits && p.projectors;
  Workspace space(workspace);
  RowFilter<Lanes> filter(*p.before, *p.rows, space);
  if (!workspace) return space.size();
  filter.set_row(p.row);
  for (int64_t i = begin; i < end; ++i) {
    filter.load(*p.before, i);
    double *const misfits = is_linearised ? p.misfits + 2 * k * i : nullptr;
    double *const Q = is_linearised ? p.projectors + 2 * d * k * i : nullptr;
    filter.update(*p.convergence, p.bends && p.bends[i], p.least_share, p.pose_lasts, misfits, Q);
    if (is_linearised) filter.store_linearisation(misfits + k, Q + d * k);
    if (p.standardised) filter.fill_standardised(p.followed, p.standardised + 3 * p.rows->n_sensors * i);
    if (p.innovation) p.correction[i] = filter.fill_innovation(p.innovation + k * i);
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
