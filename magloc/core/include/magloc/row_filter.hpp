// What rows of readings tell of several sources: magloc/tracking/chart explains it for one source.
//
// A state has n_states numbers of each source and, behind them, nuisances that are linear in the readings. Inside, what
// readings depend on comes first: position and moment of each source, nuisances, then further numbers of each source. A
// prediction's root is lower triangular, so that the readings depend on the first d of the standard numbers zeta alone;
// coordinates are the root times zeta. Orthogonal transformations keep what covariances and normal equations would lose
// where a nuisance is known 1e5 times less well than a reading.
#pragma once
#include "bent_prediction.hpp"
#include "row_readings.hpp"
#include "source_motion.hpp"

MAGLOC_BEGIN
template <class T>
class RowFilter {
  const magloc_sources &p_;
  const magloc_rows &given_;
  Workspace &space_;
  const int64_t K_ = p_.n_sources, ns_ = p_.n_states, e_ = p_.n_nuisances, seen_ = n_measured * K_, d_ = seen_ + e_;
  RowReadings<T> readings_{given_, K_, space_};
  const int64_t k_ = readings_.width();                        // registers that the readings fill
  SourceChart *const charts_ = space_.take<SourceChart>(K_);   // about the mean
  ChartedState *const there_ = space_.take<ChartedState>(K_);  // states of the sources at zeta

 public:
  const int64_t N = K_ * ns_ + e_;                   // length of a state
  double *const x = space_.take<double>(N);          // mean
  Padded<T> root{space_, N, N};                      // of the covariance in the charts about it, in the inner order
  Padded<T> transition{space_, K_ * ns_, ns_};       // of the coordinates of each source, in the last prediction
  double nis = nan, chi2 = nan, log_evidence = nan;  // of the last update
  int64_t iterations = 0;
  bool converged = false;

 private:
  // The linearised problem has a column for each nuisance, for each seen number of the sources, and for the misfit.
  // Their numbers are one for each reading, and one for each zeta, nuisances first.
  Padded<T> columns_{space_, d_ + 1, k_ * n_lanes<T> + d_}, triangle_{space_, N + 1, N + 1};
  Padded<T> turned_{space_, seen_, d_ + 1}, rows_{space_, N, N}, solved_{space_, d_, N};
  T *const misfit_ = space_.take<T>(k_), *const trial_misfit_ = space_.take<T>(k_);  // of the readings
  double *const e_there_ = space_.take<double>(N);                                   // coordinates at zeta
  double *const zeta_ = space_.take<double>(d_), *const trial_ = space_.take<double>(d_);
  double *const step_ = space_.take<double>(d_ + 1);  // nuisances first
  BentPrediction<T> bending_{k_, d_, space_};
  double *const standard_ = space_.take<double>(d_);  // zeta, or where the prediction bends what is normal there

 public:
  RowFilter(const magloc_sources &p, const magloc_rows &rows, Workspace &space) : p_(p), given_(rows), space_(space) {}

  // Go to a row of readings.
  void set_row(int64_t row) { readings_.set_row(row); }
  const double (&centroid() const)[3] { return readings_.centroid; }

  void load(const magloc_sources &sources, int64_t item) {
    __builtin_memcpy(x, sources.x + N * item, N * sizeof(double));
    root.clear(N);
    for (int64_t i = 0; i < N; ++i)
      __builtin_memcpy(root[row_of(i)], sources.roots + N * (N * item + i), N * sizeof(double));
  }
  void store(const magloc_sources &sources, int64_t item) const {
    __builtin_memcpy(sources.x + N * item, x, N * sizeof(double));
    for (int64_t i = 0; i < N; ++i)
      __builtin_memcpy(sources.roots + N * (N * item + i), root[row_of(i)], N * sizeof(double));
  }
  double variance(int64_t i) const { return dot(root.lanes(row_of(i)), root.lanes(row_of(i)), root.width()); }

  // Space for the rows of a prediction and of the motion's noise.
  Padded<T> wide(const SourceMotion &motion, Workspace &space) const {
    return {space, N, N + motion.n_noise * K_ + (motion.has_noisy_nuisances() ? e_ : 0)};
  }
  // Predict all states after a step of the motion, which ends at the row; the sensors' centroid was elsewhere before.
  // `item` counts states whose steps differ. With a trajectory's state `to` the charts stand about that, and offsets of
  // what is expected from it, in the inner order, are predicted as well.
  void predict(SourceMotion &motion, int64_t step, int64_t item, const double (&centroid_before)[3],
               const Padded<T> &wide, const double *to = nullptr, double *offset = nullptr) {
    const double zero[max_source_states] = {};
    const int64_t m = motion.n_noise;
    wide.clear(N);
    for (int64_t k = 0; k < K_; ++k) {
      double *const state = x + ns_ * k, expected[max_source_states];
      SourceChart before(state, ns_, p_.power, centroid_before, given_.radius);
      before.move(zero, there_[0]);
      motion.take(state, step, K_ * item + k);
      __builtin_memcpy(state, to ? to + ns_ * k : motion.x, ns_ * sizeof(double));
      const SourceChart after(state, ns_, p_.power, readings_.centroid, given_.radius);
      const Padded<T> A = transition.from(ns_ * k);
      A.clear(ns_);
      for (int64_t i = 0; i < ns_; ++i) A[i][i] = 1.0;
      before.to_state(there_[0], A.lanes(0), A.lanes(n_measured), A.width());
      for (int64_t j = 0; j < A.width(); ++j) {
        T change[max_source_states];
        for (int64_t i = 0; i < ns_; ++i) change[i] = A.lanes(i)[j], A.lanes(i)[j] = T{};
        for (int64_t i = 0; i < ns_; ++i)
          for (int64_t c = 0; c < ns_; ++c) A.lanes(i)[j] += motion.F[ns_ * i + c] * change[c];
      }
      after.to_coordinates(A.lanes(0), A.lanes(n_measured), A.width());
      for (int64_t i = 0; i < ns_; ++i)
        __builtin_memcpy(wide[row_of(ns_ * k + i)] + N + m * k, motion.noise + m * i, m * sizeof(double));
      after.to_coordinates(wide.lanes(n_measured * k), further(wide, k), wide.width());
      if (offset) after.fill_coordinates(motion.x, expected);
      for (int64_t i = 0; i < ns_; ++i) {
        T *const row = wide.lanes(row_of(ns_ * k + i));
        add_rows(row, {A[i]}, root.from(n_measured * k), n_measured);
        add_rows(row, {A[i] + n_measured}, root.from(row_of(ns_ * k + n_measured)), ns_ - n_measured);
        for (int64_t j = 0; offset && j < ns_; ++j) expected[i] += A[i][j] * offset[row_of(ns_ * k + j)];
      }
      for (int64_t i = 0; offset && i < ns_; ++i) offset[row_of(ns_ * k + i)] = expected[i];
    }
    for (int64_t i = 0; i < e_; ++i) {
      const double kept = motion.has_noisy_nuisances() ? motion.kept(step)[i] : 1.0;
      add_rows(wide.lanes(seen_ + i), {&kept}, root.from(seen_ + i), 1);
      x[N - e_ + i] *= kept;
      if (offset) offset[seen_ + i] *= kept;
      if (motion.has_noisy_nuisances()) wide[seen_ + i][N + m * K_ + i] = motion.added(step)[i];
    }
    triangularise(wide, N, triangle_);
    set_lower();
  }

  // Update the state by the row's readings: Gauss and Newton's steps, each halved until it lowers the cost enough. The
  // prediction may bend as the readings do, along what they tell in more than a share of its standard deviation; there
  // must be no nuisances then.
  void update(const magloc_convergence &limits, bool bends = false, double least_share = 0.0) {
    begin_update();
    double length = 1.0, gain = 0.0, cost = misfit_at(zeta_, misfit_);
    if (bends) {
      fill_source_columns();
      bending_.bend(misfit_, columns_, least_share, triangle_);
    }
    bool is_stale = true;
    for (iterations = 0;; ++iterations) {
      if (is_stale) gain = linearise(), length = 1.0;
      converged = gain < limits.tolerance * limits.tolerance;
      if (converged || iterations >= limits.max_iterations) break;
      for (int64_t i = 0; i < d_; ++i) trial_[i] = zeta_[i] + length * step_[i < seen_ ? e_ + i : i - seen_];
      const double there = misfit_at(trial_, trial_misfit_);
      is_stale = there <= cost - limits.least_gain * length * gain + limits.rounding * (1.0 + cost);
      length *= 0.5;
      if (!is_stale) continue;
      cost = there;
      __builtin_memcpy(zeta_, trial_, d_ * sizeof(double));
      __builtin_memcpy(misfit_, trial_misfit_, k_ * sizeof(T));
    }
    nis = cost;
    chi2 = dot(misfit_, misfit_, k_);
    log_evidence = -0.5 * cost;
    if (bends) log_evidence += bending_.log_determinant(columns_);
    for (int64_t i = 0; !bends && i < d_; ++i) log_evidence -= logarithm(triangle_[i][i]);
  }

  // After an update: chi-square (n_sensors) that free readings of each sensor would explain.
  void fill_sensor_chi2(double followed, double *chi2_of_sensors) const {
    for (int64_t s = 0, c = 0; s < given_.n_sensors; ++s) {
      int64_t n = 0;
      double square[3][3] = {}, left[3] = {}, share[3];
      for (; c + n < given_.n_channels && n < 3 && given_.sensor[c + n] == s; ++n)
        for (int64_t i = 0; i <= n; ++i)
          square[n][i] =
              (1.0 + followed) * dot(readings_.transform().lanes(c + n), readings_.transform().lanes(c + i), k_);
      for (int64_t q = 0; q <= d_; ++q)
        for (int64_t i = 0; i < n; ++i) {
          share[i] = dot(readings_.transform().lanes(c + i), columns_.lanes(q), k_);
          if (q == d_ /* what is left of the misfit */)
            left[i] = triangle_[q][q] * share[i];
          else
            for (int64_t j = 0; j <= i; ++j) square[i][j] -= share[i] * share[j];
        }
      for (int64_t i = n; i < 3; ++i) square[i][i] = 1.0;
      const Ldl<double, 3> factors(square, 1e-9);
      double explained[3];
      factors.solve(left, explained);
      chi2_of_sensors[s] = dot(left, explained);
      c += n;
    }
  }

  // After an update: the innovation (n_readings) freed of correlations, L^-1 nu with the lower root L of its
  // covariance.
  void fill_innovation(const Padded<T> &wide, const Padded<T> &triangle, double *innovation) {
    fill_columns();
    bending_.straighten(columns_);
    wide.clear(given_.n_readings);
    for (int64_t i = 0; i < given_.n_readings; ++i) {
      innovation[i] = reinterpret_cast<const double *>(misfit_)[i];
      for (int64_t c = 0; c < d_; ++c) {
        wide[i][c] = columns_[c][i];
        innovation[i] -= columns_[c][i] * tail(d_)[c];
      }
      wide[i][d_ + i] = 1.0;
    }
    triangularise(wide, given_.n_readings, triangle);
    solve_transposed(triangle, given_.n_readings, innovation);
  }

  // Let mean and root be those after the update, the root in the charts about the new mean.
  void finish_update() {
    move_to(zeta_);
    condition_root();
    for (int64_t k = 0; k < K_; ++k) {
      charts_[k].to_state(there_[k], root.lanes(n_measured * k), further(root, k), root.width());
      __builtin_memcpy(x + ns_ * k, there_[k].x, ns_ * sizeof(double));
      set_chart(k);
      charts_[k].to_coordinates(root.lanes(n_measured * k), further(root, k), root.width());
    }
    for (int64_t i = 0; i < e_; ++i) x[N - e_ + i] += e_there_[seen_ + i];
    double sum = 0.0;
    for (int64_t i = 0; i < N; ++i) sum += dot(root.lanes(i), root.lanes(i), root.width());
    converged &= sum < infinity;
  }

  // Let the root be a lower triangular one.
  void lower_root() {
    for (int64_t i = 0; i < N; ++i)
      for (int64_t j = i + 1; j < N; ++j)
        if (root[i][j] != 0.0) {
          rows_.copy(root, N);
          triangularise(rows_, N, triangle_);
          set_lower();
          return;
        }
  }

  // Kalman's update by the row, linearised at the mean, of offsets from it (N) that are expected and of the root. The
  // information (d, d) in standard numbers has the upper root, and their means are zeta, in the order of the columns.
  void update_linearised(double *offset, const Padded<T> &information_root, double *zeta) {
    begin_update();
    misfit_at(zeta_, misfit_);
    linearise(offset);
    nis = triangle_[d_][d_] * triangle_[d_][d_];
    log_evidence = -0.5 * nis;
    for (int64_t c = 0; c < d_; ++c) {
      log_evidence -= logarithm(triangle_[c][c]);
      zeta[c] = zeta_[zeta_of(c)] = step_[c];
      for (int64_t i = 0; i < d_; ++i) information_root[c][i] = triangle_[c][i];
    }
    fill_coordinates(zeta_);
    for (int64_t i = 0; i < N; ++i) offset[i] += e_there_[i];
    condition_root();
  }

  // How far readings bend over what is not known along axes (6 K) of the sources: magloc/tracking/chart/split.py. And
  // by what the whole state (6 K, N) differs one sigma along them.
  void fill_bends(double memory, double *bends, double *directions) {
    T *const here = misfit_, *const ahead = trial_misfit_, *const behind = columns_.lanes(d_);
    begin_update();
    fill_columns();
    for (int64_t r = 0; r < k_; ++r) here[r] = readings_.values()[r];
    turn_source_columns();
    for (int64_t a = 0; a < seen_; ++a, ++bends, directions += N) {
      for (int64_t j = 0; j < seen_; ++j) zeta_[j] = tail(e_ + a)[e_ + j];
      fill_coordinates(zeta_);
      for (int64_t i = 0; i < N; ++i) directions[i] = e_there_[row_of(i)];
      readings_at(1.0, ahead);
      readings_at(-1.0, behind);
      T bend{}, gradient{};
      for (int64_t r = 0; r < k_; ++r) {
        const T curve = 0.5 * (ahead[r] + behind[r]) - here[r], slope = 0.5 * (ahead[r] - behind[r]);
        bend += curve * curve;
        gradient += slope * slope;
      }
      const double told = sum_of_lanes(gradient), n = told < 1.0 ? minimum(1.0 / told, memory) : 1.0;
      *bends = square_root(sum_of_lanes(bend) * n) / (1.0 + told);
    }
  }

  // The inner order of a state's numbers.
  int64_t row_of(int64_t i) const {
    if (i >= N - e_) return seen_ + i - (N - e_);
    const int64_t k = i / ns_, j = i % ns_;
    return j < n_measured ? n_measured * k + j : d_ + (ns_ - n_measured) * k + j - n_measured;
  }
  // Which standard number a column of the linearised problem belongs to.
  int64_t zeta_of(int64_t column) const { return column < e_ ? seen_ + column : column - e_; }

 private:
  T *further(const Padded<T> &rows, int64_t k) const { return rows.lanes(d_ + (ns_ - n_measured) * k); }
  double *tail(int64_t column) const { return reinterpret_cast<double *>(columns_.lanes(column) + k_); }

  void set_chart(int64_t k) {
    charts_[k] = SourceChart(x + ns_ * k, ns_, p_.power, readings_.centroid, given_.radius);
    judge(k);
  }
  void judge(int64_t k) {
    double moment = 0.0;
    for (int64_t i = 3; i < n_measured; ++i) moment += variance(ns_ * k + i);
    charts_[k].judge_moment(moment, p_.firm);
  }

  // Let the root be the transpose of the triangle.
  void set_lower() {
    root.clear(N);
    for (int64_t i = 0; i < N; ++i)
      for (int64_t j = 0; j <= i; ++j) root[i][j] = triangle_[j][i];
  }
  // Let the root be that after the update, in the same chart.
  void condition_root() {
    for (int64_t c = 0; c < d_; ++c)
      for (int64_t i = 0; i < N; ++i) solved_[c][i] = root[i][zeta_of(c)];
    solve_transposed(triangle_, d_, solved_);
    for (int64_t c = 0; c < d_; ++c)
      for (int64_t i = 0; i < N; ++i) root[i][zeta_of(c)] = solved_[c][i];
  }

  void begin_update() {
    bending_.bends = false;
    lower_root();
    for (int64_t k = 0; k < K_; ++k) set_chart(k);
    for (int64_t i = 0; i < d_; ++i) zeta_[i] = 0.0;
    columns_.clear(d_ + 1);
    fill_nuisance_columns();
    triangularise(columns_, e_, triangle_);
  }

  // The states at standard numbers.
  void move_to(const double *zeta) {
    fill_coordinates(zeta);
    place(1.0);
  }
  void fill_coordinates(const double *zeta) {
    for (int64_t i = 0; i < N; ++i) {
      e_there_[i] = 0.0;
      for (int64_t j = 0; j < d_ && j <= i; ++j) e_there_[i] += root[i][j] * zeta[j];
    }
  }
  void place(double sign) {
    for (int64_t k = 0; k < K_; ++k) {
      double e[max_source_states];
      for (int64_t i = 0; i < ns_; ++i) e[i] = sign * e_there_[row_of(ns_ * k + i)];
      charts_[k].move(e, there_[k]);
      readings_.set_source(k, there_[k].x);
    }
  }
  // Readings at some times the coordinates, without those of the nuisances' means.
  void readings_at(double sign, T *values) {
    place(sign);
    readings_.template predict<false>();
    for (int64_t r = 0; r < k_; ++r) values[r] = readings_.values()[r];
    if (sign != 0.0) add_rows(values, {e_there_ + seen_, 1, sign}, readings_.effect, e_);
  }

  // Fill the misfit of the readings at standard numbers. Return the cost: its square and theirs.
  double misfit_at(const double *zeta, T *misfit) {
    move_to(zeta);
    readings_.template predict<true>();
    for (int64_t r = 0; r < k_; ++r) misfit[r] = readings_.measured.lanes(0)[r] - readings_.values()[r];
    add_rows(misfit, {x + N - e_, 1, -1.0}, readings_.effect, e_);
    add_rows(misfit, {e_there_ + seen_, 1, -1.0}, readings_.effect, e_);
    double cost = dot(misfit, misfit, k_);
    bending_.fill_standard(zeta, misfit, standard_);
    for (int64_t i = 0; i < d_; ++i) cost += standard_[i] * standard_[i];
    return cost;
  }

  void fill_nuisance_columns() {
    for (int64_t c = 0; c < e_; ++c) {
      for (int64_t r = 0; r < columns_.width(); ++r) columns_.lanes(c)[r] = T{};
      add_rows(columns_.lanes(c), root.from(seen_).column(seen_ + c), readings_.effect, e_);
      tail(c)[c] = 1.0;
    }
  }
  // Columns of the sources, and the misfit, where the readings were predicted last. The state is expected at an offset
  // from there, or nowhere else.
  void fill_source_columns(const double *offset = nullptr) {
    const double *R = readings_.rotation;
    for (int64_t i = 0; i < seen_; ++i) {
      __builtin_memcpy(turned_[i], root[i], d_ * sizeof(double));
      turned_[i][d_] = offset ? offset[i] : 0.0;
    }
    for (int64_t k = 0; k < K_; ++k) {
      T *rows = turned_.lanes(n_measured * k);
      const int64_t width = turned_.width();
      charts_[k].to_state(there_[k], rows, (T *)nullptr, width);
      for (int64_t j = 0; j < 2 * width; ++j) {
        T *const row = rows + (j < width ? j : 2 * width + j);
        const T world[3] = {row[0], row[width], row[2 * width]};
        for (int i = 0; i < 3; ++i) {
          const T turned = R[i] * world[0] + R[3 + i] * world[1] + R[6 + i] * world[2];
          row[i * width] = j < width ? turned : mu0_over_4pi * turned;
        }
      }
    }
    for (int64_t j = 0; j < seen_; ++j) {
      const int64_t first = j - j % n_measured;  // sources before do not depend on this zeta
      T *const column = columns_.lanes(e_ + j);
      for (int64_t r = 0; r < columns_.width(); ++r) column[r] = T{};
      add_rows(column, turned_.from(first).column(j), readings_.slopes().from(first), seen_ - first);
      add_rows(column, root.from(seen_).column(j), readings_.effect, e_);
      tail(e_ + j)[e_ + j] = 1.0;
    }
    if (offset) {
      add_rows(misfit_, -turned_.column(d_), readings_.slopes(), seen_);
      add_rows(misfit_, {offset + seen_, 1, -1.0}, readings_.effect, e_);
    }
    bending_.fill_derivatives(columns_);
    __builtin_memcpy(columns_.lanes(d_), misfit_, k_ * sizeof(T));
    bending_.fill_standard(zeta_, misfit_, standard_);
    for (int64_t c = 0; c < d_; ++c) tail(d_)[c] = -standard_[zeta_of(c)];
  }
  void fill_columns() {
    move_to(zeta_);
    readings_.template predict<true>();
    fill_nuisance_columns();
    fill_source_columns();
  }

  // Find the step to the least cost of the linearised problem. Return by how much it is less.
  double linearise(const double *offset = nullptr) {
    fill_source_columns(offset);
    triangularise(columns_, d_ + 1, triangle_, e_);
    double gain = 0.0;
    for (int64_t c = 0; c < d_; ++c) {
      step_[c] = triangle_[c][d_];
      gain += step_[c] * step_[c];
    }
    solve(triangle_, d_, step_);
    return gain;
  }

  // Jacobi's rotations make the columns of the sources orthogonal: the numbers behind them become right singular
  // vectors.
  void turn_source_columns() {
    double rounding = 0.0;
    for (int64_t i = e_; i < d_; ++i) rounding += 1e-15 * dot(columns_.lanes(i), columns_.lanes(i), k_);
    bool is_turned = true;
    for (int sweep = 0; sweep < 30 && is_turned; ++sweep) {
      is_turned = false;
      for (int64_t i = e_; i < d_; ++i)
        for (int64_t j = i + 1; j < d_; ++j) {
          T *const a = columns_.lanes(i), *const b = columns_.lanes(j);
          const double product = dot(a, b, k_), of_a = dot(a, a, k_), of_b = dot(b, b, k_);
          if (product * product <= 1e-16 * of_a * of_b + rounding * rounding) continue;
          is_turned = true;
          const double slope = 0.5 * (of_b - of_a) / product;
          const double tangent = 1.0 / (slope + (slope < 0.0 ? -1.0 : 1.0) * square_root(1.0 + slope * slope));
          const double cosine = inverse_root(1.0 + tangent * tangent), sine = tangent * cosine;
          for (int64_t r = 0; r < columns_.width(); ++r) {
            const T before = a[r];
            a[r] = cosine * before - sine * b[r];
            b[r] = sine * before + cosine * b[r];
          }
        }
    }
  }
};
MAGLOC_END
