// A source followed row by row by one component: magloc/tracking/tracker.py and magloc/tracking/chart/ explain the
// steps and are their reference.
#pragma once
#include "chart.hpp"
#include "dipole.hpp"
#include "kernel.hpp"
#include "linear.hpp"

MAGLOC_BEGIN
// The differences of a row's readings, in units of their noise, as they are predicted for a source. They stand side by
// side in lanes.
template <class T>
class PredictedDifferences {
  static constexpr int n_numbers = 7;  // what a channel reads, and its derivatives by position and moment
  const magloc_track &p_;
  double *const channels_;  // (n_channels, n_numbers)
  T *const transform_;      // (n_channels, width), of the last row
  int64_t *const n_used_;   // (width): channels in the differences of a register
  int64_t transform_no_ = -1, row_ = 0;

 public:
  const int64_t width;  // registers of all differences
  T *const values;      // (width)
  T *const slopes;      // (6, width): by position, and by moment times mu_0/4pi, in the array's axes

  PredictedDifferences(const magloc_track &p, Workspace &room)
      : p_(p),
        channels_(room.take<double>(n_numbers * p.n_channels)),
        transform_(room.take<T>(n_registers<T>(p.n_differences) * p.n_channels)),
        n_used_(room.take<int64_t>(n_registers<T>(p.n_differences))),
        width(n_registers<T>(p.n_differences)),
        values(room.take<T>(width)),
        slopes(room.take<T>(6 * width)) {}

  void set_row(int64_t row) {
    row_ = row;
    if (p_.transform_of_row[row] == transform_no_) return;
    transform_no_ = p_.transform_of_row[row];
    const double *weights = p_.transforms + transform_no_ * p_.n_differences * p_.n_channels;
    for (int64_t i = 0; i < width * p_.n_channels; ++i) transform_[i] = T{};
    for (int64_t r = 0; r < width; ++r) n_used_[r] = 0;
    for (int64_t j = 0; j < p_.n_differences; ++j)
      for (int64_t c = 0; c < p_.n_channels; ++c) {
        const double weight = weights[j * p_.n_channels + c];
        const int64_t r = j / n_lanes<T>;
        set_lane(transform_[r * p_.n_channels + c], j % n_lanes<T>, weight);
        if (weight != 0.0 && n_used_[r] <= c) n_used_[r] = c + 1;
      }
  }

  // Fill values and slopes of a source at x: position and moment.
  void predict(const double *x) {
    read_channels(x);
    for (int64_t r = 0; r < width; ++r) {
      T sums[n_numbers] = {};
      for (int64_t c = 0; c < n_used_[r]; ++c) {
        const T weight = transform_[r * p_.n_channels + c];
        for (int i = 0; i < n_numbers; ++i) sums[i] += channels_[c * n_numbers + i] * weight;
      }
      values[r] = sums[0];
      for (int i = 0; i < 6; ++i) slopes[i * width + r] = sums[1 + i];
    }
  }

  // Fill derivatives (n, width) of the differences by n variables, from those of position and moment.
  template <int n>
  void differentiate(const double (&derivative)[n][n], T *columns) const {
    double in_array[6][n];
    for (int i = 0; i < 3; ++i)
      for (int c = 0; c < n; ++c) {
        const double *R = p_.rotations + 9 * row_ + i;
        in_array[i][c] = R[0] * derivative[0][c] + R[3] * derivative[1][c] + R[6] * derivative[2][c];
        in_array[3 + i][c] =
            mu0_over_4pi * (R[0] * derivative[3][c] + R[3] * derivative[4][c] + R[6] * derivative[5][c]);
      }
    for (int c = 0; c < n; ++c)
      for (int64_t r = 0; r < width; ++r) {
        T sum{};
        for (int i = 0; i < 6; ++i) sum += in_array[i][c] * slopes[i * width + r];
        columns[c * width + r] = sum;
      }
  }

 private:
  void read_channels(const double *x) {
    const double *origin = p_.origins + 3 * row_;
    double position[3], moment[3];
    for (int i = 0; i < 3; ++i) {
      const double *R = p_.rotations + 9 * row_ + i;
      position[i] = R[0] * (x[0] - origin[0]) + R[3] * (x[1] - origin[1]) + R[6] * (x[2] - origin[2]);
      moment[i] = mu0_over_4pi * (R[0] * x[3] + R[3] * x[4] + R[6] * x[5]);
    }
    for (int64_t s = 0; s < p_.n_sensors; ++s) {
      const double *sensor = p_.sensors + 3 * s;
      const double *ambient = p_.ambients + 3 * (p_.ambient_of_row[row_] * p_.n_sensors + s);
      const double d[3] = {sensor[0] - position[0], sensor[1] - position[1], sensor[2] - position[2]};
      const Ray<double> ray = Ray<double>::from(d);
      double by_moment[3][3], by_point[3][3], b[3];
      field_matrix(ray, by_moment);
      gradient(ray, moment, by_point);
      for (int a = 0; a < 3; ++a) b[a] = ambient[a] + dot(by_moment[a], moment);
      for (int64_t c = p_.first_channel[s]; c < p_.first_channel[s + 1]; ++c) {
        double gain[3] = {p_.gain[3 * c], p_.gain[3 * c + 1], p_.gain[3 * c + 2]};
        if (p_.is_modulus[c]) {
          const double modulus = square_root(dot(b, b)), scale = modulus > 0.0 ? gain[0] / modulus : 0.0;
          for (int a = 0; a < 3; ++a) gain[a] = scale * b[a];
        }
        double *const numbers = channels_ + n_numbers * c;
        numbers[0] = dot(gain, b);
        for (int i = 0; i < 3; ++i) {
          numbers[1 + i] = -dot(gain, by_point[i]);
          numbers[4 + i] = dot(gain, by_moment[i]);
        }
      }
    }
  }
};

// A track of one component whose state has n numbers.
template <class T, int n>
class Track {
  // Mean of the state, and a root of its covariance in the chart about it.
  struct Gaussian {
    double x[n], root[n][n];
  };

  const magloc_track &p_;
  PredictedDifferences<T> differences_;
  const int64_t k_, width_;  // registers of the differences; of all misfits: those of the differences and of the state
  int64_t row_ = 0;
  Gaussian known_, predicted_, updated_;  // after the row before, and before and after this row's readings
  double centroid_before_[3], centroid_[3], open_loop_[n][n];
  Chart<n> chart_;         // about the prediction
  double *const noise_;    // (n, n_noise), root of the motion's noise
  double *const changes_;  // (n, n + n_noise)
  T *const rows_;          // (n, registers of n + n_noise)

  // The update iterates over standard numbers: coordinates are the prediction's root times these. Where the prediction
  // bends as the readings h do, those that have a normal distribution are zeta + M (h(zeta) - h(0) - J(0) zeta).
  double derivative_[n][n];                // of the state by its coordinates, where it was last predicted
  T *const measured_;                      // (k)
  T *const first_, *const slopes_;         // (k), (n, k): h(0) and J(0)
  T *const bend_;                          // (n, k): M
  T *const jacobian_;                      // (n, k)
  T *const rest_;                          // (k)
  T *const misfit_, *const trial_misfit_;  // (width)
  T *const columns_;                       // (n + 1, width)
  double triangle_[n + 1][n + 1], step_[n], gain_, nis_;
  int64_t iterations_;

 public:
  Track(const magloc_track &p, Workspace &room)
      : p_(p),
        differences_(p, room),
        k_(differences_.width),
        width_(k_ + n_registers<T>(n)),
        noise_(room.take<double>(n * p.n_noise)),
        changes_(room.take<double>(n * (n + p.n_noise))),
        rows_(room.take<T>(n * n_registers<T>(n + p.n_noise))),
        measured_(room.take<T>(k_)),
        first_(room.take<T>(k_)),
        slopes_(room.take<T>(n * k_)),
        bend_(room.take<T>(n * k_)),
        jacobian_(room.take<T>(n * k_)),
        rest_(room.take<T>(k_)),
        misfit_(room.take<T>(width_)),
        trial_misfit_(room.take<T>(width_)),
        columns_(room.take<T>((n + 1) * width_)) {}

  void load() {
    __builtin_memcpy(known_.x, p_.x, sizeof known_.x);
    __builtin_memcpy(known_.root, p_.root, sizeof known_.root);
    __builtin_memcpy(centroid_before_, p_.centroid, sizeof centroid_before_);
    __builtin_memcpy(open_loop_, p_.open_loop, sizeof open_loop_);
  }
  void store() const {
    __builtin_memcpy(p_.x, known_.x, sizeof known_.x);
    __builtin_memcpy(p_.root, known_.root, sizeof known_.root);
    __builtin_memcpy(p_.centroid, centroid_before_, sizeof centroid_before_);
    __builtin_memcpy(p_.open_loop, open_loop_, sizeof open_loop_);
  }

  // Follow the source to a row. Return false, and stay before the row, if the track does not explain it.
  bool follow(int64_t row) {
    row_ = row;
    nis_ = nan;
    iterations_ = 0;
    predict();
    if (is_too_wide(predicted_)) return false;
    if (p_.counts[row] == 0)
      updated_ = predicted_;
    else if (!update() || is_too_wide(updated_))
      return false;
    record();
    return true;
  }

 private:
  // Whether log-range or direction are so uncertain that the component is no place any more.
  bool is_too_wide(const Gaussian &state) const {
    for (int i = 0; i < 3; ++i)
      if (!(variance(state, i) <= p_.largest_width * p_.largest_width)) return true;
    return false;
  }
  static double variance(const Gaussian &state, int i) {
    double sum = 0.0;
    for (double s : state.root[i]) sum += s * s;
    return sum;
  }
  static void multiply(const double *a, const double (&b)[n][n], double (&product)[n][n]) {
    for (int i = 0; i < n; ++i)
      for (int c = 0; c < n; ++c) {
        product[i][c] = 0.0;
        for (int j = 0; j < n; ++j) product[i][c] += a[n * i + j] * b[j][c];
      }
  }
  static void put_numbers(T *row, int64_t width, const double *numbers, int64_t count) {
    for (int64_t r = 0; r < width; ++r) row[r] = T{};
    for (int64_t i = 0; i < count; ++i) set_number(row, i, numbers[i]);
  }

  const double *transition() const { return p_.F + n * n * p_.step_of_row[row_]; }

  void predict() {
    const int64_t m = p_.n_noise, first = n * m * p_.step_of_row[row_], width = n_registers<T>(n + m);
    const double *F = transition(), *A = p_.A + first, *B = p_.B + first, zero[n] = {};
    const Chart<n> before = Chart<n>::at(known_.x, centroid_before_, p_.radius);
    const double strength = before.strength();
    double here[n], moved[n][n], moved_root[n][n];
    before.move(zero, here, derivative_);
    multiply(F, derivative_, moved);
    multiply(moved[0], known_.root, moved_root);
    for (int i = 0; i < n; ++i) {
      predicted_.x[i] = 0.0;
      for (int j = 0; j < n; ++j) predicted_.x[i] += F[n * i + j] * known_.x[j];
      double *const changes = changes_ + (n + m) * i;
      for (int c = 0; c < n; ++c) changes[c] = moved_root[i][c];
      for (int64_t c = 0; c < m; ++c) changes[n + c] = noise_[m * i + c] = A[m * i + c] + strength * B[m * i + c];
    }
    const double *origin = p_.origins + 3 * row_, *R = p_.rotations + 9 * row_;
    for (int i = 0; i < 3; ++i) {
      centroid_[i] = origin[i];
      for (int j = 0; j < 3; ++j) centroid_[i] += R[3 * i + j] * p_.array_centroid[j];
    }
    chart_ = Chart<n>::at(predicted_.x, centroid_, p_.radius);
    chart_.to_coordinates(changes_, n + m);
    double triangle[n][n];
    for (int i = 0; i < n; ++i) put_numbers(rows_ + width * i, width, changes_ + (n + m) * i, n + m);
    orthonormalise(rows_, width, triangle);
    for (int i = 0; i < n; ++i)
      for (int c = 0; c < n; ++c) predicted_.root[i][c] = c <= i ? triangle[c][i] : 0.0;
  }

  // Gauss-Newton steps, each halved until it lowers chi-square enough.
  bool update() {
    double zeta[n] = {}, trial[n], there[n];
    differences_.set_row(row_);
    put_numbers(measured_, k_, p_.measured + p_.n_differences * row_, p_.n_differences);
    chart_.judge_moment(predicted_.root, p_.firm);
    move_to(zeta, updated_.x);
    bend_prediction();
    double chi2 = fill_misfit(zeta, misfit_);
    while (true) {
      solve_linearised();
      if (gain_ < p_.tolerance * p_.tolerance) break;
      double trial_chi2;
      for (double share = 1.0;; share *= 0.5) {
        if (iterations_++ == p_.max_iterations) return false;
        for (int i = 0; i < n; ++i) trial[i] = zeta[i] + share * step_[i];
        move_to(trial, there);
        trial_chi2 = fill_misfit(trial, trial_misfit_);
        if (trial_chi2 <= chi2 - p_.least_gain * share * gain_ + p_.rounding * (1.0 + chi2)) break;
      }
      chi2 = trial_chi2;
      __builtin_memcpy(zeta, trial, sizeof zeta);
      __builtin_memcpy(updated_.x, there, sizeof there);
      for (int64_t r = 0; r < width_; ++r) misfit_[r] = trial_misfit_[r];
    }
    nis_ = chi2;
    fill_updated_root();
    return nis_ <= p_.nis_limits[p_.counts[row_]];
  }

  // Predict the differences of the state x at standard numbers.
  void move_to(const double (&zeta)[n], double (&x)[n]) {
    double e[n] = {};
    for (int i = 0; i < n; ++i)
      for (int j = 0; j <= i; ++j) e[i] += predicted_.root[i][j] * zeta[j];
    chart_.move(e, x, derivative_);
    differences_.predict(x);
  }
  void differentiate(T *columns) const {
    double by_zeta[n][n];
    multiply(derivative_[0], predicted_.root, by_zeta);
    differences_.differentiate(by_zeta, columns);
  }

  // Let the prediction bend as the readings do, unless the row misses some or the motion has made the state so wide.
  void bend_prediction() {
    for (int64_t r = 0; r < k_; ++r) first_[r] = differences_.values[r];
    differentiate(slopes_);
    bool bends = p_.counts[row_] >= p_.full_count;
    for (int i = 0; i < 6; ++i)
      bends &= variance(predicted_, i) <= p_.largest_growth * p_.largest_growth * variance(known_, i);
    for (int64_t r = 0; r < n * k_; ++r) bend_[r] = T{};
    if (bends) fill_damped_inverse();
  }
  // M with M J = 1 along what J tells well enough, and 0 where it tells next to nothing.
  void fill_damped_inverse() {
    double triangle[n][n];
    for (int i = 0; i < n; ++i) {
      T *const column = columns_ + width_ * i;
      for (int64_t r = 0; r < width_; ++r) column[r] = r < k_ ? slopes_[k_ * i + r] : T{};
      set_number(column + k_, i, p_.least_share);
    }
    orthonormalise(columns_, width_, triangle);
    for (int i = n; i-- > 0;)
      for (int64_t r = 0; r < k_; ++r) {
        T rest = columns_[width_ * i + r];
        for (int c = i + 1; c < n; ++c) rest -= triangle[i][c] * bend_[k_ * c + r];
        bend_[k_ * i + r] = rest / triangle[i][i];
      }
  }

  // Fill the misfits of readings and prediction at standard numbers. Return the sum of their squares.
  double fill_misfit(const double (&zeta)[n], T *misfit) {
    for (int64_t r = 0; r < k_; ++r) {
      misfit[r] = measured_[r] - differences_.values[r];
      rest_[r] = differences_.values[r] - first_[r];
      for (int i = 0; i < n; ++i) rest_[r] -= zeta[i] * slopes_[k_ * i + r];
    }
    for (int64_t r = k_; r < width_; ++r) misfit[r] = T{};
    for (int i = 0; i < n; ++i) set_number(misfit + k_, i, -zeta[i] - dot(bend_ + k_ * i, rest_, k_));
    return dot(misfit, misfit, width_);
  }

  // Find the step to the least sum of squares of linearised misfits, and by how much it is less.
  void solve_linearised() {
    differentiate(jacobian_);
    for (int i = 0; i < n; ++i) {
      const T *const slope = jacobian_ + k_ * i;
      T *const column = columns_ + width_ * i;
      for (int64_t r = 0; r < k_; ++r) rest_[r] = slope[r] - slopes_[k_ * i + r];
      for (int64_t r = 0; r < width_; ++r) column[r] = r < k_ ? slope[r] : T{};
      for (int c = 0; c < n; ++c) set_number(column + k_, c, (i == c) + dot(bend_ + k_ * c, rest_, k_));
    }
    for (int64_t r = 0; r < width_; ++r) columns_[width_ * n + r] = misfit_[r];
    orthonormalise(columns_, width_, triangle_);
    gain_ = 0.0;
    for (int i = n; i-- > 0;) {
      gain_ += triangle_[i][n] * triangle_[i][n];
      step_[i] = triangle_[i][n];
      for (int j = i + 1; j < n; ++j) step_[i] -= triangle_[i][j] * step_[j];
      step_[i] /= triangle_[i][i];
    }
  }

  // The root of what is known after the readings, in the chart about the updated state.
  void fill_updated_root() {
    double solved[n][n];
    for (int i = 0; i < n; ++i)
      for (int c = 0; c < n; ++c) {
        solved[i][c] = predicted_.root[i][c];
        for (int j = 0; j < c; ++j) solved[i][c] -= solved[i][j] * triangle_[j][c];
        solved[i][c] /= triangle_[c][c];
      }
    multiply(derivative_[0], solved, updated_.root);
    Chart<n>::at(updated_.x, centroid_, p_.radius).to_coordinates(updated_.root[0], n);
  }

  // Go on from the row, and write what became of it.
  void record() {
    const int64_t m = p_.n_noise;
    const double *F = transition();
    double moved[n][n];
    multiply(F, open_loop_, moved);
    for (int i = 0; i < n; ++i) {
      for (int j = 0; j < n; ++j) {
        open_loop_[i][j] = 0.0;
        for (int c = 0; c < n; ++c) open_loop_[i][j] += moved[i][c] * F[n * j + c];
        for (int64_t c = 0; c < m; ++c) open_loop_[i][j] += noise_[m * i + c] * noise_[m * j + c];
      }
      p_.open_loop_variances[n * row_ + i] = open_loop_[i][i];
    }
    known_ = updated_;
    __builtin_memcpy(centroid_before_, centroid_, sizeof centroid_);
    __builtin_memcpy(p_.predicted_x + n * row_, predicted_.x, sizeof predicted_.x);
    __builtin_memcpy(p_.predicted_roots + n * n * row_, predicted_.root, sizeof predicted_.root);
    __builtin_memcpy(p_.updated_x + n * row_, updated_.x, sizeof updated_.x);
    __builtin_memcpy(p_.updated_roots + n * n * row_, updated_.root, sizeof updated_.root);
    p_.nis[row_] = nis_;
    p_.iterations[row_] = iterations_;
  }
};
MAGLOC_END
