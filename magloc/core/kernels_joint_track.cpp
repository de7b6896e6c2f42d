// Several sources that one filter follows together. Each problem is one item.
#include "magloc/joint_smoother.hpp"

using namespace magloc;

MAGLOC_KERNEL(joint_step, joint_motion) {
  (void)begin, (void)end;
  Workspace space(workspace);
  const int64_t K = problem->before->n_sources, n = all_numbers(K);
  const Padded<Lanes> covariance(space, n, n);
  Turn *turns = space.take<Turn>(K);
  if (!workspace) return space.size();
  const JointStep step(problem->step);
  step_means(JointMeans::of(*problem->before), K, step, JointMeans::of(*problem->after), turns);
  covariance.load(problem->before->covariance, n, n);
  step_covariance(covariance, K, step, turns);
  covariance.store(problem->after->covariance, n, n);
  return 0;
}

MAGLOC_KERNEL(joint_update_row, joint_update) {
  (void)begin, (void)end;
  Workspace space(workspace);
  JointUpdate<Lanes> update(*problem, space);
  if (!workspace) return space.size();
  update.run();
  return 0;
}

MAGLOC_KERNEL(joint_state_after, joint_posterior) {
  (void)begin, (void)end;
  Workspace space(workspace);
  const JointMeans prior = JointMeans::of(*problem->prior), after = JointMeans::of(*problem->after);
  const int64_t K = problem->prior->n_sources, n = all_numbers(K), d = seen_numbers(K);
  const Padded<Lanes> P(space, n, n), W(space, d, n), R(space, d, d), V(space, d, n), covariance(space, n, n);
  const Padded<Lanes> error(space, 1, n);
  Block *turned = space.take<Block>(K);
  if (!workspace) return space.size();
  P.load(problem->prior->covariance, n, n);
  W.copy(P, d);
  factorise(W, d);
  R.load(problem->R, d, d);
  transpose(R, d);
  fill_posterior(P, W, R, K, V, covariance);
  set_rows(error.lanes(0), {problem->y}, W, d);
  move_seen(prior, K, error[0], 1.0, after, turned);
  for (int64_t k = 0; k < K; ++k) {
    const double *motion = error[0] + d + n_motion * k, length = norm(after.moment + 3 * k);
    for (int i = 0; i < 3; ++i) {
      after.velocity[3 * k + i] = prior.velocity[3 * k + i] + motion[i];
      after.rate[3 * k + i] = prior.rate[3 * k + i] + motion[3 + i];
      for (double &x : turned[k][i]) x /= length;
    }
    change_chart(covariance, n, n_seen * k + 3, turned[k]);
  }
  covariance.store(problem->after->covariance, n, n);
  return 0;
}

MAGLOC_KERNEL(joint_bend, joint_bends) {
  (void)begin, (void)end;
  Workspace space(workspace);
  const JointMeans state = JointMeans::of(*problem->state);
  const JointRow row = JointRow::of(*problem->row);
  const int64_t K = problem->state->n_sources;
  JointMeasurement<Lanes> measurement(space, K, row.n_sensors);
  const JointMeans moved = JointMeans::in(space, K);
  Block *by_error = space.take<Block>(K);
  double *here = space.take<double>(row.n_channels), *ahead = space.take<double>(row.n_channels);
  double *behind = space.take<double>(row.n_channels);
  if (!workspace) return space.size();
  measurement.predict(row, state, here);
  for (int64_t i = 0; i < problem->n_errors; ++i) {
    const double *error = problem->errors + seen_numbers(K) * i;
    move_seen(state, K, error, 1.0, moved, by_error);
    measurement.predict(row, moved, ahead);
    move_seen(state, K, error, -1.0, moved, by_error);
    measurement.predict(row, moved, behind);
    double square = 0.0;
    for (int64_t c = 0; c < row.n_channels; ++c) {
      const double bend = 0.5 * (ahead[c] + behind[c]) - here[c];
      square += bend * bend;
    }
    problem->bends[i] = square_root(square);
  }
  return 0;
}

MAGLOC_KERNEL(joint_smooth, joint_smoothing) {
  (void)begin, (void)end;
  Workspace space(workspace);
  JointSmoother<Lanes> smoother(*problem, space);
  if (!workspace) return space.size();
  smoother.run();
  return 0;
}
