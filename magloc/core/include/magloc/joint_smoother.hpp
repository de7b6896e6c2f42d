// One pass of Gauss and Newton's iteration over all rows of a young joint track: a filter and Bryson and Frazier's
// smoother, both linearised along a trajectory, in the charts about it.
#pragma once
#include "joint_track.hpp"

MAGLOC_BEGIN
template <class T>
class JointSmoother {
  const magloc_joint_smoothing &problem_;
  Workspace &space_;
  const int64_t m_ = problem_.rows->n_rows, C_ = problem_.rows->n_channels;
  const int64_t K_ = problem_.prior->n_sources, n_ = all_numbers(K_), d_ = seen_numbers(K_);
  JointMeasurement<T> measurement_{space_, K_, problem_.rows->n_sensors};
  // Of each row: predicted covariance (n, n) about the trajectory, its root W (d, n), the root of the information
  // (d, d), and what the row tells (d).
  Padded<T> P_{space_, m_ * n_, n_}, W_{space_, m_ * d_, n_}, R_{space_, m_ * d_, d_};
  double *y_ = space_.take<double>(m_ * d_);
  Block *charts_ = space_.take<Block>(m_ * K_);  // (m, K) of moments, from the prediction to the trajectory
  Turn *turns_ = space_.take<Turn>(m_ * K_);     // (m, K) on the way to each row
  Padded<T> V_{space_, d_, n_}, L_{space_, d_, d_}, HL_{space_, C_, d_}, after_{space_, n_, n_};
  Padded<T> error_{space_, 1, n_}, gradient_{space_, 1, d_}, product_{space_, 1, n_};
  JointMeans predicted_ = JointMeans::in(space_, K_);
  Block *by_error_ = space_.take<Block>(K_);  // of moments about the trajectory
  double *residual_ = space_.take<double>(C_), *change_ = space_.take<double>(d_);
  double *slope_ = space_.take<double>(n_), *slope_before_ = space_.take<double>(n_);

 public:
  JointSmoother(const magloc_joint_smoothing &problem, Workspace &space) : problem_(problem), space_(space) {}

  void run() {
    measurement_.begin();
    problem_.likelihood[0] = problem_.likelihood[1] = 0.0;
    error_.clear(1);
    for (int64_t row = 0; row < m_; ++row) {
      predict(row);
      update(row);
    }
    after_.store(problem_.last, n_, n_);
    __builtin_memset(slope_, 0, n_ * sizeof(double));
    for (int64_t row = m_; row-- > 0;) {
      smooth(row);
      if (row > 0) step_back(row);
    }
  }

 private:
  // Error and covariance before a row, in the chart about the trajectory.
  void predict(int64_t row) {
    const Padded<T> P = P_.from(n_ * row);
    JointMeans means = JointMeans::of(*problem_.prior);
    if (row == 0) {
      P.load(problem_.prior->covariance, n_, n_);
    } else {
      const JointStep step(problem_.steps + 12 * row);
      Turn *turns = turns_ + K_ * row;
      means = predicted_;
      step_means(JointMeans::of(*problem_.trajectory, row - 1), K_, step, means, turns);
      P.copy(after_, n_);
      step_covariance(P, K_, step, turns);
      transition_rows(error_[0], 1, K_, step, turns);
    }
    to_trajectory(row, means, P);
    __builtin_memcpy(problem_.offsets + n_ * row, error_[0], n_ * sizeof(double));
  }

  // Errors about a state become those about a row of the trajectory. They are Gaussian in the chart about the state.
  void to_trajectory(int64_t row, const JointMeans &from, const Padded<T> &P) {
    const JointMeans to = JointMeans::of(*problem_.trajectory, row);
    double *seen = error_[0], *motion = seen + d_;
    for (int64_t k = 0; k < K_; ++k, seen += n_seen, motion += n_motion) {
      Block &chart = charts_[K_ * row + k];
      double c[3];
      fill_chart(from.moment + 3 * k, to.moment + 3 * k, c, chart);
      for (int i = 0; i < 3; ++i) {
        c[i] = seen[3 + i] - c[i];
        seen[i] += from.position[3 * k + i] - to.position[3 * k + i];
        motion[i] += from.velocity[3 * k + i] - to.velocity[3 * k + i];
        motion[3 + i] += from.rate[3 * k + i] - to.rate[3 * k + i];
      }
      for (int i = 0; i < 3; ++i) seen[3 + i] = dot(chart[i], c);
      change_chart(P, n_, n_seen * k + 3, chart);
    }
    for (int i = 0; i < n_common; ++i) seen[i] += from.common[i] - to.common[i];
  }

  // Error and covariance after a row, and how likely it is.
  void update(int64_t row) {
    const Padded<T> P = P_.from(n_ * row), W = W_.from(d_ * row), R = R_.from(d_ * row);
    double *y = y_ + d_ * row, &cost = problem_.likelihood[0];
    W.copy(P, d_);
    factorise(W, d_);
    fill_lower(W, d_, L_);
    fill_residual(row, W);
    for (int64_t c = 0; c < C_; ++c) cost += residual_[c] * residual_[c];
    set_rows(gradient_.lanes(0), {residual_}, HL_, C_);
    fill_information_root(HL_, C_, d_, R);
    __builtin_memcpy(y, gradient_[0], d_ * sizeof(double));
    solve_transposed(R, d_, y);
    solve(R, d_, y);
    for (int64_t i = 0; i < d_; ++i) {
      cost -= gradient_[0][i] * y[i];
      problem_.likelihood[1] += 2.0 * logarithm(R[i][i]);
    }
    add_rows(error_.lanes(0), {y}, W, d_);
    fill_posterior(P, W, R, K_, V_, after_);
  }

  // Linearise a row about the trajectory, and fill what its readings differ from the prediction by.
  void fill_residual(int64_t row, const Padded<T> &W) {
    const JointMeans means = JointMeans::of(*problem_.trajectory, row);
    const JointRow readings = JointRow::of(*problem_.rows, row);
    for (int64_t k = 0; k < K_; ++k)
      for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) by_error_[k][i][j] = i == j ? norm(means.moment + 3 * k) : 0.0;
    measurement_.predict(readings, means, residual_);
    measurement_.linearise(readings, means, by_error_, L_, HL_);
    __builtin_memcpy(change_, error_[0], d_ * sizeof(double));
    solve_transposed(W, d_, change_);
    for (int64_t c = 0; c < C_; ++c) {
      residual_[c] = readings.readings[c] - residual_[c];
      for (int64_t i = 0; i < d_; ++i) residual_[c] -= HL_[c][i] * change_[i];
    }
  }

  // Offsets of a row, by the slope of the cost of all later rows; then by that of this row, too.
  void smooth(int64_t row) {
    const Padded<T> P = P_.from(n_ * row), W = W_.from(d_ * row), R = R_.from(d_ * row);
    const double *y = y_ + d_ * row;
    double *q = gradient_[0];
    set_rows(product_.lanes(0), {slope_}, P, n_);
    __builtin_memcpy(q, product_[0], d_ * sizeof(double));
    solve_transposed(W, d_, q);
    __builtin_memcpy(change_, q, d_ * sizeof(double));
    solve_transposed(R, d_, change_);
    solve(R, d_, change_);
    for (int64_t i = 0; i < d_; ++i) q[i] += y[i] - change_[i];
    solve(W, d_, q);
    for (int64_t i = 0; i < d_; ++i) slope_[i] -= q[i];
    set_rows(product_.lanes(0), {slope_}, P, n_);
    for (int64_t i = 0; i < n_; ++i) problem_.offsets[n_ * row + i] -= product_[0][i];
  }

  // The slope by the errors of a row becomes the one by those of the row before.
  void step_back(int64_t row) {
    const JointStep step(problem_.steps + 12 * row);
    __builtin_memcpy(slope_before_, slope_, n_ * sizeof(double));
    for (int64_t k = 0; k < K_; ++k) {
      const Turn &turn = turns_[K_ * row + k];
      const double *seen = slope_ + n_seen * k, *motion = slope_ + d_ + n_motion * k;
      double moment[3], *before = slope_before_ + n_seen * k, *motion_before = slope_before_ + d_ + n_motion * k;
      double turned[3], by_rate[3];
      multiply_transposed(charts_[K_ * row + k], seen + 3, moment);
      multiply_transposed(turn.rotation, moment, turned);
      multiply_transposed(turn.by_rate, moment, by_rate);
      for (int i = 0; i < 3; ++i) {
        before[3 + i] = turned[i];
        motion_before[i] = step.velocity_kept * motion[i] + step.velocity_lasts * seen[i];
        motion_before[3 + i] = step.rate_kept * motion[3 + i] + by_rate[i];
      }
    }
    __builtin_memcpy(slope_, slope_before_, n_ * sizeof(double));
  }
};
MAGLOC_END
