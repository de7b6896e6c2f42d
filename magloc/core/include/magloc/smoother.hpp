// One pass of Gauss and Newton's iteration over all rows of a track: a filter and Bryson and Frazier's smoother, both
// linearised along a trajectory, in the charts about it. The smoother carries the slope of what later rows cost.
#pragma once
#include "row_filter.hpp"

MAGLOC_BEGIN
template <class T>
class Smoother {
  const magloc_smoothing &p_;
  Workspace &space_;
  const magloc_sources &prior_ = *p_.prior;
  const int64_t m_ = p_.n_rows, K_ = prior_.n_sources, ns_ = prior_.n_states, e_ = prior_.n_nuisances, n_ = K_ * ns_;
  const int64_t N_ = n_ + e_, d_ = n_measured * K_ + e_;
  RowFilter<T> filter_{prior_, *p_.rows, space_};
  SourceMotion motion_{*p_.motion, ns_, e_, space_};
  const Padded<T> wide_ = filter_.wide(motion_, space_);
  // Of each row: upper root (N, N) of the predicted covariance, that of the information in standard numbers (d, d),
  // what the row tells of these (d), transitions of the sources (n, n_states), and offsets from the trajectory (N).
  Padded<T> U_{space_, m_ * N_, N_}, R_{space_, m_ * d_, d_}, transitions_{space_, m_ * n_, ns_};
  double *const zeta_ = space_.take<double>(m_ * d_), *const offsets_ = space_.take<double>(m_ * N_);
  Padded<T> product_{space_, 1, N_};
  double *const offset_ = space_.take<double>(N_), *const slope_ = space_.take<double>(N_);
  double *const solved_ = space_.take<double>(d_), *const step_ = space_.take<double>(d_);

 public:
  Smoother(const magloc_smoothing &p, Workspace &space) : p_(p), space_(space) {}

  void run(int64_t item) {
    filter_.load(prior_, item);
    for (int64_t i = 0; i < N_; ++i) offset_[filter_.row_of(i)] = filter_.x[i];
    __builtin_memset(filter_.x, 0, N_ * sizeof(double));
    p_.nis[item] = p_.log_evidence[item] = 0.0;
    for (int64_t row = 0; row < m_; ++row) filter(item, row);
    for (int64_t i = 0; i < N_; ++i) filter_.x[i] = offset_[filter_.row_of(i)];
    filter_.store(*p_.last, item);
    __builtin_memset(slope_, 0, N_ * sizeof(double));
    for (int64_t row = m_; row-- > 0;) smooth(item, row);
  }

 private:
  void filter(int64_t item, int64_t row) {
    const double *state = p_.trajectories + n_ * (m_ * item + row);
    double centroid_before[3];
    __builtin_memcpy(centroid_before, filter_.centroid(), sizeof centroid_before);
    filter_.set_row(row);
    if (row) {
      filter_.predict(motion_, p_.motion->step_of_row[row], m_ * item + row, centroid_before, wide_, state, offset_);
      transitions_.from(n_ * row).copy(filter_.transition, n_);
    } else {
      __builtin_memcpy(filter_.x, state, n_ * sizeof(double));
      filter_.lower_root();
    }
    const Padded<T> U = U_.from(N_ * row);
    U.copy(filter_.root, N_);
    transpose(U, N_);
    __builtin_memcpy(offsets_ + N_ * row, offset_, N_ * sizeof(double));
    filter_.update_linearised(offset_, R_.from(d_ * row), zeta_ + d_ * row);
    p_.log_evidence[item] += filter_.log_evidence;
    if (row) p_.nis[item] += filter_.nis;
  }

  // Offsets of a row, by the slope of the cost of this row and all later ones; then that slope by the row before.
  void smooth(int64_t item, int64_t row) {
    const Padded<T> U = U_.from(N_ * row), R = R_.from(d_ * row);
    double *const q = product_[0], *const offsets = p_.offsets + n_ * (m_ * item + row);
    for (int64_t i = 0; i < N_; ++i) {
      q[i] = 0.0;
      for (int64_t j = i; j < N_; ++j) q[i] += U[i][j] * slope_[j];
    }
    for (int64_t c = 0; c < d_; ++c) solved_[c] = q[filter_.zeta_of(c)];
    solve_transposed(R, d_, solved_);
    solve(R, d_, solved_);
    for (int64_t c = 0; c < d_; ++c) {
      const int64_t i = filter_.zeta_of(c);
      const double there = solved_[c] - zeta_[d_ * row + c];
      step_[i] = q[i] - there;
      q[i] = there;
    }
    solve(U, d_, step_);
    for (int64_t i = 0; i < d_; ++i) slope_[i] -= step_[i];
    for (int64_t i = 0; i < n_; ++i) {
      const int64_t at = filter_.row_of(i);
      offsets[i] = offsets_[N_ * row + at];
      for (int64_t j = 0; j <= at; ++j) offsets[i] -= q[j] * U[j][at];
    }
    if (row) step_back(row);
  }

  void step_back(int64_t row) {
    for (int64_t k = 0; k < K_; ++k) {
      double after[max_source_states] = {};
      for (int64_t i = 0; i < ns_; ++i) after[i] = slope_[filter_.row_of(ns_ * k + i)];
      for (int64_t i = 0; i < ns_; ++i) {
        double &before = slope_[filter_.row_of(ns_ * k + i)] = 0.0;
        for (int64_t j = 0; j < ns_; ++j) before += transitions_[n_ * row + ns_ * k + j][i] * after[j];
      }
    }
    if (motion_.has_noisy_nuisances())
      for (int64_t i = 0; i < e_; ++i) slope_[n_measured * K_ + i] *= motion_.kept(p_.motion->step_of_row[row])[i];
  }
};
MAGLOC_END
