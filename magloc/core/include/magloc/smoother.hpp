// One pass of Gauss and Newton's iteration over all rows of a track: a filter and Bryson and Frazier's smoother, both
// linearised along a trajectory, in the charts about it. The smoother carries the slope of what later rows cost, and
// inverts nothing. Covariances, not their roots: a pass takes many rows, and there may be many more nuisances than
// readings.
#pragma once
#include "row_filter.hpp"

MAGLOC_BEGIN
template <class T>
class Smoother {
  const magloc_smoothing &p_;
  Workspace &space_;
  const magloc_sources &prior_ = *p_.prior;
  const int64_t m_ = p_.n_rows, K_ = prior_.n_sources, ns_ = prior_.n_states, e_ = prior_.n_nuisances;
  const int64_t n_ = K_ * ns_ + p_.rows->n_pose;  // numbers of a trajectory's state
  const int64_t N_ = K_ * ns_ + e_, d_ = n_measured * K_ + e_, k_ = p_.rows->n_readings;
  RowFilter<T> filter_{prior_, *p_.rows, space_};  // its root is one: coordinates are standard numbers
  SourceMotion motion_{*p_.motion, ns_, e_, space_};
  const Padded<T> wide_ = filter_.wide(motion_, space_);
  Padded<T> P_{space_, N_, N_}, spread_{space_, K_ * ns_, N_}, slopes_{space_, d_, k_},
      system_{space_, k_, k_ + 2 * N_ + 1};
  // Of each row: derivatives of the readings and gains, both whitened (k, N), the innovation (k), the predicted
  // covariance (n, N), transitions of the sources (n, n_states), and offsets from the trajectory (N).
  Padded<T> J_{space_, m_ * k_, N_}, gains_{space_, m_ * k_, N_}, predicted_{space_, m_ * n_, N_};
  Padded<T> transitions_{space_, m_ * K_ * ns_, ns_};
  double *const left_ = space_.take<double>(m_ * k_), *const offsets_ = space_.take<double>(m_ * N_);
  double *const offset_ = space_.take<double>(N_);
  Padded<T> slope_{space_, 1, N_};

 public:
  Smoother(const magloc_smoothing &p, Workspace &space) : p_(p), space_(space) {}

  void run(int64_t item) {
    filter_.load(prior_, item);
    for (int64_t i = 0; i < N_; ++i) offset_[filter_.row_of(i)] = filter_.x[i];
    P_.clear(N_);
    for (int64_t i = 0; i < N_; ++i)
      for (int64_t j = 0; j < N_; ++j) P_[i][j] = dot(filter_.root.lanes(i), filter_.root.lanes(j), P_.width());
    filter_.root.clear(N_);
    for (int64_t i = 0; i < N_; ++i) filter_.root[i][i] = 1.0;
    __builtin_memset(filter_.x, 0, N_ * sizeof(double));
    p_.nis[item] = p_.log_evidence[item] = 0.0;
    for (int64_t row = 0; row < m_; ++row) {
      go_to(item, row);
      update(item, row);
    }
    for (int64_t i = 0; i < N_; ++i) filter_.x[i] = offset_[filter_.row_of(i)];
    factorise(P_, N_);
    transpose(P_, N_);
    filter_.root.copy(P_, N_);
    filter_.store(*p_.last, item);
    slope_.clear(1);
    for (int64_t row = m_; row-- > 0;) smooth(item, row);
  }

 private:
  void go_to(int64_t item, int64_t row) {
    const double *state = p_.trajectories + n_ * (m_ * item + row);
    double centroid_before[3];
    __builtin_memcpy(centroid_before, filter_.centroid(), sizeof centroid_before);
    filter_.set_row(row);
    if (row) {
      const int64_t step = p_.motion->step_of_row[row];
      filter_.spread(motion_, step, m_ * item + row, centroid_before, wide_, state, offset_);
      transitions_.from(K_ * ns_ * row).copy(filter_.transition, K_ * ns_);
      predict(motion_.has_noisy_nuisances() ? motion_.kept(step) : nullptr);
    } else {
      __builtin_memcpy(filter_.x, state, n_ * sizeof(double));
    }
    for (int64_t i = 0; i < n_; ++i)
      __builtin_memcpy(predicted_.lanes(n_ * row + i), P_.lanes(filter_.row_of(i)), P_.width() * sizeof(T));
    __builtin_memcpy(offsets_ + N_ * row, offset_, N_ * sizeof(double));
  }

  void predict(const double *kept) {
    const int64_t first = n_measured * K_, n_noise = motion_.n_noise * K_ + (kept ? e_ : 0), n = K_ * ns_;
    spread_.clear(n);
    for (int64_t i = 0; i < n; ++i) {
      const int64_t source = ns_ * (i / ns_);
      add_rows(spread_.lanes(i), {filter_.transition[i]}, P_.from(filter_.row_of(source)), n_measured);
      add_rows(spread_.lanes(i), {filter_.transition[i] + n_measured}, P_.from(filter_.row_of(source + n_measured)),
               ns_ - n_measured);
    }
    for (int64_t i = 0; kept && i < e_; ++i) {
      for (int64_t j = 0; j < e_; ++j) P_[first + i][first + j] *= kept[i] * kept[j];
      const double added = wide_[first + i][N_ + motion_.n_noise * K_ + i];
      P_[first + i][first + i] += added * added;
    }
    for (int64_t i = 0; i < n; ++i) {
      const int64_t row = filter_.row_of(i);
      for (int64_t j = 0; j < e_; ++j)
        P_[row][first + j] = P_[first + j][row] = spread_[i][first + j] * (kept ? kept[j] : 1.0);
      for (int64_t j = 0; j < n; ++j) {
        const int64_t column = filter_.row_of(j), source = ns_ * (j / ns_);
        double sum = 0.0;
        for (int64_t c = 0; c < ns_; ++c) sum += spread_[i][filter_.row_of(source + c)] * filter_.transition[j][c];
        for (int64_t c = 0; c < n_noise; ++c) sum += wide_[row][N_ + c] * wide_[column][N_ + c];
        P_[row][column] = sum;
      }
    }
  }

  // Kalman's update by the row, linearised at the trajectory.
  void update(int64_t item, int64_t row) {
    const Padded<T> J = J_.from(k_ * row), gains = gains_.from(k_ * row);
    double *const left = left_ + k_ * row;
    filter_.fill_slopes(slopes_, offset_, left);
    J.clear(k_);
    for (int64_t r = 0; r < k_; ++r) {
      for (int64_t c = 0; c < d_; ++c) J[r][c] = slopes_[c][r];
      set_rows(gains.lanes(r), {J[r]}, P_, d_);
    }
    for (int64_t r = 0; r < k_; ++r) {
      for (int64_t q = 0; q < k_; ++q) system_[r][q] = (q == r) + dot(J.lanes(r), gains.lanes(q), J.width());
      __builtin_memcpy(system_[r] + k_, J[r], N_ * sizeof(double));
      __builtin_memcpy(system_[r] + k_ + N_, gains[r], N_ * sizeof(double));
      system_[r][k_ + 2 * N_] = left[r];
    }
    factorise(system_, k_);
    double square = 0.0;
    for (int64_t r = 0; r < k_; ++r) {
      __builtin_memcpy(J[r], system_[r] + k_, N_ * sizeof(double));
      __builtin_memcpy(gains[r], system_[r] + k_ + N_, N_ * sizeof(double));
      left[r] = system_[r][k_ + 2 * N_];
      for (int64_t i = 0; i < N_; ++i) offset_[i] += gains[r][i] * left[r];
      square += left[r] * left[r];
      p_.log_evidence[item] -= logarithm(system_[r][r]);
    }
    for (int64_t i = 0; i < N_; ++i) add_rows(P_.lanes(i), -gains.column(i), gains, k_);
    p_.log_evidence[item] -= 0.5 * square;
    if (row) p_.nis[item] += square;
  }

  // Offsets of a row, by the slope of the cost of this row and all later ones; then that slope by the row before.
  void smooth(int64_t item, int64_t row) {
    const Padded<T> J = J_.from(k_ * row), gains = gains_.from(k_ * row);
    const double *const left = left_ + k_ * row;
    double *const share = system_[0], *const offsets = p_.offsets + n_ * (m_ * item + row);
    for (int64_t r = 0; r < k_; ++r) share[r] = left[r] + dot(gains.lanes(r), slope_.lanes(0), J.width());
    add_rows(slope_.lanes(0), {share, 1, -1.0}, J, k_);
    for (int64_t i = 0; i < n_; ++i)
      offsets[i] =
          offsets_[N_ * row + filter_.row_of(i)] - dot(predicted_.lanes(n_ * row + i), slope_.lanes(0), slope_.width());
    if (row) step_back(row);
  }

  void step_back(int64_t row) {
    double *const slope = slope_[0];
    for (int64_t k = 0; k < K_; ++k) {
      double after[max_source_states] = {};
      for (int64_t i = 0; i < ns_; ++i) after[i] = slope[filter_.row_of(ns_ * k + i)];
      for (int64_t i = 0; i < ns_; ++i) {
        double &before = slope[filter_.row_of(ns_ * k + i)] = 0.0;
        for (int64_t j = 0; j < ns_; ++j) before += transitions_[ns_ * (K_ * row + k) + j][i] * after[j];
      }
    }
    if (motion_.has_noisy_nuisances())
      for (int64_t i = 0; i < e_; ++i) slope[n_measured * K_ + i] *= motion_.kept(p_.motion->step_of_row[row])[i];
  }
};
MAGLOC_END
