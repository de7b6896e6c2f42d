// Iterated filters of the convergence map: many starts, one in each lane. The state x = (p, m) is the position and the
// moment of a dipole, the measurements are differences of the fields at an array's sensors.
//
// Information form, in units of the prior's standard deviations or of the process noise of a pass: then the information
// of the prior is the identity matrix. magloc/convergence/filters.py has the readable filters, in their usual form.
#pragma once
#include "dipole.hpp"
#include "kernel.hpp"
#include "lane_items.hpp"
#include "linear.hpp"

MAGLOC_BEGIN
// Reading of a sensor less the field of a state there, and derivatives of this field by position and moment. Their
// matrices are symmetric without trace, in the order (xx, xy, xz, yy, yz).
constexpr int n_terms = 13;
template <class T>
MAGLOC_INLINE void sensor_terms(const double *sensor, const double *reading, const T (&x)[6], T (&t)[n_terms]) {
  const T m[3] = {x[3], x[4], x[5]};
  T d[3], by_moment[3][3], by_point[3][3];
  for (int a = 0; a < 3; ++a) d[a] = sensor[a] - x[a];
  const Ray<T> ray = Ray<T>::from(d);
  field_matrix(ray, by_moment);
  gradient(ray, m, by_point);
  for (int a = 0; a < 3; ++a) t[a] = reading[a] - dot(by_moment[a], m);
  for (int k = 0; k < 5; ++k) {
    const int i = k / 3, j = k < 3 ? k : k - 2;
    t[3 + k] = -by_point[i][j];
    t[8 + k] = by_moment[i][j];
  }
}

// Jacobian of the field by the state, from sensor_terms.
template <class T>
MAGLOC_INLINE void field_jacobian(const T (&t)[n_terms], T (&jacobian)[3][6]) {
  for (int block = 0; block < 2; ++block) {
    const T *s = t + 3 + 5 * block;
    const T rows[3][3] = {{s[0], s[1], s[2]}, {s[1], s[3], s[4]}, {s[2], s[4], -(s[0] + s[3])}};
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) jacobian[i][3 * block + j] = rows[i][j];
  }
}

// Filter of the starts of a range, a pass at a time.
template <class T>
class StartsFilter {
  enum Method : int64_t { iterated, repeated, damped, relinearised };
  // A step that lowers the cost divides the damping, any other multiplies it.
  static constexpr double damping_decrease = 5.0, damping_increase = 4.0;
  static constexpr double lost_pivot = 1e-15;

  // Sums over whitened differences with residuals r and Jacobian J of what is predicted.
  struct NormalEquations {
    T matrix[6][6], right[6], chi2;  // J^T J (lower triangle), J^T r, r^T r
    T change2;                       // squared norm of the differences' change since the last pass, without whitening

    MAGLOC_INLINE void clear() {
      MAGLOC_UNROLL
      for (int i = 0; i < 6; ++i) {
        MAGLOC_UNROLL
        for (int j = 0; j <= i; ++j) matrix[i][j] = T{};
        right[i] = T{};
      }
      chi2 = change2 = T{};
    }
    // Add three differences: sums go to memory once for all of them.
    MAGLOC_INLINE void add(const T (&r)[3], const T (&jacobian)[3][6]) {
      MAGLOC_UNROLL
      for (int i = 0; i < 6; ++i) {
        MAGLOC_UNROLL
        for (int j = 0; j <= i; ++j)
          for (int k = 0; k < 3; ++k) matrix[i][j] += jacobian[k][i] * jacobian[k][j];
        for (int k = 0; k < 3; ++k) right[i] += jacobian[k][i] * r[k];
      }
      for (int k = 0; k < 3; ++k) chi2 += r[k] * r[k];
    }
    // Keep the better of two: where `better` is false this becomes `best`, elsewhere `best` becomes this.
    template <class M>
    MAGLOC_INLINE void keep_best(M better, NormalEquations &best) {
      for (int i = 0; i < 6; ++i) {
        for (int j = 0; j <= i; ++j) matrix[i][j] = best.matrix[i][j] = choose(better, matrix[i][j], best.matrix[i][j]);
        right[i] = best.right[i] = choose(better, right[i], best.right[i]);
      }
      chi2 = best.chi2 = choose(better, chi2, best.chi2);
    }
  };

  const magloc_starts &problem_;
  LaneItems<T> items_{0, 0};
  T x_[6] = {}, start_[6] = {}, passes_ = T{}, stopped_ = T{}, done_ = broadcast<T>(1.0);
  NormalEquations now_ = {};
  T information_[6][6] = {};  // repeated: of the predicted state
  T root_[6][6] = {};         // relinearised: square root of the state's covariance
  // damped: the best state so far
  T best_x_[6] = {}, cost_ = T{}, damping_ = T{}, next_damping_ = T{};
  NormalEquations best_ = {};
  const int64_t n_residuals_;
  T *residuals_, *best_residuals_;
  T (*fields_)[3][7];  // of the sensors, for weighted differences

 public:
  StartsFilter(const magloc_starts &problem, Workspace &space)
      : problem_(problem),
        n_residuals_(problem.n_differences ? problem.n_differences : 3 * problem.n_sensors),
        residuals_(space.take<T>(n_residuals_)),
        best_residuals_(space.take<T>(n_residuals_)),
        fields_(space.take<T[3][7]>(problem.n_sensors)) {}

  void set_items(int64_t begin, int64_t end) {
    items_ = LaneItems<T>(begin, end);
    for (int64_t i = 0; i < n_residuals_; ++i) residuals_[i] = best_residuals_[i] = T{};
  }

  // One pass of the filter in each lane. Return false if all starts have ended.
  bool pass() {
    if (!items_.refill(done_, [&](int lane, int64_t item, bool is_idle) { begin_start(lane, item, is_idle); }))
      return false;
    now_.clear();
    if (problem_.n_differences)
      linearise_weighted();
    else
      linearise_contrasts();
    if (problem_.method == damped)
      judge_trial();
    else
      judge(now_.change2 < problem_.tolerance2, now_.change2);
    items_.release(done_, [&](int lane, int64_t item) { write_end(lane, item); });
    if (problem_.method == relinearised)
      update_by_each();
    else
      step();
    passes_ += 1.0;
    return true;
  }

 private:
  MAGLOC_INLINE void begin_start(int lane, int64_t item, bool is_idle) {
    for (int i = 0; i < 6; ++i) {
      set_lane(x_[i], lane, problem_.starts[6 * item + i]);
      set_lane(start_[i], lane, problem_.starts[6 * item + i]);
      for (int j = 0; j < 6; ++j) {
        set_lane(information_[i][j], lane, i == j ? 0.5 : 0.0);  // the covariance of the first prediction is 2 I
        set_lane(root_[i][j], lane, i == j ? 1.0 : 0.0);
      }
    }
    set_lane(damping_, lane, problem_.first_damping);
    set_lane(next_damping_, lane, problem_.first_damping);
    set_lane(passes_, lane, is_idle ? -infinity : 0.0);
    set_lane(done_, lane, 0.0);
  }

  void write_end(int lane, int64_t item) {
    for (int i = 0; i < 6; ++i) problem_.states[6 * item + i] = get_lane(x_[i], lane);
    problem_.chi2[item] = get_lane(now_.chi2, lane);
    problem_.iterations[item] = (int64_t)get_lane(passes_, lane);
    problem_.stopped[item] = get_lane(stopped_, lane) != 0.0;
  }

  // Recursive contrasts: the mean over the sensors so far and the next sensor minus this mean have independent errors.
  void linearise_contrasts() {
    T mean[n_terms], base[3], change2 = T{};
    for (int64_t s = 0; s < problem_.n_sensors; ++s) {
      T terms[n_terms];
      sensor_terms(problem_.sensors + 3 * s, problem_.readings + 3 * s, x_, terms);
      if (s == 0) {
        for (int a = 0; a < 3; ++a) base[a] = terms[a];
        for (int k = 0; k < n_terms; ++k) mean[k] = terms[k];
        continue;
      }
      for (int a = 0; a < 3; ++a) change2 += squared_change(3 * s + a, terms[a] - base[a]);
      const double blend = problem_.blend[s], whiten = problem_.whiten[s];
      for (int k = 0; k < n_terms; ++k) {
        const T contrast = terms[k] - mean[k];
        mean[k] += blend * contrast;
        terms[k] = whiten * contrast;
      }
      T jacobian[3][6];
      field_jacobian(terms, jacobian);
      now_.add({terms[0], terms[1], terms[2]}, jacobian);
    }
    now_.change2 = change2;
  }

  // Any weights of the sensors' fields in the differences.
  void linearise_weighted() {
    for (int64_t s = 0; s < problem_.n_sensors; ++s) linearise_field(s);
    for (int64_t j = 0; j < problem_.n_differences; j += 3) {
      T r[3], jacobian[3][6];
      MAGLOC_UNROLL
      for (int k = 0; k < 3; ++k) {
        difference(j + k, r[k], jacobian[k], [](int64_t) {});
        now_.change2 += problem_.variance[j + k] * squared_change(j + k, r[k]);
      }
      now_.add(r, jacobian);
    }
  }

  // Linearise the field at a sensor: each row of fields_[s] has minus a component, and its derivatives.
  MAGLOC_INLINE void linearise_field(int64_t s) {
    const double no_reading[3] = {};
    T terms[n_terms], jacobian[3][6];
    sensor_terms(problem_.sensors + 3 * s, no_reading, x_, terms);
    field_jacobian(terms, jacobian);
    for (int a = 0; a < 3; ++a) {
      fields_[s][a][0] = terms[a];
      for (int i = 0; i < 6; ++i) fields_[s][a][1 + i] = jacobian[a][i];
    }
  }

  // Residual of a whitened difference and Jacobian of what is predicted; `prepare` is called for each of its sensors.
  template <class Prepare>
  MAGLOC_INLINE void difference(int64_t j, T &r, T (&jacobian)[6], Prepare prepare) {
    T sum[7] = {};
    for (int64_t s = 0; s < problem_.n_sensors; ++s) {
      const double *w = problem_.weights + 3 * (problem_.n_sensors * j + s);
      if (w[0] == 0.0 && w[1] == 0.0 && w[2] == 0.0) continue;
      prepare(s);
      const T(&f)[3][7] = fields_[s];
      for (int i = 0; i < 7; ++i) sum[i] += w[0] * f[0][i] + w[1] * f[1][i] + w[2] * f[2][i];
    }
    r = problem_.measured[j] + sum[0];
    for (int i = 0; i < 6; ++i) jacobian[i] = sum[1 + i];
  }

  MAGLOC_INLINE T squared_change(int64_t i, T residual) {
    const T change = residual - residuals_[i];
    residuals_[i] = residual;
    return change * change;
  }

  // A start ends when the stop rule is met, after the last pass, or where `size` is no longer a finite number.
  template <class M>
  MAGLOC_INLINE void judge(M stops, T size) {
    const T yes = broadcast<T>(1.0), no = T{};
    stopped_ = choose(stops, yes, no);
    done_ = choose(stops | (passes_ >= (double)problem_.max_iterations), yes, choose(size < infinity, no, yes));
    done_ = choose(passes_ > 0.0, done_, no);
  }

  // Accept the trial state where it lowers the cost, and adapt the damping.
  void judge_trial() {
    T trial = now_.chi2;
    for (int i = 0; i < 6; ++i) trial += (x_[i] - start_[i]) * (x_[i] - start_[i]);
    const auto is_first = passes_ == 0.0;
    const auto better = is_first | (trial < cost_);
    const auto is_small = now_.change2 < problem_.tolerance2;
    cost_ = choose(better, trial, cost_);
    // Damping alone can make a step small: the stop rule is left to the step without it.
    judge(is_small & (damping_ == 0.0), cost_);
    const T adapted = choose(better, next_damping_ / damping_decrease, next_damping_ * damping_increase);
    next_damping_ = choose(is_first, next_damping_, adapted);
    damping_ = choose(is_small & (passes_ > 0.0), T{}, next_damping_);
    now_.keep_best(better, best_);
    for (int i = 0; i < 6; ++i) x_[i] = best_x_[i] = choose(better, x_[i], best_x_[i]);
    for (int64_t i = 0; i < n_residuals_; ++i)
      residuals_[i] = best_residuals_[i] = choose(better, residuals_[i], best_residuals_[i]);
  }

  // Gauss-Newton step; the state becomes NaN where its information is not positive definite to working precision.
  void step() {
    for (int i = 0; i < 6; ++i) {
      if (problem_.method == repeated) {
        for (int j = 0; j <= i; ++j) now_.matrix[i][j] += information_[i][j];
      } else {
        now_.matrix[i][i] = (now_.matrix[i][i] + 1.0) * (1.0 + damping_);
        now_.right[i] -= x_[i] - start_[i];
      }
    }
    const Ldl<T, 6> factors(now_.matrix, lost_pivot);
    T change[6];
    factors.solve(now_.right, change);
    for (int i = 0; i < 6; ++i) x_[i] += factors.definite() * change[i];
    if (problem_.method == repeated) predict();
  }

  // With the information Y after the pass the next predicted covariance is Y^-1 + I; its inverse is I - (Y + I)^-1.
  void predict() {
    for (int i = 0; i < 6; ++i) {
      now_.matrix[i][i] += 1.0;
      for (int j = 0; j <= i; ++j) information_[i][j] = now_.matrix[i][j];
    }
    invert_and_negate(information_);
    for (int i = 0; i < 6; ++i) information_[i][i] += 1.0;
  }

  // Predict, and update by one difference after the other, each linearised where the one before has led.
  void update_by_each() {
    add_process_noise();
    for (int64_t j = 0; j < problem_.n_differences; ++j) {
      T r, h[6], gain[6], phi[6], s = broadcast<T>(1.0);
      difference(j, r, h, [&](int64_t sensor) { linearise_field(sensor); });
      for (int c = 0; c < 6; ++c) {
        phi[c] = T{};
        for (int i = 0; i < 6; ++i) phi[c] += root_[i][c] * h[i];
        s += phi[c] * phi[c];
      }
      // Potter's update
      const T shrink = 1.0 / (1.0 + inverse_root(s));
      for (int i = 0; i < 6; ++i) {
        gain[i] = T{};
        for (int c = 0; c < 6; ++c) gain[i] += root_[i][c] * phi[c];
        gain[i] /= s;
        x_[i] += gain[i] * r;
        for (int c = 0; c < 6; ++c) root_[i][c] -= shrink * gain[i] * phi[c];
      }
    }
  }

  // S becomes a lower triangular root of S S^T + I, by modified Gram-Schmidt on the rows of [S, I].
  void add_process_noise() {
    T rows[6][12];
    for (int i = 0; i < 6; ++i)
      for (int c = 0; c < 6; ++c) {
        rows[i][c] = root_[i][c];
        rows[i][6 + c] = broadcast<T>(i == c ? 1.0 : 0.0);
        root_[i][c] = T{};
      }
    for (int i = 0; i < 6; ++i) {
      T square = T{};
      for (const T &e : rows[i]) square += e * e;
      root_[i][i] = square_root(square);
      for (T &e : rows[i]) e /= root_[i][i];
      for (int j = i + 1; j < 6; ++j) {
        for (int c = 0; c < 12; ++c) root_[j][i] += rows[j][c] * rows[i][c];
        for (int c = 0; c < 12; ++c) rows[j][c] -= root_[j][i] * rows[i][c];
      }
    }
  }
};
MAGLOC_END
