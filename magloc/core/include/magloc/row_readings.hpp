// Readings of a row of an array, in units of their noise, as they are predicted for several sources and errors of the
// array's pose: magloc/measurement/pose.py explains the latter.
#pragma once
#include "dipole.hpp"
#include "elementary.hpp"
#include "magnets.hpp"
#include "padded.hpp"

MAGLOC_BEGIN
template <class T>
class RowReadings {
  const magloc_rows &p_;
  Workspace &space_;
  const int64_t n_sources_, n_pose_ = p_.n_pose, n_ = p_.n_channels, k_ = p_.n_readings;
  // Values, their derivatives by sources and, if the pose has errors, by turns of the ambient field and by that field.
  const int64_t by_ambient_ = 1 + 6 * n_sources_, n_numbers_ = by_ambient_ + (n_pose_ ? 6 : 0);
  // By channels: place of its sensor, gain, ambient field (3), whether it reads a modulus (1).
  Padded<T> place_{space_, 3, n_}, gain_{space_, 3, n_}, ambient_{space_, 3, n_}, modulus_{space_, 1, n_};
  Padded<T> transform_{space_, n_, k_};
  Padded<T> stated_ambient_{space_, n_pose_ ? 3 : 0, n_};
  // Of channels; the same of the readings, with the derivatives by errors of the pose behind those by sources.
  Padded<T> channels_{space_, n_numbers_, n_}, numbers_{space_, n_numbers_ + n_pose_, k_};
  double *const sources_ = space_.take<double>(6 * n_sources_);  // in the array's axes, moments times mu_0/4pi
  double *const pose_effect_ = space_.take<double>(12 * n_pose_);
  double origin_[3], behind_[3] = {};  // of a source's place, in the world's and then in the array's axes
  double true_rotation_[9], turn_of_change_[3][3], by_field_[3][3];  // where the pose has errors
  int64_t *const first_ = space_.take<int64_t>(n_), *const end_ = space_.take<int64_t>(n_);
  bool has_modulus_ = false, is_sparse_ = false;
  const MagnetBody<T> body_{p_.shape, p_.size};  // of all sources
  int64_t row_ = -1;                             // whose readings are loaded

 public:
  Padded<T> effect{space_, p_.n_nuisances, k_};  // of nuisances on the readings
  Padded<T> measured{space_, 1, k_};
  const double *rotation = nullptr;  // to the world from the array's axes
  double centroid[3] = {};           // of the sensors

  RowReadings(const magloc_rows &p, int64_t n_sources, Workspace &space)
      : p_(p), space_(space), n_sources_(n_sources) {}

  int64_t width() const { return numbers_.width(); }
  const T *values() const { return numbers_.lanes(0); }
  // (6 n_sources + n_pose, n_readings) by position and by moment times mu_0/4pi of each source, in the array's axes,
  // and by errors of the pose.
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
      centroid[i] = origin_[i] = p_.origins[3 * row + i];
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
      const Padded<T> &ambient = n_pose_ ? stated_ambient_ : ambient_;
      for (int64_t c = 0; c < n_; ++c)
        for (int i = 0; i < 3; ++i) ambient[i][c] = fields[3 * p_.sensor[c] + i];
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

  // Let the pose have errors (n_pose), of which shares have an effect, or all.
  void set_pose(const double *x, const double *shares) {
    double error[12] = {}, turned[3][3], turns[3][3], longer[3], moved[3][3];
    for (int i = 0; i < 12; ++i)
      for (int64_t q = 0; q < n_pose_; ++q) {
        double &effect = pose_effect_[n_pose_ * i + q];
        effect = (shares ? shares[q] : 1.0) * p_.pose_effects[(12 * row_ + i) * n_pose_ + q];
        error[i] += effect * x[q];
      }
    const double *R = p_.rotations + 9 * row_;
    fill_rotation({error[0], error[1], error[2]}, turned, turns);
    fill_field_error(error + 9, longer, moved);
    for (int i = 0; i < 3; ++i) {
      behind_[i] = p_.lever_arm[i] + error[6 + i];
      origin_[i] = p_.origins[3 * row_ + i] + error[3 + i];
      for (int j = 0; j < 3; ++j) {
        origin_[i] -= R[3 * i + j] * p_.lever_arm[j];
        turn_of_change_[i][j] = turns[i][j];
        true_rotation_[3 * i + j] = by_field_[i][j] = 0.0;
        for (int l = 0; l < 3; ++l) {
          true_rotation_[3 * i + j] += R[3 * i + l] * turned[l][j];
          by_field_[i][j] += turned[l][i] * moved[l][j];
        }
      }
      for (int64_t r = 0; r < ambient_.width(); ++r) {
        ambient_.lanes(i)[r] = T{};
        for (int l = 0; l < 3; ++l) ambient_.lanes(i)[r] += turned[l][i] * (stated_ambient_.lanes(l)[r] + longer[l]);
      }
    }
    rotation = true_rotation_;
  }

  // Place a source of position and moment x.
  void set_source(int64_t k, const double *x) {
    for (int i = 0; i < 3; ++i) {
      const double *R = rotation + i;
      double *source = sources_ + 6 * k + i;
      source[0] = R[0] * (x[0] - origin_[0]) + R[3] * (x[1] - origin_[1]) + R[6] * (x[2] - origin_[2]) - behind_[i];
      source[3] = mu0_over_4pi * (R[0] * x[3] + R[3] * x[4] + R[6] * x[5]);
    }
  }

  // Turn changes of a source's position and moment, by rows of registers, into those by which slopes are.
  void to_array(T *rows, int64_t width) const {
    const double *R = rotation;
    for (int64_t j = 0; j < 2 * width; ++j) {
      T *const row = rows + (j < width ? j : 2 * width + j);
      const T world[3] = {row[0], row[width], row[2 * width]};
      for (int i = 0; i < 3; ++i) {
        const T turned = R[i] * world[0] + R[3 + i] * world[1] + R[6 + i] * world[2];
        row[i * width] = j < width ? turned : mu0_over_4pi * turned;
      }
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
        if (p_.shape != Shape::dipole) {
          value += add_magnet<with_slopes>(r, k, gain);
          continue;
        }
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
      for (int i = 0; with_slopes && n_pose_ && i < 3; ++i) {
        const int a = (i + 1) % 3, b = (i + 2) % 3;
        channels_.lanes(by_ambient_ + i)[r] = gain[a] * ambient[b] - gain[b] * ambient[a];
        channels_.lanes(by_ambient_ + 3 + i)[r] = gain[i];
      }
    }
    combine(with_slopes ? n_numbers_ : 1);
    for (int64_t q = 0; with_slopes && q < n_pose_; ++q) fill_pose_slope(q);
  }

 private:
  // Fill some numbers of the readings from those of the channels.
  void combine(int64_t n) {
    for (int64_t i = 0; i < n; ++i) {
      T *const numbers = numbers_.lanes(i < by_ambient_ ? i : n_pose_ + i);
      if (!is_sparse_) {
        set_rows(numbers, {channels_[i]}, transform_, n_);
        continue;
      }
      for (int64_t r = 0; r < numbers_.width(); ++r) numbers[r] = T{};
      for (int64_t c = 0; c < n_; ++c)
        for (int64_t r = first_[c]; r < end_[c]; ++r) numbers[r] += channels_[i][c] * transform_.lanes(c)[r];
    }
  }
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
  // Error of the ambient field, whose error in the world is given, in the stated axes of the array, and its derivative
  // by that: along the field it is one of its modulus, across a turn.
  void fill_field_error(const double *error, double (&longer)[3], double (&moved)[3][3]) const {
    const double *R = p_.rotations + 9 * row_, *fields = p_.ambients + 3 * p_.n_sensors * p_.ambient_of_row[row_];
    double mean[3] = {}, change[3], w[3], moving[3][3];
    for (int i = 0; i < 3; ++i) {
      for (int64_t s = 0; s < p_.n_sensors; ++s) mean[i] += fields[3 * s + i] / p_.n_sensors;
      change[i] = R[i] * error[0] + R[3 + i] * error[1] + R[6 + i] * error[2];
    }
    const double modulus = square_root(dot(mean, mean)), scale = modulus > 0.0 ? 1.0 / modulus : 0.0;
    const double u[3] = {scale * mean[0], scale * mean[1], scale * mean[2]}, along = dot(u, change);
    for (int i = 0; i < 3; ++i) w[i] = u[i] + scale * (change[i] - along * u[i]);
    const double inverse = modulus > 0.0 ? inverse_root(dot(w, w)) : 0.0;
    for (double &component : w) component *= inverse;
    const double cosine = dot(w, u), share = (modulus + along) * inverse * scale;
    for (int i = 0; i < 3; ++i) {
      longer[i] = modulus > 0.0 ? (modulus + along) * w[i] - mean[i] : change[i];
      for (int j = 0; j < 3; ++j) {
        const double across = (i == j) - u[i] * u[j] - w[i] * w[j] + cosine * w[i] * u[j];
        moving[i][j] = modulus > 0.0 ? w[i] * u[j] + share * across : (double)(i == j);
      }
    }
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) moved[i][j] = dot(moving[i], {R[3 * j], R[3 * j + 1], R[3 * j + 2]});
  }

  // Derivative of the readings by an error of the pose, from those by sources and by the ambient field.
  void fill_pose_slope(int64_t q) {
    T *const slope = numbers_.lanes(by_ambient_ + q);
    const double *effect = pose_effect_ + q, *R = true_rotation_;
    double turn[3] = {}, by[6];
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) turn[i] += turn_of_change_[i][j] * effect[n_pose_ * j];
    for (int64_t r = 0; r < numbers_.width(); ++r) slope[r] = T{};
    for (int64_t k = 0; k < n_sources_; ++k) {
      for (int i = 0; i < 3; ++i) {
        const int a = (i + 1) % 3, b = (i + 2) % 3;
        const double *source = sources_ + 6 * k;
        by[i] = (source[a] + behind_[a]) * turn[b] - (source[b] + behind_[b]) * turn[a] - effect[n_pose_ * (6 + i)];
        for (int j = 0; j < 3; ++j) by[i] -= R[3 * j + i] * effect[n_pose_ * (3 + j)];
        by[3 + i] = source[3 + a] * turn[b] - source[3 + b] * turn[a];
      }
      add_rows(slope, {by}, numbers_.from(1 + 6 * k), 6);
    }
    for (int i = 0; i < 3; ++i) {
      by[i] = turn[i], by[3 + i] = 0.0;
      for (int j = 0; j < 3; ++j) by[3 + i] += by_field_[i][j] * effect[n_pose_ * (9 + j)];
    }
    add_rows(slope, {by}, numbers_.from(by_ambient_ + n_pose_), 6);
  }

  MAGLOC_INLINE Ray<T> ray_to(int64_t r, int64_t k) const {
    T d[3];
    for (int i = 0; i < 3; ++i) d[i] = place_.lanes(i)[r] - sources_[6 * k + i];
    return Ray<T>::from(d);
  }
  // Field of a source that is a magnet of known shape.
  AlignedField<T> magnet_field(int64_t r, int64_t k) const {
    T d[3], m[3];
    for (int i = 0; i < 3; ++i) {
      d[i] = place_.lanes(i)[r] - sources_[6 * k + i];
      m[i] = broadcast<T>(sources_[6 * k + 3 + i]);
    }
    return {body_, d, m};
  }
  // Return what a magnet adds to the channels' values, and fill their slopes if wanted.
  template <bool with_slopes>
  T add_magnet(int64_t r, int64_t k, const T (&gain)[3]) {
    const AlignedField<T> b = magnet_field(r, k);
    for (int i = 0; with_slopes && i < 3; ++i) {
      T by_position{}, by_moment{};
      for (int j = 0; j < 3; ++j)
        by_position += gain[j] * b.by_position[j][i], by_moment += gain[j] * b.by_moment[j][i];
      channels_.lanes(1 + 6 * k + i)[r] = by_position;
      channels_.lanes(4 + 6 * k + i)[r] = by_moment;
    }
    return dot(gain, b.field);
  }
  // A modulus reads the field along itself.
  void fill_gain_of_modulus(int64_t r, T (&gain)[3]) const {
    T b[3], of_source[3];
    for (int i = 0; i < 3; ++i) b[i] = ambient_.lanes(i)[r];
    for (int64_t k = 0; k < n_sources_; ++k) {
      if (p_.shape == Shape::dipole) {
        field(ray_to(r, k), *reinterpret_cast<const double (*)[3]>(sources_ + 6 * k + 3), of_source);
        for (int i = 0; i < 3; ++i) b[i] += of_source[i];
      } else {
        const AlignedField<T> of_magnet = magnet_field(r, k);
        for (int i = 0; i < 3; ++i) b[i] += of_magnet.field[i];
      }
    }
    const T modulus = square_root(dot(b, b)), scale = choose(modulus > 0.0, gain[0] / modulus, T{});
    for (int i = 0; i < 3; ++i) gain[i] = choose(modulus_.lanes(0)[r] > 0.0, scale * b[i], gain[i]);
  }
};
MAGLOC_END
