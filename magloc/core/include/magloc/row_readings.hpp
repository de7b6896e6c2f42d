// Readings of a row of an array, in units of their noise, as they are predicted for several sources.
#pragma once
#include "dipole.hpp"
#include "padded.hpp"

MAGLOC_BEGIN
template <class T>
class RowReadings {
  const magloc_rows &p_;
  Workspace &space_;
  const int64_t n_sources_, n_numbers_ = 1 + 6 * n_sources_, n_ = p_.n_channels, k_ = p_.n_readings;
  // By channels: place of its sensor, gain, ambient field (3), whether it reads a modulus (1).
  Padded<T> place_{space_, 3, n_}, gain_{space_, 3, n_}, ambient_{space_, 3, n_}, modulus_{space_, 1, n_};
  Padded<T> transform_{space_, n_, k_};
  // What channels read, and its derivatives by the sources; the same of the readings.
  Padded<T> channels_{space_, n_numbers_, n_}, numbers_{space_, n_numbers_, k_};
  double *const sources_ = space_.take<double>(6 * n_sources_);  // in the array's axes, moments times mu_0/4pi
  int64_t *const first_ = space_.take<int64_t>(n_), *const end_ = space_.take<int64_t>(n_);
  bool has_modulus_ = false, is_sparse_ = false;
  int64_t row_ = -1;  // whose readings are loaded

 public:
  Padded<T> effect{space_, p_.n_nuisances, k_};  // of nuisances on the readings
  Padded<T> measured{space_, 1, k_};
  const double *rotation = nullptr;  // to the world from the array's axes
  double centroid[3] = {};           // of the sensors

  RowReadings(const magloc_rows &p, int64_t n_sources, Workspace &space)
      : p_(p), space_(space), n_sources_(n_sources) {}

  int64_t width() const { return numbers_.width(); }
  const T *values() const { return numbers_.lanes(0); }
  // (6 n_sources, n_readings) by position and by moment times mu_0/4pi of each source, in the array's axes.
  Padded<T> slopes() const { return numbers_.from(1); }
  // What a channel's reading adds to all readings.
  Padded<T> transform() const { return transform_; }

  // Before the first row. Channels beyond the last one repeat its place and see nothing.
  void begin() {
    gain_.clear(3);
    ambient_.clear(3);
    modulus_.clear(1);
    for (int64_t c = 0; c < place_.width() * n_lanes<T>; ++c) {
      const int64_t last = n_ - 1, from = c < last ? c : last;
      for (int i = 0; i < 3; ++i) {
        place_[i][c] = p_.sensors[3 * p_.sensor[from] + i];
        if (c == from) gain_[i][c] = p_.gain[3 * c + i];
      }
      if (c == from && p_.is_modulus[c]) modulus_[0][c] = 1.0, has_modulus_ = true;
    }
  }

  // Go to the pose of a row, of which no readings are predicted.
  void set_pose(int64_t row) {
    rotation = p_.rotations + 9 * row;
    for (int i = 0; i < 3; ++i) {
      centroid[i] = p_.origins[3 * row + i];
      for (int j = 0; j < 3; ++j) centroid[i] += rotation[3 * i + j] * p_.array_centroid[j];
    }
  }
  void set_row(int64_t row) {
    const bool is_first = row_ < 0;
    if (is_first) begin();
    const int64_t e = p_.n_nuisances;
    measured.load(p_.readings + k_ * row, 1, k_);
    set_pose(row);
    if (is_first || p_.ambient_of_row[row] != p_.ambient_of_row[row_]) {
      const double *fields = p_.ambients + 3 * p_.n_sensors * p_.ambient_of_row[row];
      for (int64_t c = 0; c < n_; ++c)
        for (int i = 0; i < 3; ++i) ambient_[i][c] = fields[3 * p_.sensor[c] + i];
    }
    if (is_first || p_.transform_of_row[row] != p_.transform_of_row[row_]) {
      transform_.clear(n_);
      for (int64_t c = 0; c < n_; ++c)
        for (int64_t j = 0; j < k_; ++j) transform_[c][j] = p_.transforms[(k_ * p_.transform_of_row[row] + j) * n_ + c];
      find_entries();
    }
    if (e && (is_first || p_.effect_of_row[row] != p_.effect_of_row[row_])) {
      effect.clear(e);
      for (int64_t i = 0; i < e; ++i)
        for (int64_t j = 0; j < k_; ++j) effect[i][j] = p_.effects[(k_ * p_.effect_of_row[row] + j) * e + i];
    }
    row_ = row;
  }

  // Place a source of position and moment x.
  void set_source(int64_t k, const double *x) {
    const double *origin = p_.origins + 3 * row_;
    for (int i = 0; i < 3; ++i) {
      const double *R = rotation + i;
      double *source = sources_ + 6 * k + i;
      source[0] = R[0] * (x[0] - origin[0]) + R[3] * (x[1] - origin[1]) + R[6] * (x[2] - origin[2]);
      source[3] = mu0_over_4pi * (R[0] * x[3] + R[3] * x[4] + R[6] * x[5]);
    }
  }

  // Fill values, and slopes if wanted, of all sources where they were placed.
  template <bool with_slopes>
  void predict() {
    for (int64_t r = 0; r < place_.width(); ++r) {
      T gain[3], ambient[3];
      for (int i = 0; i < 3; ++i) gain[i] = gain_.lanes(i)[r], ambient[i] = ambient_.lanes(i)[r];
      if (has_modulus_) fill_gain_of_modulus(r, gain);
      T value = dot(gain, ambient);
      for (int64_t k = 0; k < n_sources_; ++k) {
        const double (&m)[3] = *reinterpret_cast<const double (*)[3]>(sources_ + 6 * k + 3);
        const Ray<T> ray = ray_to(r, k);
        T by_moment[3];
        field(ray, gain, by_moment);  // the matrix of the field is symmetric
        value += dot(by_moment, m);
        if (!with_slopes) continue;
        const T square = ray.inverse_r * ray.inverse_r, scale = -3.0 * square * square;
        const T moment = dot(ray.n, m), seen = dot(ray.n, gain), along = dot(gain, m) - 5.0 * moment * seen;
        for (int i = 0; i < 3; ++i) {
          channels_.lanes(1 + 6 * k + i)[r] = scale * (moment * gain[i] + seen * m[i] + along * ray.n[i]);
          channels_.lanes(4 + 6 * k + i)[r] = by_moment[i];
        }
      }
      channels_.lanes(0)[r] = value;
    }
    const int64_t n = with_slopes ? n_numbers_ : 1;
    if (!is_sparse_) {
      for (int64_t i = 0; i < n; ++i) set_rows(numbers_.lanes(i), {channels_[i]}, transform_, n_);
      return;
    }
    numbers_.clear(n);
    for (int64_t c = 0; c < n_; ++c)
      for (int64_t r = first_[c]; r < end_[c]; ++r) {
        const T share = transform_.lanes(c)[r];
        for (int64_t i = 0; i < n; ++i) numbers_.lanes(i)[r] += channels_[i][c] * share;
      }
  }

 private:
  // Registers that each channel adds to. They are few where channels are whitened sensor by sensor.
  void find_entries() {
    int64_t sum = 0;
    for (int64_t c = 0; c < n_; ++c) {
      first_[c] = k_, end_[c] = 0;
      for (int64_t j = 0; j < k_; ++j)
        if (transform_[c][j] != 0.0) {
          if (end_[c] == 0) first_[c] = j / n_lanes<T>;
          end_[c] = j / n_lanes<T> + 1;
        }
      sum += maximum(end_[c] - first_[c], (int64_t)0);
    }
    is_sparse_ = 4 * sum < n_ * width();
  }
  MAGLOC_INLINE Ray<T> ray_to(int64_t r, int64_t k) const {
    T d[3];
    for (int i = 0; i < 3; ++i) d[i] = place_.lanes(i)[r] - sources_[6 * k + i];
    return Ray<T>::from(d);
  }
  // A modulus reads the field along itself.
  void fill_gain_of_modulus(int64_t r, T (&gain)[3]) const {
    T b[3], of_source[3];
    for (int i = 0; i < 3; ++i) b[i] = ambient_.lanes(i)[r];
    for (int64_t k = 0; k < n_sources_; ++k) {
      field(ray_to(r, k), *reinterpret_cast<const double (*)[3]>(sources_ + 6 * k + 3), of_source);
      for (int i = 0; i < 3; ++i) b[i] += of_source[i];
    }
    const T modulus = square_root(dot(b, b)), scale = choose(modulus > 0.0, gain[0] / modulus, T{});
    for (int i = 0; i < 3; ++i) gain[i] = choose(modulus_.lanes(0)[r] > 0.0, scale * b[i], gain[i]);
  }
};
MAGLOC_END
