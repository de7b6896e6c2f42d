// Sources followed row by row by one Gaussian: magloc/tracking/tracker.py and magloc/tracking/chart/ explain the steps
// and are their reference.
#pragma once
#include "row_filter.hpp"

MAGLOC_BEGIN
template <class T>
class Track {
  const magloc_track &p_;
  Workspace &space_;
  const int64_t K_ = p_.state->n_sources, ns_ = p_.state->n_states;
  RowFilter<T> filter_{*p_.state, *p_.rows, space_};
  SourceMotion motion_{*p_.motion, ns_, p_.state->n_nuisances, space_};
  const Padded<T> wide_ = filter_.wide(motion_, space_);
  double *const bends_ = space_.take<double>(n_measured * K_);
  double *const directions_ = space_.take<double>(n_measured * K_ * filter_.N);
  double *const open_loop_ = space_.take<double>(K_ * ns_ * ns_);
  const Padded<T> cartesian_{space_, n_measured,
                             filter_.N};  // root of the covariance of a source's position and moment
  double *const variances_ = space_.take<double>(n_measured * K_);  // of what readings depend on, before the step

 public:
  Track(const magloc_track &p, Workspace &space) : p_(p), space_(space) {}

  // Follow the sources to a row. Return false, and stay before the row, if it contradicts the track, if that is too
  // wide to be one place, or if the readings bend too much for it to stay one Gaussian.
  bool follow(int64_t row) {
    double centroid_before[3];
    __builtin_memcpy(centroid_before, p_.centroid, sizeof centroid_before);
    filter_.load(*p_.state, 0);
    filter_.set_row(row);
    for (int64_t i = 0; i < n_measured * K_; ++i) variances_[i] = seen_variance(i);
    fill_open_loop(p_.motion->step_of_row[row]);
    filter_.predict(motion_, p_.motion->step_of_row[row], 0, centroid_before, wide_);
    filter_.store(*p_.predicted, row);
    if (is_too_wide()) return false;
    if (p_.rows->counts[row] > 0) {
      if (bends()) return false;
      filter_.update(*p_.convergence, prediction_bends(row), p_.least_share);
      p_.correction[row] = filter_.fill_innovation(p_.innovation + p_.rows->n_readings * row);
      filter_.finish_update();
      if (!(filter_.converged && filter_.nis <= p_.nis_limits[p_.rows->counts[row]]) || is_too_wide()) return false;
      p_.nis[row] = filter_.nis;
      p_.iterations[row] = filter_.iterations;
      ++p_.progress[2];
    } else {
      p_.nis[row] = p_.correction[row] = nan;
      p_.iterations[row] = 0;
    }
    filter_.store(*p_.updated, row);
    filter_.store(*p_.state, 0);
    __builtin_memcpy(p_.centroid, filter_.centroid(), sizeof centroid_before);
    __builtin_memcpy(p_.open_loop, open_loop_, K_ * ns_ * ns_ * sizeof(double));
    for (int64_t k = 0; k < K_; ++k) fill_moments(k, K_ * row + k);
    return true;
  }

 private:
  // Whether log-range or direction of a source are so uncertain that it has no place any more.
  bool is_too_wide() const {
    for (int64_t k = 0; k < K_; ++k)
      for (int64_t i = 0; i < 3; ++i)
        if (!(filter_.variance(ns_ * k + i) <= p_.largest_width * p_.largest_width)) return true;
    return false;
  }

  double seen_variance(int64_t i) const { return filter_.variance(ns_ * (i / n_measured) + i % n_measured); }

  // Whether the prediction bends as the readings do: not if the motion has made it so wide, nor as a row does in which
  // readings are missing.
  bool prediction_bends(int64_t row) const {
    bool bends = p_.rows->counts[row] >= p_.full_count;
    for (int64_t i = 0; i < n_measured * K_; ++i)
      bends &= seen_variance(i) <= p_.largest_growth * p_.largest_growth * variances_[i];
    return bends;
  }

  bool bends() {
    filter_.fill_bends((double)(p_.progress[2] < p_.longest_memory ? p_.progress[2] : p_.longest_memory), bends_,
                       directions_);
    for (int64_t i = 0; i < n_measured * K_; ++i)
      if (!(bends_[i] <= p_.largest_bend)) return true;
    return false;
  }

  // Mean and covariance of a source's position and moment, the range being log-normal: see component_moments in
  // magloc/tracking/chart/mixture.py; and which share of each standard deviation readings took away.
  void fill_moments(int64_t k, int64_t item) const {
    const double zero[max_source_states] = {}, *const x = filter_.x + ns_ * k;
    const SourceChart chart(x, ns_, p_.state->power, filter_.centroid(), p_.rows->radius);
    ChartedState here;
    chart.move(zero, here);
    const double open = filter_.variance(ns_ * k), growth = exponential(0.5 * minimum(open, 1.0)) - 1.0;
    cartesian_.copy(filter_.root.from(n_measured * k), n_measured);
    chart.to_state(here, cartesian_.lanes(0), (T *)nullptr, cartesian_.width());
    for (int64_t i = 0; i < n_measured; ++i) {
      p_.means[n_measured * item + i] = x[i] + (i < 3 ? growth * here.position[i][0] : 0.0);
      double *const covariance = p_.covariances + n_measured * (n_measured * item + i);
      for (int64_t j = 0; j < n_measured; ++j)
        covariance[j] = dot(cartesian_.lanes(i), cartesian_.lanes(j), cartesian_.width());
      const double left = covariance[i] / open_loop_[ns_ * (ns_ * k + i) + i];
      p_.estimability[n_measured * item + i] = 1.0 - square_root(minimum(left, 1.0));
    }
  }

  // Covariance of each source after the step had no readings been taken.
  void fill_open_loop(int64_t step) {
    const int64_t m = motion_.n_noise;
    for (int64_t k = 0; k < K_; ++k) {
      const double *before = p_.open_loop + ns_ * ns_ * k;
      motion_.take(filter_.x + ns_ * k, step, k);
      for (int64_t i = 0; i < ns_; ++i) {
        double moved[max_source_states] = {};
        for (int64_t c = 0; c < ns_; ++c)
          for (int64_t j = 0; j < ns_; ++j) moved[j] += motion_.F[ns_ * i + c] * before[ns_ * c + j];
        for (int64_t j = 0; j < ns_; ++j) {
          double &sum = open_loop_[ns_ * (ns_ * k + i) + j];
          sum = 0.0;
          for (int64_t c = 0; c < ns_; ++c) sum += moved[c] * motion_.F[ns_ * j + c];
          for (int64_t c = 0; c < m; ++c) sum += motion_.noise[m * i + c] * motion_.noise[m * j + c];
        }
      }
    }
  }
};
MAGLOC_END
