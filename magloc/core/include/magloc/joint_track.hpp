// A row of readings put into a joint state of several sources: magloc/tracking/multi_target/update.py.
//
// With the root P_oo = L L^T of what a row sees, and H L of whitened readings, the error is L y. Each step solves
// (I + (H L)^T H L) dy = (H L)^T r - y.
#pragma once
#include "dipole.hpp"
#include "joint_motion.hpp"
#include "linear.hpp"

MAGLOC_BEGIN
// One of several rows of readings.
struct JointRow {
  int64_t n_sensors, n_channels;
  const double *readings, *gain, *sensors;
  const int64_t *sensor;

  static JointRow of(const magloc_joint_rows &rows, int64_t row = 0) {
    return {rows.n_sensors,
            rows.n_channels,
            rows.readings + rows.n_channels * row,
            rows.gain + 3 * rows.n_channels * row,
            rows.sensors + 3 * rows.n_sensors * row,
            rows.sensor};
  }
};

// Fill what readings depend on at an error of a state, and the derivatives of the moments by their errors.
inline void move_seen(const JointMeans &from, int64_t n_sources, const double *error, double sign, const JointMeans &to,
                      Block *by_error) {
  for (int64_t k = 0; k < n_sources; ++k, error += n_seen) {
    const double c[3] = {sign * error[3], sign * error[4], sign * error[5]};
    for (int i = 0; i < 3; ++i) to.position[3 * k + i] = from.position[3 * k + i] + sign * error[i];
    move_moment(from.moment + 3 * k, c, to.moment + 3 * k, by_error[k]);
  }
  for (int i = 0; i < n_common; ++i) to.common[i] = from.common[i] + sign * error[i];
}

template <class T>
class JointMeasurement {
  Workspace &space_;
  const int64_t n_sources_, n_sensors_, d_ = seen_numbers(n_sources_);
  double *fields_ = space_.take<double>(3 * n_sensors_);  // (n_sensors, 3)
  Padded<T> by_error_{space_, 3 * n_sensors_, d_};        // derivatives of the fields
  Padded<T> channel_{space_, 1, d_};                      // and of a channel

  // Call use(k, ray, m, sensor, n) for each source of moment m, in units of mu_0/4pi, and each n sensors in lanes.
  template <class Use>
  MAGLOC_INLINE void for_all(const JointRow &row, const JointMeans &state, Use use) {
    for (int64_t k = 0; k < n_sources_; ++k)
      for (int64_t s = 0; s < n_sensors_; s += n_lanes<T>) {
        double m[3];
        T d[3];
        for (int i = 0; i < 3; ++i) {
          m[i] = mu0_over_4pi * state.moment[3 * k + i];
          d[i] = load_component<T>(row.sensors, s, n_sensors_, i) - state.position[3 * k + i];
        }
        use(k, Ray<T>::from(d), m, s, s + n_lanes<T> < n_sensors_ ? n_lanes<T> : (int)(n_sensors_ - s));
      }
  }

 public:
  JointMeasurement(Workspace &space, int64_t n_sources, int64_t n_sensors)
      : space_(space), n_sources_(n_sources), n_sensors_(n_sensors) {}

  // Before the first linearisation.
  void begin() {
    by_error_.clear(3 * n_sensors_);
    for (int64_t i = 0; i < 3 * n_sensors_; ++i) by_error_[i][n_seen * n_sources_ + i % 3] = 1.0;
  }

  // Predicted readings of all channels.
  void predict(const JointRow &row, const JointMeans &state, double *readings) {
    for (int64_t i = 0; i < 3 * n_sensors_; ++i) fields_[i] = state.common[i % 3];
    for_all(row, state, [&](int64_t, const Ray<T> &ray, const double (&m)[3], int64_t s, int n) {
      T b[3];
      field(ray, m, b);
      for (int lane = 0; lane < n; ++lane)
        for (int i = 0; i < 3; ++i) fields_[3 * (s + lane) + i] += get_lane(b[i], lane);
    });
    for (int64_t c = 0; c < row.n_channels; ++c) {
      const double *gain = row.gain + 3 * c, *b = fields_ + 3 * row.sensor[c];
      readings[c] = gain[0] * b[0] + gain[1] * b[1] + gain[2] * b[2];
    }
  }

  // Fill the rows H L of all channels.
  void linearise(const JointRow &row, const JointMeans &state, const Block *by_error, const Padded<T> &L,
                 const Padded<T> &HL) {
    for_all(row, state, [&](int64_t k, const Ray<T> &ray, const double (&m)[3], int64_t s, int n) {
      T by_point[3][3], by_moment[3][3], by_turn[3];
      gradient(ray, m, by_point);
      field_matrix(ray, by_moment);
      for (int i = 0; i < 3; ++i) {
        multiply_transposed(by_error[k], by_moment[i], by_turn);
        for (int lane = 0; lane < n; ++lane)
          for (int j = 0; j < 3; ++j) {
            double *derivatives = by_error_[3 * (s + lane) + i] + n_seen * k;
            derivatives[j] = -get_lane(by_point[i][j], lane);
            derivatives[3 + j] = mu0_over_4pi * get_lane(by_turn[j], lane);
          }
      }
    });
    for (int64_t c = 0; c < row.n_channels; ++c) {
      set_rows(channel_.lanes(0), {row.gain + 3 * c}, by_error_.from(3 * row.sensor[c]), 3);
      set_rows(HL.lanes(c), {channel_[0]}, L, d_);
    }
  }
};

// Fill L, the lower triangle of U^T.
template <class T>
void fill_lower(const Padded<T> &upper, int64_t d, const Padded<T> &lower) {
  lower.clear(d);
  for (int64_t i = 0; i < d; ++i)
    for (int64_t j = 0; j <= i; ++j) lower[i][j] = upper[j][i];
}

// Fill the upper root of I + (H L)^T H L.
template <class T>
void fill_information_root(const Padded<T> &HL, int64_t n_channels, int64_t d, const Padded<T> &root) {
  root.clear(d);
  for (int64_t i = 0; i < d; ++i) {
    root[i][i] = 1.0;
    add_rows(root.lanes(i), HL.column(i), HL, n_channels, i / n_lanes<T>);
  }
  factorise(root, d);
}

// Fill the covariance after a row: P - W^T W + V^T V with W = [L^T, L^-1 P_om] and V = R^-T W, R the information root.
// What a row sees cancels in P - W^T W.
template <class T>
void fill_posterior(const Padded<T> &P, const Padded<T> &W, const Padded<T> &R, int64_t n_sources, const Padded<T> &V,
                    const Padded<T> &posterior) {
  const int64_t n = all_numbers(n_sources), d = seen_numbers(n_sources);
  V.copy(W, d);
  solve_transposed(R, d, V);
  posterior.clear(n);
  for (int64_t i = 0; i < n; ++i) {
    T *row = posterior.lanes(i);
    const int64_t begin = i / n_lanes<T>;
    if (i >= d) {
      for (int64_t j = begin; j < P.width(); ++j) row[j] = P.lanes(i)[j];
      add_rows(row, -W.column(i), W, d, begin);
    }
    add_rows(row, V.column(i), V, d, begin);
    for (int64_t j = 0; j < i; ++j) posterior[i][j] = posterior[j][i];
  }
}

// The iterated update: damped Gauss-Newton in the chart of the prediction.
template <class T>
class JointUpdate {
  static constexpr double tolerance = 0.02;  // of the squared change of whitened readings
  static constexpr double shorter = 0.4;     // share of a step that did not lower the cost

  const magloc_joint_update &problem_;
  Workspace &space_;
  const JointMeans prior_ = JointMeans::of(*problem_.prior);
  const JointRow row_ = JointRow::of(*problem_.row);
  const int64_t K_ = problem_.prior->n_sources, d_ = seen_numbers(K_), C_ = row_.n_channels;
  JointMeasurement<T> measurement_{space_, K_, row_.n_sensors};
  Padded<T> upper_{space_, d_, d_}, lower_{space_, d_, d_};  // roots of what the row sees of the covariance
  Padded<T> HL_{space_, C_, d_}, R_{space_, d_, d_};         // R: the information's root, upper
  Padded<T> seen_{space_, d_, C_}, error_{space_, 1, d_}, step_{space_, 1, d_};
  JointMeans moved_ = JointMeans::in(space_, K_);
  Block *by_error_ = space_.take<Block>(K_);
  double *trial_ = space_.take<double>(d_), *residual_ = space_.take<double>(C_);

 public:
  JointUpdate(const magloc_joint_update &problem, Workspace &space) : problem_(problem), space_(space) {}

  void run() {
    begin();
    problem_.outcome[1] = iterate(problem_.outcome[0]);
    lower_.store(problem_.L, d_, d_);
    HL_.store(problem_.HL + C_ * d_, C_, d_);
    fill_standardised();
    transpose(R_, d_);
    R_.store(problem_.R, d_, d_);
  }

 private:
  void begin() {
    const int64_t n = all_numbers(K_);
    measurement_.begin();
    R_.clear(d_);
    for (int64_t i = 0; i < d_; ++i) {
      __builtin_memcpy(upper_[i], problem_.prior->covariance + n * i, d_ * sizeof(double));
      trial_[i] = problem_.y[i] = 0.0;
      R_[i][i] = 1.0;
    }
    factorise(upper_, d_);
    fill_lower(upper_, d_, lower_);
    HL_.clear(C_);
    HL_.store(problem_.HL, C_, d_);
    for (int64_t c = 0; c < C_; ++c) problem_.residuals[c] = problem_.residuals[C_ + c] = row_.readings[c];
  }

  // Return whether a minimum is found.
  bool iterate(double &best) {
    double *y = problem_.y, *step = step_[0];
    best = infinity;
    for (int64_t i = 0; i < problem_.most_trials; ++i) {
      const double cost = trial_cost();
      if (!(cost < best)) {
        if (best == infinity) return false;  // a source stands on a sensor
        for (int64_t j = 0; j < d_; ++j) step[j] = trial_[j] - y[j];
        if (cost <= best + tolerance || readings_change2() < tolerance) return true;
        for (int64_t j = 0; j < d_; ++j) trial_[j] = y[j] + shorter * step[j];
        continue;
      }
      accept_trial(best == infinity);
      best = cost;
      fill_step();
      const bool is_last = readings_change2() < tolerance;
      for (int64_t j = 0; j < d_; ++j) trial_[j] = y[j] + step[j];
      if (is_last) {
        best = linear_end();
        return true;
      }
    }
    return false;
  }

  // Residual and cost of the trial: chi-square of the readings and of the error.
  double trial_cost() {
    set_rows(error_.lanes(0), {trial_}, upper_, d_);
    move_seen(prior_, K_, error_[0], 1.0, moved_, by_error_);
    measurement_.predict(row_, moved_, residual_);
    double cost = 0.0;
    for (int64_t c = 0; c < C_; ++c) {
      residual_[c] = row_.readings[c] - residual_[c];
      cost += residual_[c] * residual_[c];
    }
    for (int64_t i = 0; i < d_; ++i) cost += trial_[i] * trial_[i];
    return cost;
  }

  // Take the trial for the error, and linearise the readings there.
  void accept_trial(bool is_first) {
    __builtin_memcpy(problem_.y, trial_, d_ * sizeof(double));
    __builtin_memcpy(problem_.residuals + C_, residual_, C_ * sizeof(double));
    measurement_.linearise(row_, moved_, by_error_, lower_, HL_);
    fill_information_root(HL_, C_, d_, R_);
    if (!is_first) return;
    __builtin_memcpy(problem_.residuals, residual_, C_ * sizeof(double));
    HL_.store(problem_.HL, C_, d_);
  }

  void fill_step() {
    set_rows(step_.lanes(0), {residual_}, HL_, C_);
    for (int64_t i = 0; i < d_; ++i) step_[0][i] -= problem_.y[i];
    solve_transposed(R_, d_, step_[0]);
    solve(R_, d_, step_[0]);
  }

  // Squared change H L dy of the readings by the step: |R dy|^2 - |dy|^2.
  double readings_change2() const {
    const double *step = step_[0];
    double square = 0.0;
    for (int64_t i = 0; i < d_; ++i) {
      double t = 0.0;
      for (int64_t j = i; j < d_; ++j) t += R_[i][j] * step[j];
      square += t * t - step[i] * step[i];
    }
    return square;
  }

  // Take the last step, and the residual and the cost that linear readings have there.
  double linear_end() {
    double cost = 0.0;
    for (int64_t c = 0; c < C_; ++c) {
      double r = residual_[c];
      for (int64_t i = 0; i < d_; ++i) r -= HL_[c][i] * step_[0][i];
      problem_.residuals[C_ + c] = r;
      cost += r * r;
    }
    for (int64_t i = 0; i < d_; ++i) {
      problem_.y[i] = trial_[i];
      cost += trial_[i] * trial_[i];
    }
    return cost;
  }

  // Residuals of the three channels of each sensor with unit covariance, of I - H P+ H^T, P+ = L (R^T R)^-1 L^T.
  void fill_standardised() {
    for (int64_t i = 0; i < d_; ++i)
      for (int64_t c = 0; c < C_; ++c) seen_[i][c] = HL_[c][i];
    solve_transposed(R_, d_, seen_);
    for (int64_t s = 0; s < C_ / 3; ++s) {
      double covariance[3][3] = {}, root[3];
      for (int i = 0; i < 3; ++i) covariance[i][i] = 1.0 + problem_.followed;
      for (int64_t k = 0; k < d_; ++k)
        for (int i = 0; i < 3; ++i)
          for (int j = 0; j <= i; ++j) covariance[i][j] -= seen_[k][3 * s + i] * seen_[k][3 * s + j];
      const Ldl<double, 3> factors(covariance, 0.0);
      for (int i = 0; i < 3; ++i) {
        root[i] = problem_.residuals[C_ + 3 * s + i];
        for (int j = 0; j < i; ++j) root[i] -= factors.l[i][j] * root[j];
        problem_.standardised[3 * s + i] = root[i] * square_root(factors.inverse[i]);
      }
    }
  }
};
MAGLOC_END
