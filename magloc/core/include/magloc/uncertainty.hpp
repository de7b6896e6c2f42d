// How certain fits of one source by vector sensors are: covariances, weights of the solutions, and sets of ranges.
#pragma once
#include "range_profile.hpp"

MAGLOC_BEGIN
// Fits side by side, one in each lane. State: position u/s in radii and moment at s = 1.
template <class T, class Channels>
class Fits {
  static constexpr int n_squarings = 10;
  const magloc_source_uncertainty &p_;
  Channels channels_;
  T *const columns_, *const nothing_;
  T position_[3], moment_[3];

 public:
  Fits(const magloc_source_uncertainty &p, Workspace &room)
      : p_(p),
        channels_(*p.channels, p.signals, room),
        columns_(room.take<T>(6 * p.channels->n_channels)),
        nothing_(room.take<T>(p.channels->n_channels)) {}

  // Inverse information of n fits (NaN where it is singular), by orthogonal columns of the Jacobian: those of the
  // moment first. The logarithm of the information's determinant goes into (n,).
  void fill_covariances(const int64_t *fit, int64_t n, double *log_information) {
    for (int64_t first = 0; first < n; first += n_lanes<T>) {
      load(fit + first, n - first);
      for (int64_t s = 0; s < channels_.n_sensors; ++s) {
        const Ray<T> ray = ray_to(s, position_);
        T *const rows = columns_ + 6 * channels_.first(s), f[3][3];
        field_matrix(ray, f);
        channels_.template read<6>(s, f, rows);
        gradient(ray, moment_, f);
        for (T(&row)[3] : f)
          for (T &x : row) x = -x;
        channels_.template read<6>(s, f, rows + 3);
      }
      project<6>();
      for (int64_t c = 0; c < channels_.n_channels; ++c) nothing_[c] = T{};
      const Orthogonalisation<T, 6> orthogonal(columns_, nothing_, channels_.n_channels, 1e-26);
      T inverse[6][6];
      orthogonal.fill_inverse_squares(inverse);
      for (int i = 0; i < n_lanes<T> && first + i < n; ++i) {
        double *covariance = p_.covariance + 36 * fit[first + i], log_determinant = 0.0;
        for (int j = 0; j < 6; ++j) log_determinant -= logarithm(get_lane(orthogonal.inverse[j], i));
        log_information[first + i] = log_determinant;
        for (int j = 0; j < 6; ++j)
          for (int k = 0; k <= j; ++k) {
            const int to_j = (j + 3) % 6, to_k = (k + 3) % 6;
            covariance[6 * to_j + to_k] = covariance[6 * to_k + to_j] = get_lane(inverse[j][k], i);
          }
      }
    }
  }

  // Whether errors of n fits are Gaussian: chi-square rises by one, give or take `largest_bend`, at one standard
  // deviation along the longest axis, to either side. Lengths count in units of range and moment. Repeated squares of
  // the covariance turn all its columns to that axis.
  void judge(const int64_t *fit, int64_t n) {
    for (int64_t first = 0; first < n; first += n_lanes<T>) {
      T rise[2];
      fill_rises(fit + first, n - first, rise);
      for (int i = 0; i < n_lanes<T> && first + i < n; ++i) {
        const double bend = maximum(__builtin_fabs(get_lane(rise[0], i) - p_.chi2[fit[first + i]] - 1.0),
                                    __builtin_fabs(get_lane(rise[1], i) - p_.chi2[fit[first + i]] - 1.0));
        p_.gaussian[fit[first + i]] = bend <= p_.largest_bend;
      }
    }
  }

 private:
  // Chi-square at the two places.
  void fill_rises(const int64_t *fit, int64_t n, T (&chi2)[2]) {
    load(fit, n);
    T unit[6], relative[6][6], power[6][6], square[6][6], axis[6] = {}, size2 = {}, variance = {}, largest = {};
    for (int j = 0; j < 6; ++j) unit[j] = square_root(j < 3 ? dot(position_, position_) : dot(moment_, moment_));
    for (int j = 0; j < 6; ++j)
      for (int k = 0; k < 6; ++k) {
        T x = {};
        for (int i = 0; i < n_lanes<T>; ++i) set_lane(x, i, p_.covariance[36 * fit[i < n ? i : n - 1] + 6 * j + k]);
        power[j][k] = relative[j][k] = x / (unit[j] * unit[k]);
      }
    for (int n = 0; n < n_squarings; ++n) {
      T trace = {};
      for (int j = 0; j < 6; ++j) trace += power[j][j];
      const T scale = 1.0 / (trace * trace);
      for (int j = 0; j < 6; ++j)
        for (int k = 0; k <= j; ++k) {
          T sum = {};
          for (int i = 0; i < 6; ++i) sum += power[j][i] * power[k][i];
          square[j][k] = square[k][j] = scale * sum;
        }
      __builtin_memcpy(power, square, sizeof power);
    }
    for (int j = 0; j < 6; ++j) {
      const auto larger = power[j][j] > largest;
      largest = choose(larger, power[j][j], largest);
      for (int k = 0; k < 6; ++k) axis[k] = choose(larger, power[k][j], axis[k]);
    }
    for (int j = 0; j < 6; ++j) {
      size2 += axis[j] * axis[j];
      for (int k = 0; k < 6; ++k) variance += axis[j] * relative[j][k] * axis[k];
    }
    const T sigma = square_root(variance) / size2;
    T step[2][3], sides[2][2][3];
    for (int a = 0; a < 3; ++a) {
      step[0][a] = sigma * unit[a] * axis[a], step[1][a] = sigma * unit[3 + a] * axis[3 + a];
      for (int side = 0; side < 2; ++side) {
        sides[side][0][a] = position_[a] + (side ? step[0][a] : -step[0][a]);
        sides[side][1][a] = moment_[a] + (side ? step[1][a] : -step[1][a]);
      }
    }
    for (int64_t s = 0; s < channels_.n_sensors; ++s) {
      T f[3][3] = {};
      for (int side = 0; side < 2; ++side) {
        T b[3];
        field(ray_to(s, sides[side][0]), sides[side][1], b);
        for (int a = 0; a < 3; ++a) f[a][side] = b[a];
      }
      channels_.template read<3>(s, f, columns_ + 3 * channels_.first(s));
    }
    project<3>();
    chi2[0] = chi2[1] = T{};
    for (int64_t c = 0; c < channels_.n_channels; ++c)
      for (int side = 0; side < 2; ++side) {
        const T rest = channels_.y[c] - columns_[3 * c + side];
        chi2[side] += rest * rest;
      }
  }

  // The last fit is repeated in the lanes that are left.
  void load(const int64_t *fit, int64_t n) {
    for (int i = 0; i < n_lanes<T>; ++i) {
      const int64_t k = fit[i < n ? i : n - 1];
      const double *q = p_.q + 4 * k, *mu = p_.mu + 3 * k, s = __builtin_fabs(q[3]);
      channels_.load(i, p_.row[k]);
      for (int a = 0; a < 3; ++a) set_lane(position_[a], i, q[a] / q[3]), set_lane(moment_[a], i, mu[a] / (s * s * s));
    }
  }
  Ray<T> ray_to(int64_t sensor, const T (&position)[3]) const {
    T v[3];
    for (int a = 0; a < 3; ++a) v[a] = channels_.sensors[3 * sensor + a] - position[a];
    return Ray<T>::from(v);
  }
  template <int D>
  void project() {
    for (int64_t i = channels_.first(channels_.n_sensors) * D; i < channels_.n_channels * D; ++i) columns_[i] = T{};
    channels_.template project<D>(columns_);
  }
};

// All that is known of the fits of rows. Readable reference: magloc/localization/uncertainty/covariance.py.
template <class T, class Channels>
class Uncertainty {
  static constexpr int64_t rows_together = 64;
  static constexpr int n_bisections = 24;

  const magloc_source_uncertainty &p_;
  const int64_t n_fits_;
  Fits<T, Channels> fits_;
  RangeProfiles<T, Channels> profiles_;
  int64_t *const fit_;
  double *const log_volume_, *const rise_, *const step_, *const angles_;

 public:
  Uncertainty(const magloc_source_uncertainty &p, Workspace &room)
      : p_(p),
        n_fits_(rows_together * p.most_fits),
        fits_(p, room),
        profiles_(p, n_fits_, room),
        fit_(room.take<int64_t>(n_fits_)),
        log_volume_(room.take<double>(n_fits_)),
        rise_(room.take<double>(n_fits_)),
        step_(room.take<double>(n_fits_)),
        angles_(room.take<double>(2 * n_fits_)) {}

  void run(int64_t begin, int64_t end) {
    for (int64_t row = begin; row < end; row += rows_together)
      run_together(row, end - row < rows_together ? end : row + rows_together);
  }

 private:
  void run_together(int64_t begin, int64_t end) {
    const int64_t first = p_.first_fit[begin], n = p_.first_fit[end] - first;
    for (int64_t i = 0; i < n; ++i) fit_[i] = first + i;
    fits_.fill_covariances(fit_, n, log_volume_);
    for (int64_t row = begin; row < end; ++row) weigh_row(row, first);
    profiles_.run(first, n, rise_, step_, angles_);
    int64_t n_claimed = 0;
    for (int64_t row = begin; row < end; ++row) n_claimed = fill_ranges(row, first, n_claimed);
    fits_.judge(fit_, n_claimed);
  }

  // Covariances, weights, and how far the profiles of a row's fits may rise. In arrays of these rows fits count from
  // `offset` on.
  void weigh_row(int64_t row, int64_t offset) {
    const int64_t first = p_.first_fit[row], last = p_.first_fit[row + 1];
    if (last == first) return;
    const double best = p_.chi2[first];
    // Noise is understated if chi-square is a misfit's.
    const double variance = best > p_.misfit && best < infinity ? best / maximum(p_.dof, 1.0) : 1.0;
    for (int64_t k = first; k < last; ++k) {
      double *covariance = p_.covariance + 36 * k;
      for (int i = 0; i < 36; ++i) covariance[i] *= variance;
      const double *q = p_.q + 4 * k, *mu = p_.mu + 3 * k, s2 = q[3] * q[3];
      const double square = q[0] * q[0] + q[1] * q[1] + q[2] * q[2];
      const double moment2 = (mu[0] * mu[0] + mu[1] * mu[1] + mu[2] * mu[2]) / (s2 * s2 * s2), rho2 = square / s2;
      double along = 0.0;
      for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) along += q[i] * covariance[6 * i + j] * q[j] / s2;
      // Prior of the solution: range and moment are uniform by their logarithms, the range by one at most.
      log_volume_[k - offset] = -0.5 * log_volume_[k - offset] + 3.0 * logarithm(variance) -
                                1.5 * logarithm(rho2 * moment2) - 0.5 * logarithm(maximum(along / (rho2 * rho2), 1.0));
      step_[k - offset] = square_root(maximum(along, 0.0) / rho2) / (1.0 + rho2);
    }
    const double level = weigh(first, last, log_volume_ + first - offset, variance);
    const double rise = variance * allowed_rise(p_.energy[row] / variance, best / variance, level);
    for (int64_t k = first; k < last; ++k) {
      rise_[k - offset] = rise - (p_.chi2[k] - best);
      const double step = square_root(rise_[k - offset]) * step_[k - offset];
      step_[k - offset] = !(step < infinity) ? 0.05 : step < 1e-9 ? 1e-9 : step < 0.2 ? step : 0.2;
    }
  }

  // Weights of solutions; the rise above the best one within which 95 % of all of them are.
  double weigh(int64_t first, int64_t last, const double *log_volume, double variance) {
    double best = -infinity, lowest = infinity, total = 0.0, highest = 0.0;
    int64_t n_likely = 0;
    for (int64_t k = first; k < last; ++k) {
      if (!(__builtin_fabs(log_volume[k - first]) < infinity)) continue;
      best = maximum(best, log_volume[k - first] - 0.5 * p_.chi2[k] / variance);
      lowest = p_.chi2[k] < lowest ? p_.chi2[k] : lowest;
    }
    for (int64_t k = first; k < last; ++k) {
      const double value = log_volume[k - first] - 0.5 * p_.chi2[k] / variance - best;
      p_.weight[k] = __builtin_fabs(log_volume[k - first]) < infinity ? exponential(value) : 0.0;
      total += p_.weight[k];
      n_likely += p_.weight[k] > 0.0;
    }
    for (int64_t k = first; k < last; ++k) {
      p_.weight[k] /= maximum(total, 1e-300);
      if (p_.weight[k] > 0.0) highest = maximum(highest, (p_.chi2[k] - lowest) / variance);
    }
    double low = p_.level, high = p_.level + highest;
    for (int i = 0; i < n_bisections && n_likely > 1; ++i) {
      const double middle = 0.5 * (low + high);
      double outside = 0.0;
      for (int64_t k = first; k < last; ++k)
        if (p_.weight[k] > 0.0) {
          const double left = middle - (p_.chi2[k] - lowest) / variance;
          outside += p_.weight[k] * complementary_error(square_root(0.5 * maximum(left, 0.0)));
        }
      (outside > p_.outside ? low : high) = middle;
    }
    return n_likely > 1 ? high : p_.level;
  }

  // Infinite where nothing is detected, more than the level for weak signals.
  double allowed_rise(double energy, double chi2, double level) const {
    if (!(energy > p_.detected)) return infinity;
    const double explained = maximum(energy - chi2, 0.0), strength = square_root(explained);
    if (strength > p_.strengths[p_.n_strengths - 1]) return level;
    const double gained = interpolate(strength, p_.strengths, p_.gained) - level;
    const double weakest = interpolate(gained, p_.gained, p_.strengths);
    return maximum(explained - weakest * weakest, level);
  }
  // Value at x of ys at ascending xs; beyond their ends as at these.
  double interpolate(double x, const double *xs, const double *ys) const {
    int64_t low = 0, high = p_.n_strengths - 1;
    if (!(x > xs[low])) return ys[low];
    if (x >= xs[high]) return ys[high];
    while (high - low > 1) {
      const int64_t middle = (low + high) / 2;
      (xs[middle] <= x ? low : high) = middle;
    }
    return ys[low] + (x - xs[low]) / (xs[high] - xs[low]) * (ys[high] - ys[low]);
  }

  // Ranges of a row's fits; lists those that may be Gaussian behind n_claimed others, and widens the covariances if the
  // range is not observable.
  int64_t fill_ranges(int64_t row, int64_t offset, int64_t n_claimed) {
    const int64_t first = p_.first_fit[row], last = p_.first_fit[row + 1];
    if (last == first) return n_claimed;
    Ranges ranges{p_.ranges + 2 * p_.most_fits * first, p_.most_fits, 1};
    if (rise_[first - offset] < infinity) {
      ranges.unite(angles_ + 2 * (first - offset), last - first);
    } else {
      for (int64_t i = 0; i < 2 * p_.most_fits; ++i) ranges.ends[i] = nan;
      ranges.ends[0] = 0.0, ranges.ends[1] = infinity;
    }
    const double low = ranges.ends[0], high = ranges.ends[2 * (ranges.count > 0 ? ranges.count : 1) - 1];
    const bool observable = low > 0.0 && high <= 2.0 * low;
    for (int64_t k = first; k < last; ++k) {
      p_.gaussian[k] = 0;
      if (!observable)
        widen(k, low, high);
      else if (ranges.count == 1 && p_.weight[k] >= p_.certain_weight && p_.chi2[k] <= p_.misfit && is_sharp(k))
        fit_[n_claimed++] = k;
      for (int64_t i = 0; k > first && i < 2 * p_.most_fits; ++i) p_.ranges[2 * p_.most_fits * k + i] = ranges.ends[i];
    }
    return n_claimed;
  }

  // Whether the standard deviations of position and moment are small fractions of range and moment.
  bool is_sharp(int64_t k) const {
    const double *q = p_.q + 4 * k, *mu = p_.mu + 3 * k, *c = p_.covariance + 36 * k, s2 = q[3] * q[3];
    const double rho2 = (q[0] * q[0] + q[1] * q[1] + q[2] * q[2]) / s2;
    const double moment2 = (mu[0] * mu[0] + mu[1] * mu[1] + mu[2] * mu[2]) / (s2 * s2 * s2);
    const double largest = p_.largest_sigma * p_.largest_sigma;
    return c[0] + c[7] + c[14] <= largest * rho2 && c[21] + c[28] + c[35] <= largest * moment2;
  }

  // Add variance along the range until the 95 % interval reaches the farther end of the set; if that is open, until
  // sigma of the range is the range. The state follows the range along C e/(e^T C e), with e its gradient.
  void widen(int64_t k, double low, double high) {
    const double *q = p_.q + 4 * k;
    double *covariance = p_.covariance + 36 * k, following[6], variance = 0.0;
    const double length = square_root(q[0] * q[0] + q[1] * q[1] + q[2] * q[2]);
    const double sign = (q[3] < 0.0 ? -1.0 : 1.0) / length, distance = length / __builtin_fabs(q[3]);
    for (int i = 0; i < 6; ++i) {
      const double *c = covariance + 6 * i;
      following[i] = sign * (c[0] * q[0] + c[1] * q[1] + c[2] * q[2]);
      if (i < 3) variance += following[i] * sign * q[i];
    }
    const double farther2 = maximum(distance - low, high - distance) * maximum(distance - low, high - distance);
    const double wanted = farther2 < infinity ? farther2 / p_.level : distance * distance;
    const double missing = maximum(wanted - variance, 0.0) / (variance * variance);
    if (!(missing < infinity)) return;
    for (int i = 0; i < 6; ++i)
      for (int j = 0; j < 6; ++j) covariance[6 * i + j] += missing * following[i] * following[j];
  }
};
MAGLOC_END
