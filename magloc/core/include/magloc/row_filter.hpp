// What rows of readings tell of several sources: magloc/tracking/chart explains it for one source.
//
// A state has n_states numbers of each source and, behind them, errors of the array's pose and nuisances that are
// linear in the readings. Inside, what readings depend on comes first: what is seen - position and moment of each
// source, and the pose -, nuisances, then further numbers of each source. A prediction's root is lower triangular, so
// that the readings depend on the first d of the standard numbers zeta alone; coordinates are the root times zeta. Of
// far more nuisances than readings, reflections leave as many columns of the root that the row sees. Orthogonal steps
// keep what normal equations would lose where a nuisance is known 1e5 times less well than a reading.
#pragma once
#include "bent_prediction.hpp"
#include "row_readings.hpp"
#include "sensor_residuals.hpp"
#include "source_motion.hpp"

MAGLOC_BEGIN
template <class T>
class RowFilter {
  const magloc_sources &p_;
  const magloc_rows &given_;
  Workspace &space_;
  const int64_t K_ = p_.n_sources, ns_ = p_.n_states, n_pose_ = given_.n_pose, behind_ = p_.n_nuisances;
  const int64_t measured_ = n_measured * K_, seen_ = measured_ + n_pose_, e_ = behind_ - n_pose_;
  const int64_t h_ = 2 * e_ < 3 * given_.n_readings ? e_ : given_.n_readings, d_ = seen_ + h_;
  RowReadings<T> readings_{given_, K_, space_};
  const int64_t k_ = readings_.width();                        // registers that the readings fill
  SourceChart *const charts_ = space_.take<SourceChart>(K_);   // about the mean
  ChartedState *const there_ = space_.take<ChartedState>(K_);  // states of the sources at zeta

 public:
  const int64_t N = K_ * ns_ + behind_;              // length of a state
  double *const x = space_.take<double>(N);          // mean
  Padded<T> root{space_, N, N};                      // of the covariance in the charts about it, in the inner order
  Padded<T> transition{space_, K_ * ns_, ns_};       // of the coordinates of each source, in the last prediction
  double nis = nan, chi2 = nan, log_evidence = nan;  // of the last update
  int64_t iterations = 0;
  bool converged = false;

 private:
  // The linearised problem has a column for each zeta of nuisances, for each of what is seen, and for the misfit. Their
  // numbers are one for each reading, and one for each zeta, nuisances first.
  Padded<T> columns_{space_, d_ + 1, k_ * n_lanes<T> + d_}, triangle_{space_, N + 1, N + 1};
  Padded<T> turned_{space_, seen_, seen_}, rows_{space_, N, N}, solved_{space_, d_, N};
  Padded<T> by_nuisances_{space_, seen_ + e_, k_ * n_lanes<T>};  // of readings, by the columns of nuisances' root
  T *const misfit_ = space_.take<T>(k_), *const trial_misfit_ = space_.take<T>(k_);  // of the readings
  double *const e_there_ = space_.take<double>(N);                                   // coordinates at zeta
  double *const zeta_ = space_.take<double>(d_), *const trial_ = space_.take<double>(d_);
  double *const step_ = space_.take<double>(d_ + 1);  // nuisances first
  BentPrediction<T> bending_{k_, seen_, h_, space_};
  // Zeta, or where the prediction bends what is normal there; the same of trials.
  double *const standard_ = space_.take<double>(d_), *const trial_standard_ = space_.take<double>(d_);
  double *const pose_ = space_.take<double>(n_pose_);
  const double *lasts_ = nullptr;  // shares of errors of the pose with which the prediction bends

 public:
  RowFilter(const magloc_sources &p, const magloc_rows &rows, Workspace &space) : p_(p), given_(rows), space_(space) {}

  // Go to a row of readings.
  void set_row(int64_t row) { readings_.set_row(row); }
  void set_pose(int64_t row) { readings_.set_pose(row); }
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
    return {space, N, N + motion.n_noise * K_ + (motion.has_noisy_nuisances() ? behind_ : 0)};
  }
  // Predict all states after a step of the motion, which ends at the row; the sensors' centroid was elsewhere before.
  // `item` counts states whose steps differ.
  void predict(SourceMotion &motion, int64_t step, int64_t item, const double (&centroid_before)[3],
               const Padded<T> &wide) {
    spread(motion, step, item, centroid_before, wide);
    triangularise(wide, N, triangle_);
    set_lower();
  }
  // Predict means, and rows of a root that are wider than long. With a trajectory's state `to` the charts stand about
  // that, and offsets of what is expected from it, in the inner order, are predicted as well.
  void spread(SourceMotion &motion, int64_t step, int64_t item, const double (&centroid_before)[3],
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
      SourceChart after(state, ns_, p_.power, readings_.centroid, given_.radius);
      after.judge_moment(0.0, p_.firm);
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
    for (int64_t i = 0; i < behind_; ++i) {
      const double kept = motion.has_noisy_nuisances() ? motion.kept(step)[i] : 1.0;
      double &mean = x[K_ * ns_ + i];
      add_rows(wide.lanes(measured_ + i), {&kept}, root.from(measured_ + i), 1);
      mean *= kept;
      if (offset) {
        offset[measured_ + i] *= kept;
        if (i < n_pose_) {
          offset[measured_ + i] += mean - to[K_ * ns_ + i];
          mean = to[K_ * ns_ + i];
        }
      }
      if (motion.has_noisy_nuisances()) wide[measured_ + i][N + m * K_ + i] = motion.added(step)[i];
    }
  }

  // Update by the row: Gauss and Newton's steps, each halved until it lowers the cost enough. The prediction may bend
  // as readings do, along what they tell in more than a share of its sigma, errors of the pose by shares. Misfit and Q
  // at the prediction are stored where they are wanted.
  void update(const magloc_convergence &limits, bool bends = false, double least_share = 0.0,
              const double *pose_lasts = nullptr, double *misfit = nullptr, double *Q = nullptr) {
    begin_update();
    lasts_ = bends ? pose_lasts : nullptr;
    if (bends) {
      move_to(zeta_, lasts_);
      readings_.template predict<true>();
      fill_seen_columns();
      bending_.bend(readings_.values(), by_nuisances_.from(seen_), columns_, least_share, triangle_);
    }
    double length = 1.0, gain = 0.0, cost = misfit_at(zeta_, misfit_);
    bool is_stale = true;
    for (iterations = 0;; ++iterations) {
      if (is_stale) gain = linearise(), length = 1.0;
      if (Q && iterations == 0) store_linearisation(misfit, Q);
      converged = gain < limits.tolerance * limits.tolerance;
      if (converged || iterations >= limits.max_iterations) break;
      for (int64_t i = 0; i < d_; ++i) trial_[i] = zeta_[i] + length * step_[i < seen_ ? h_ + i : i - seen_];
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
    if (bends) log_evidence += bending_.log_determinant();
    for (int64_t i = 0; i < d_; ++i) log_evidence -= logarithm(triangle_[i][i]);
  }

  // After a linearisation: the misfit (n_readings), and Q (d, n_readings): of a covariance I + J J^T of readings, with
  // errors of the state as J makes of them, the inverse is I - Q^T Q.
  void store_linearisation(double *misfit, double *Q) const {
    __builtin_memcpy(misfit, misfit_, given_.n_readings * sizeof(double));
    columns_.store(Q, d_, given_.n_readings);
  }
  // After an update: see sensor_residuals.hpp.
  void fill_standardised(double followed, double *residuals) const {
    const ResidualScale scale{1.0 + followed, triangle_[d_][d_]};
    fill_sensor_residuals(given_, readings_.transform(), columns_, d_, k_, scale, residuals);
  }

  // After an update: the innovation (n_readings) freed of correlations, L^-1 nu with the lower root L of its
  // covariance: each reading less what the ones before it tell of it, in its standard deviations. Return the square by
  // which the readings move the prediction, in its standard deviations, less its mean, the trace of the gain.
  double fill_innovation(double *innovation) {
    move_to(zeta_);
    readings_.template predict<true>();
    fill_nuisance_columns();
    fill_source_columns();
    bending_.straighten(columns_);
    solved_.clear(d_);  // root of the standard numbers' covariance after the readings so far, whose means are trial_
    for (int64_t i = 0; i < d_; ++i) solved_[i][i] = 1.0, trial_[i] = -tail(d_)[i];
    T *const told = rows_.lanes(0);
    const int64_t width = solved_.width();
    for (int64_t i = 0; i < given_.n_readings; ++i) {
      const Strided slope = columns_.column(i);
      set_rows(told, slope, solved_, d_);
      const double square = dot(told, told, width), sigma = square_root(1.0 + square), length = square_root(square);
      double rest = reinterpret_cast<const double *>(misfit_)[i];
      for (int64_t c = 0; c < d_; ++c) rest += slope.first[c * slope.step] * trial_[c];
      innovation[i] = rest / sigma;
      scale(told, length > 0.0 ? 1.0 / length : 0.0, width);
      int64_t c = 0;
      for (; c + 4 <= d_; c += 4) project<4>(told, solved_.lanes(c), width, step_ + c, 1.0 - 1.0 / sigma);
      for (; c < d_; ++c) project<1>(told, solved_.lanes(c), width, step_ + c, 1.0 - 1.0 / sigma);
      for (c = 0; c < d_; ++c) trial_[c] -= step_[c] * length * rest / (sigma * sigma);
    }
    double correction = nis - chi2 - d_;
    for (int64_t c = 0; c < d_; ++c) correction += dot(solved_.lanes(c), solved_.lanes(c), solved_.width());
    return correction;
  }

  // Let mean and root be those after the update, the root in the charts about the new mean.
  void finish_update() {
    move_to(zeta_);
    for (int64_t i = seen_; bending_.bends && i < seen_ + e_; ++i) {
      e_there_[i] = 0.0;
      for (int64_t c = 0; c < d_; ++c) e_there_[i] += root[i][c] * (c < seen_ ? standard_ : zeta_)[c];
      bending_.bend_row(root[i], trial_);
    }
    condition_root();
    for (int64_t k = 0; k < K_; ++k) {
      charts_[k].to_state(there_[k], root.lanes(n_measured * k), further(root, k), root.width());
      __builtin_memcpy(x + ns_ * k, there_[k].x, ns_ * sizeof(double));
      set_chart(k);
      charts_[k].to_coordinates(root.lanes(n_measured * k), further(root, k), root.width());
    }
    for (int64_t i = 0; i < behind_; ++i) x[K_ * ns_ + i] += e_there_[measured_ + i];
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

  // Fill derivatives of the readings (d, n_readings) by coordinates about the mean, where the root is one, and the
  // misfit of readings at offsets from there (N) that are expected.
  void fill_slopes(const Padded<T> &slopes, const double *offset, double *misfit) {
    for (int64_t k = 0; k < K_; ++k) set_chart(k);
    for (int64_t i = 0; i < N; ++i) e_there_[i] = 0.0;
    place(1.0);
    readings_.template predict<true>();
    fill_seen_columns();
    for (int64_t c = 0; c < seen_ + e_; ++c)
      __builtin_memcpy(slopes.lanes(c), c < seen_ ? columns_.lanes(h_ + c) : readings_.effect.lanes(c - seen_),
                       k_ * sizeof(T));
    for (int64_t r = 0; r < k_; ++r) misfit_[r] = readings_.measured.lanes(0)[r] - readings_.values()[r];
    add_rows(misfit_, {offset, 1, -1.0}, slopes, seen_ + e_);
    __builtin_memcpy(misfit, misfit_, given_.n_readings * sizeof(double));
  }

  // How far readings bend along axes (6 K) of what is not known of the sources, and one sigma of the whole state
  // (6 K, N) along each: magloc/tracking/chart/split.py.
  void fill_bends(double memory, double *bends, double *directions) {
    T *const here = misfit_, *const ahead = trial_misfit_, *const behind = columns_.lanes(d_);
    begin_update();
    move_to(zeta_);
    readings_.template predict<true>();
    fill_nuisance_columns();
    fill_source_columns();
    __builtin_memcpy(here, readings_.values(), k_ * sizeof(T));
    // The numbers behind the sources' columns become right singular vectors.
    make_orthogonal(columns_, h_, h_ + measured_, k_);
    for (int64_t a = 0; a < measured_; ++a, ++bends, directions += N) {
      for (int64_t j = 0; j < measured_; ++j) zeta_[j] = tail(h_ + a)[h_ + j];
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
    if (i >= K_ * ns_) return measured_ + i - K_ * ns_;
    const int64_t k = i / ns_, j = i % ns_;
    return j < n_measured ? n_measured * k + j : seen_ + e_ + (ns_ - n_measured) * k + j - n_measured;
  }

 private:
  // Which standard number a column of the linearised problem belongs to.
  int64_t zeta_of(int64_t column) const { return column < h_ ? seen_ + column : column - h_; }
  T *further(const Padded<T> &rows, int64_t k) const { return rows.lanes(seen_ + e_ + (ns_ - n_measured) * k); }
  double *tail(int64_t column) const { return reinterpret_cast<double *>(columns_.lanes(column) + k_); }

  void set_chart(int64_t k) {
    charts_[k] = SourceChart(x + ns_ * k, ns_, p_.power, readings_.centroid, given_.radius);
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
    lasts_ = nullptr;
    lower_root();
    for (int64_t k = 0; k < K_; ++k) set_chart(k);
    for (int64_t i = 0; i < d_; ++i) zeta_[i] = 0.0;
    columns_.clear(d_ + 1);
    for (int64_t c = 0; e_ > 0 && c < seen_ + e_; ++c)
      set_rows(by_nuisances_.lanes(c), root.from(seen_).column(c), readings_.effect, e_);
    if (h_ < e_) gather(by_nuisances_.from(seen_), h_, e_, root.from(seen_), N - seen_, seen_, rows_);
    fill_nuisance_columns();
    triangularise(columns_, h_, triangle_);
  }

  // The states at standard numbers, where errors of the pose have shares of their effect, or all of it.
  void move_to(const double *zeta, const double *shares = nullptr) {
    fill_coordinates(zeta);
    place(1.0, shares);
  }
  void fill_coordinates(const double *zeta) {
    for (int64_t i = 0; i < N; ++i) {
      e_there_[i] = 0.0;
      for (int64_t j = 0; j < d_ && (j <= i || i >= seen_); ++j) e_there_[i] += root[i][j] * zeta[j];
    }
  }
  void place(double sign, const double *shares = nullptr) {
    for (int64_t q = 0; q < n_pose_; ++q) pose_[q] = x[K_ * ns_ + q] + sign * e_there_[measured_ + q];
    if (n_pose_ > 0) readings_.set_pose(pose_, shares);
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
    move_to(zeta, lasts_);
    if (lasts_) {
      readings_.template predict<false>();
      bending_.fill_standard(zeta, readings_.values(), trial_standard_);
      place(1.0);
    }
    readings_.template predict<true>();
    if (!lasts_) bending_.fill_standard(zeta, readings_.values(), trial_standard_);
    for (int64_t r = 0; r < k_; ++r) misfit[r] = readings_.measured.lanes(0)[r] - readings_.values()[r];
    add_rows(misfit, {x + N - e_, 1, -1.0}, readings_.effect, e_);
    if (e_ > 0) add_rows(misfit, {trial_standard_, 1, -1.0}, by_nuisances_, seen_);
    add_rows(misfit, {zeta + seen_, 1, -1.0}, by_nuisances_.from(seen_), h_);
    double cost = dot(misfit, misfit, k_);
    for (int64_t i = 0; i < d_; ++i) cost += trial_standard_[i] * trial_standard_[i];
    return cost;
  }

  void fill_nuisance_columns() {
    columns_.clear(h_);
    for (int64_t c = 0; c < h_; ++c) {
      __builtin_memcpy(columns_.lanes(c), by_nuisances_.lanes(seen_ + c), k_ * sizeof(T));
      tail(c)[c] = 1.0;
    }
  }
  // Columns of what is seen, without nuisances, where the readings were predicted last.
  void fill_seen_columns() {
    for (int64_t i = 0; i < seen_; ++i) __builtin_memcpy(turned_[i], root[i], seen_ * sizeof(double));
    for (int64_t k = 0; k < K_; ++k) {
      T *const rows = turned_.lanes(n_measured * k);
      charts_[k].to_state(there_[k], rows, (T *)nullptr, turned_.width());
      readings_.to_array(rows, turned_.width());
    }
    for (int64_t j = 0; j < seen_; ++j) {
      const int64_t first = j < measured_ ? j - j % n_measured : j;  // what stands before does not depend on this zeta
      T *const column = columns_.lanes(h_ + j);
      for (int64_t r = 0; r < columns_.width(); ++r) column[r] = T{};
      add_rows(column, turned_.from(first).column(j), readings_.slopes().from(first), seen_ - first);
    }
  }
  // Columns of what is seen, and the misfit, where the readings were predicted last.
  void fill_source_columns() {
    if (lasts_) {
      place(1.0, lasts_);
      readings_.template predict<true>();
    }
    bending_.fill_standard(zeta_, readings_.values(), standard_);
    fill_seen_columns();
    bending_.fill_derivatives(columns_);
    if (lasts_) {
      place(1.0);
      readings_.template predict<true>();
      fill_seen_columns();
    }
    bending_.append_derivatives(columns_);
    for (int64_t j = h_; e_ > 0 && j < d_; ++j) add_rows(columns_.lanes(j), {tail(j) + h_}, by_nuisances_, seen_);
    __builtin_memcpy(columns_.lanes(d_), misfit_, k_ * sizeof(T));
    for (int64_t c = 0; c < d_; ++c) tail(d_)[c] = -standard_[zeta_of(c)];
  }

  // Find the step to the least cost of the linearised problem. Return by how much it is less.
  double linearise() {
    fill_source_columns();
    triangularise(columns_, d_ + 1, triangle_, h_);
    double gain = 0.0;
    for (int64_t c = 0; c < d_; ++c) {
      step_[c] = triangle_[c][d_];
      gain += step_[c] * step_[c];
    }
    solve(triangle_, d_, step_);
    return gain;
  }
};
MAGLOC_END
