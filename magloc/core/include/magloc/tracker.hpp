// A magnet followed by up to eight vector magnetometers, one row of readings at a time, without heap or library.
//
//     magloc::Tracker<4> tracker;
//     tracker.start(config);
//     if (tracker.update(time_s, readings_T) == magloc::TrackerStatus::ok) use(tracker.estimate());
//
// The steps are those of magloc.Tracker: the same chart, iterated update and gate. It starts in a region that is given,
// as eight Gaussians; Gaussians are not divided later, and rows are not fitted together. The array is at rest, the
// field that all sensors share is unknown in every row, and readings are calibrated, in the array's axes. A tracker is
// a plain struct: its bytes are its state, and a copy of them resumes bit for bit.
#pragma once
#include "row_filter.hpp"

MAGLOC_BEGIN
template <int n_sensors>
struct TrackerConfig {
  double position_m[n_sensors][3];
  double noise_T;                 // of each reading
  double lower_m[3], upper_m[3];  // region in which a track starts; the array may be within it
  double moment_Am2;              // sigma of each component of the moment, at the start
  double speed_m_s, turn_rad_s;   // of the source, along and about each axis
};

enum class TrackerStatus : int32_t {
  ok,
  bad_time,      // changes nothing, as the next one
  bad_readings,  // infinite, or beyond 1 T
  no_signal,     // nothing stands out of the noise, and nothing is tracked
  no_readings,   // of three sensors: the track goes on without them
  no_source,     // no dipole in the region explains the readings
  contradicts,   // the readings are not used
  lost           // after the third contradiction
};

struct TrackerEstimate {
  double position_m[3], moment_Am2[3];  // NaN without a track
  double covariance[6][6];              // of both
  double nis;                           // of the row; NaN without readings
  int components;                       // of the mixture of Gaussians; 0 without a track
};

template <int n_sensors>
class Tracker {
  static_assert(n_sensors >= 3 && n_sensors <= 8, "three to eight sensors");
  static constexpr int n = n_sensors, n_channels = 3 * n, most_readings = 3 * (n - 1), N = n_measured, most = 8,
                       power = 4;
  static constexpr double firm = 0.2, least_share = 0.02, largest_growth = 1.5, alike = 0.5, unlikely = -14.0;
  static constexpr double largest_time = 1e14;
  static constexpr int most_contradictions = 3;

 public:
  static constexpr uint32_t version = 1;  // of the state's bytes
  // Doubles of the working memory, which holds nothing between rows.
  static constexpr int64_t memory_size = 1031 + 213 * (n - 3) + 9 * (n - 3) * (n - 3);

  void start(const TrackerConfig<n> &config) {
    __builtin_memset(static_cast<void *>(this), 0, sizeof *this);
    config_ = config;
    for (int c = 0; c < n_channels; ++c) sensor_[c] = c / 3, gain_[c][c % 3] = 1.0;
    for (int i = 0; i < 3; ++i) {
      rotation_[i][i] = 1.0;
      for (int s = 0; s < n; ++s) centroid_[i] += config.position_m[s][i] / n;
    }
    for (int s = 0; s < n; ++s) {
      double square = 0.0;
      for (int i = 0; i < 3; ++i) {
        const double away = config.position_m[s][i] - centroid_[i];
        square += away * away;
      }
      radius_ = maximum(radius_, square_root(square));
    }
    forget();
  }

  const TrackerEstimate &estimate() const { return estimate_; }
  double time_s() const { return time_; }

  // Take the readings of a time, in T; a sensor with NaN has none.
  TrackerStatus update(double time_s, const double (&readings_T)[n][3]) {
    if (!(time_s >= -largest_time && time_s <= largest_time) || (is_begun_ && !(time_s > time_)))
      return TrackerStatus::bad_time;
    bool has[n];
    int count = 0;
    for (int s = 0; s < n; ++s) {
      has[s] = true;
      for (double reading : readings_T[s]) {
        has[s] = has[s] && reading == reading;
        if (__builtin_fabs(reading) > 1.0) return TrackerStatus::bad_readings;
      }
      count += has[s];
    }
    const double dt = is_begun_ ? time_s - time_ : 0.0;
    is_begun_ = true, time_ = time_s;
    set_readings(readings_T, has);
    count = count >= 3 ? 3 * (count - 1) : 0;
    const bool is_new = n_components_ == 0;
    if (is_new) {
      double square = 0.0;
      for (double z : readings_) square += z * z;
      if (count == 0 || !(square > nis_limit(count)))
        return count == 0 ? TrackerStatus::no_readings : TrackerStatus::no_signal;
    }
    return follow(dt, count, is_new);
  }

 private:
  TrackerConfig<n> config_;
  TrackerEstimate estimate_;
  bool is_begun_;
  double time_, centroid_[3], radius_;
  int n_components_, n_contradictions_;
  // The root of the covariance in the chart about the mean, by rows of a lower triangle.
  struct Component {
    double x[N], lower[N * (N + 1) / 2], log_weight;
  } components_[most], updated_[most];
  int64_t sensor_[n_channels];
  uint8_t is_modulus_[n_channels];
  double gain_[n_channels][3], rotation_[3][3], nothing_[n][3];
  double readings_[most_readings], transform_[most_readings][n_channels];
  double memory_[memory_size];

  // The value that a good row exceeds once in a million, of 6, 9, ... readings.
  static double nis_limit(int count) {
    constexpr double limits[] = {38.25833637720969, 44.81093787068782,  50.825252138874454,
                                 56.49344249977338, 61.914226716255804, 67.14650873247304};
    return limits[count / 3 - 2];
  }

  void forget() {
    n_components_ = n_contradictions_ = 0;
    for (double &x : estimate_.position_m) x = nan;
    for (double &x : estimate_.moment_Am2) x = nan;
    for (auto &row : estimate_.covariance)
      for (double &x : row) x = nan;
    estimate_.nis = nan, estimate_.components = 0;
  }

  // Differences of the sensors that have readings, of unit noise and without their common field: of each sensor and the
  // mean of those before it.
  void set_readings(const double (&readings_T)[n][3], const bool (&has)[n]) {
    __builtin_memset(transform_, 0, sizeof transform_);
    int before = 0, j = 0;
    for (int s = 0; s < n; ++s) {
      if (!has[s]) continue;
      const double scale = 1.0 / (config_.noise_T * square_root(before * (before + 1.0)));
      for (int i = 0; before > 0 && i < 3; ++i, ++j)
        for (int other = 0; other <= s; ++other)
          if (has[other]) transform_[j][3 * other + i] = (other < s ? 1.0 : -before) * scale;
      ++before;
    }
    for (int r = 0; r < most_readings; ++r) {
      readings_[r] = 0.0;
      for (int c = 0; c < n_channels; ++c)
        if (transform_[r][c] != 0.0) readings_[r] += transform_[r][c] * readings_T[c / 3][c % 3];
    }
  }

  // A Gaussian in each octant of the region, in the chart about its centre.
  void begin(RowFilter<double> &filter) {
    n_components_ = most;
    for (int k = 0; k < most; ++k) {
      Component &one = components_[k];
      filter.root.clear(N);
      one.log_weight = 0.0;
      for (int i = 0; i < 3; ++i) {
        const double width = 0.5 * (config_.upper_m[i] - config_.lower_m[i]);
        one.x[i] = config_.lower_m[i] + ((k >> i & 1) + 0.5) * width, one.x[3 + i] = 0.0;
        filter.root[i][i] = width * 0.28867513459481287;  // of a uniform distribution
        filter.root[3 + i][3 + i] = config_.moment_Am2;
      }
      SourceChart(one.x, N, power, centroid_, radius_)
          .to_coordinates(filter.root.lanes(0), (double *)nullptr, filter.root.width());
      __builtin_memcpy(filter.x, one.x, sizeof one.x);
      store(filter, one);
    }
  }

  static void load(RowFilter<double> &filter, const Component &one) {
    __builtin_memcpy(filter.x, one.x, sizeof one.x);
    filter.root.clear(N);
    for (int i = 0, next = 0; i < N; ++i)
      for (int j = 0; j <= i; ++j) filter.root[i][j] = one.lower[next++];
  }
  static void store(RowFilter<double> &filter, Component &one) {
    filter.lower_root();
    __builtin_memcpy(one.x, filter.x, sizeof one.x);
    for (int i = 0, next = 0; i < N; ++i)
      for (int j = 0; j <= i; ++j) one.lower[next++] = filter.root[i][j];
  }

  TrackerStatus follow(double dt, int count, bool is_new) {
    const int64_t zero = 0;
    magloc_rows rows = {};
    rows.n_sensors = n, rows.n_channels = n_channels, rows.n_readings = most_readings;
    rows.sensors = config_.position_m[0], rows.radius = radius_;
    __builtin_memcpy(rows.array_centroid, centroid_, sizeof centroid_);
    rows.sensor = sensor_, rows.gain = gain_[0], rows.is_modulus = is_modulus_, rows.readings = readings_;
    rows.transforms = transform_[0], rows.origins = rows.ambients = nothing_[0], rows.rotations = rotation_[0];
    rows.transform_of_row = rows.effect_of_row = rows.ambient_of_row = &zero;
    double F[N][N] = {}, A[N][N] = {}, B[N][N] = {};
    for (int i = 0; i < 3; ++i) {
      F[i][i] = F[3 + i][3 + i] = 1.0;
      A[i][i] = dt * config_.speed_m_s, B[3 + i][3 + i] = dt * config_.turn_rad_s;
    }
    magloc_motion steps = {};
    steps.n_noise = N, steps.F = F[0], steps.A = A[0], steps.B = B[0], steps.step_of_row = &zero;
    const magloc_sources sources = {1, N, 0, power, firm, nullptr, nullptr};
    Workspace space(memory_);
    RowFilter<double> filter(sources, rows, space);
    SourceMotion motion(steps, N, 0, space);
    const Padded<double> wide = filter.wide(motion, space);
    filter.set_row(0);
    if (is_new) begin(filter);
    double best = infinity, heaviest = -infinity, nis = nan;
    for (int k = 0; k < n_components_; ++k) {
      Component &one = components_[k], &after = updated_[k];
      load(filter, one);
      bool bends = !is_new && count == most_readings;
      if (!is_new) {
        double before[N];
        for (int i = 0; i < N; ++i) before[i] = filter.variance(i);
        filter.predict(motion, 0, 0, centroid_, wide);
        for (int i = 0; i < N; ++i) bends = bends && filter.variance(i) <= largest_growth * largest_growth * before[i];
        store(filter, one);
      }
      after = one, after.log_weight = -infinity;
      if (count == 0) continue;
      filter.update({1e-3, 0.25, 1e-9, 50}, bends, least_share);
      filter.finish_update();
      const double weight = one.log_weight + filter.log_evidence;
      if (!filter.converged || !(weight - weight == 0.0)) continue;
      store(filter, after);
      after.log_weight = weight;
      best = minimum(best, filter.nis);
      if (weight > heaviest) heaviest = weight, nis = filter.nis;
    }
    if (count > 0 && !(best <= nis_limit(count))) return refuse(filter, is_new);
    n_contradictions_ = 0;
    if (count > 0) keep_likely(heaviest);
    fill_estimate(filter, nis);
    return count > 0 ? TrackerStatus::ok : TrackerStatus::no_readings;
  }

  TrackerStatus refuse(RowFilter<double> &filter, bool is_new) {
    if (!is_new && ++n_contradictions_ < most_contradictions) {
      fill_estimate(filter, nan);
      return TrackerStatus::contradicts;
    }
    forget();
    return is_new ? TrackerStatus::no_source : TrackerStatus::lost;
  }

  // Keep the updated components but those that are unlikely, and of each group that is nearly one the heaviest.
  void keep_likely(double heaviest) {
    const int before = n_components_;
    n_components_ = 0;
    for (int k = 0; k < before; ++k) {
      Component &one = updated_[k];
      one.log_weight -= heaviest;
      if (!(one.log_weight > unlikely)) continue;
      int same = 0;
      while (same < n_components_ && !is_alike(components_[same], one)) ++same;
      if (same < n_components_) {
        const double weight = add_logarithms(components_[same].log_weight, one.log_weight);
        if (one.log_weight > components_[same].log_weight) components_[same] = one;
        components_[same].log_weight = weight;
      } else {
        components_[n_components_++] = one;
      }
    }
  }
  static double add_logarithms(double a, double b) {
    const double larger = maximum(a, b), smaller = minimum(a, b);
    return larger + logarithm(1.0 + exponential(smaller - larger));
  }
  // Whether a mean is within half a sigma of another one along each coordinate.
  bool is_alike(const Component &one, const Component &other) const {
    SourceChart chart(one.x, N, power, centroid_, radius_);
    double e[N];
    chart.fill_coordinates(other.x, e);
    for (int i = 0, next = 0; i < N; ++i) {
      double square = 0.0;
      for (int j = 0; j <= i; ++j, ++next) square += one.lower[next] * one.lower[next];
      if (!(e[i] * e[i] <= alike * alike * square)) return false;
    }
    return true;
  }

  // Mean and covariance of the mixture, the range of each component being log-normal.
  void fill_estimate(RowFilter<double> &filter, double nis) {
    double sum = 0.0, mean[N] = {}, (&covariance)[N][N] = estimate_.covariance;
    __builtin_memset(covariance, 0, sizeof covariance);
    for (int k = 0; k < n_components_; ++k) {
      const double zero[max_source_states] = {}, weight = exponential(components_[k].log_weight);
      load(filter, components_[k]);
      const SourceChart chart(filter.x, N, power, centroid_, radius_);
      ChartedState here;
      chart.move(zero, here);
      const double growth = exponential(0.5 * minimum(filter.variance(0), 1.0)) - 1.0;
      chart.to_state(here, filter.root.lanes(0), (double *)nullptr, filter.root.width());
      double x[N];
      for (int i = 0; i < N; ++i) x[i] = filter.x[i] + (i < 3 ? growth * here.position[i][0] : 0.0);
      // Moments of the components so far about their mean, and of this one: those about the mean of both.
      const double before = sum;
      sum += weight;
      for (int i = 0; i < N; ++i)
        for (int j = 0; j < N; ++j) {
          const double own = dot(filter.root.lanes(i), filter.root.lanes(j), filter.root.width());
          const double apart = before / sum * (x[i] - mean[i]) * (x[j] - mean[j]);
          covariance[i][j] = (before * covariance[i][j] + weight * (own + apart)) / sum;
        }
      for (int i = 0; i < N; ++i) mean[i] += weight / sum * (x[i] - mean[i]);
    }
    for (int i = 0; i < 3; ++i) estimate_.position_m[i] = mean[i], estimate_.moment_Am2[i] = mean[3 + i];
    estimate_.nis = nis, estimate_.components = n_components_;
  }
};
MAGLOC_END
