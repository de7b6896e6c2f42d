// Readings of an array's channels in units of their noise, free of the common field: what `refine` fits.
//
// Each type of channels has readings y of the row in each lane, and
//   load(lane, row)             puts a row of readings into a lane,
//   read(s, f, rows)            turns columns f (3, 3) of fields at sensor s into its rows of a matrix (n, D),
//   project(columns)            takes the common field out of a matrix (n, D) of channels,
//   linearise(rays, mu)         linearises channels that are not linear in the field about that of moments mu,
//   residual(rays, mu, r)       then fills the exact residual,
//   linearise_at(s, b), fill_residual(s, b, r)    do the same for a field b at one sensor, before `project`.
#pragma once
#include "dipole.hpp"
#include "kernel.hpp"

MAGLOC_BEGIN
// Vector sensors whose noise is the same along all axes, in an unknown common field: one weight a sensor does.
template <class T>
struct Isotropic {
  static constexpr bool linear = true, isotropic = true;
  const int64_t n_sensors, n_channels;
  const double *const sensors;
  T *const y;

  Isotropic(const magloc_channels &m, const double *signals, Workspace &room)
      : n_sensors(m.n_sensors),
        n_channels(m.n_channels),
        sensors(m.sensors),
        y(room.take<T>(m.n_channels)),
        gain_(m.gain),
        signals_(signals),
        weight_(room.take<double>(m.n_sensors)) {
    if (!weight_) return;
    double sum = 0.0;
    for (int64_t s = 0; s < n_sensors; ++s) {
      const double *g = gain_ + 9 * s;
      weight_[s] = square_root(g[0] * g[0] + g[3] * g[3] + g[6] * g[6]);
      sum += weight_[s] * weight_[s];
    }
    inverse_sum_ = 1.0 / sum;
  }
  int64_t first(int64_t sensor) const { return 3 * sensor; }

  // Readings are turned from the sensor's axes into the array's.
  void load(int lane, int64_t row) {
    for (int64_t s = 0; s < n_sensors; ++s)
      for (int a = 0; a < 3; ++a) {
        double turned = 0.0;
        for (int c = 0; c < 3; ++c) turned += gain_[9 * s + 3 * c + a] * signals_[row * n_channels + 3 * s + c];
        set_lane(y[3 * s + a], lane, weight_[s] > 0.0 ? turned / weight_[s] : 0.0);
      }
  }
  template <int D>
  MAGLOC_INLINE void read(int64_t s, const T (&f)[3][3], T *rows) const {
    for (int a = 0; a < 3; ++a)
      for (int j = 0; j < 3; ++j) rows[a * D + j] = weight_[s] * f[a][j];
  }
  template <int D>
  MAGLOC_INLINE void project(T *columns) const {
    T sum[3 * D] = {};
    for (int64_t s = 0; s < n_sensors; ++s)
      for (int j = 0; j < 3 * D; ++j) sum[j] += weight_[s] * columns[3 * D * s + j];
    for (T &x : sum) x *= inverse_sum_;
    for (int64_t s = 0; s < n_sensors; ++s)
      for (int j = 0; j < 3 * D; ++j) columns[3 * D * s + j] -= weight_[s] * sum[j];
  }
  double weight(int64_t sensor) const { return weight_[sensor]; }
  double inverse_sum() const { return inverse_sum_; }  // one over the sum of the squares of the weights

  // Whether sums of products have enough digits for a row's chi-square.
  bool few_digits_do(int64_t row) const {
    double energy = 0.0;
    for (int64_t c = 0; c < n_channels; ++c) energy += signals_[row * n_channels + c] * signals_[row * n_channels + c];
    return energy <= 1e11;
  }

 private:
  const double *gain_, *signals_;
  double *const weight_, inverse_sum_ = 0.0;
};

// Any sensors and noise, the same or another in each row: gains of every channel, and orthonormal columns of the common
// field. Missing channels have no gain. Known parts of the common field are separate channels behind all others.
template <class T>
struct General {
  static constexpr bool linear = true, isotropic = false;
  const int64_t n_sensors, n_channels;
  const double *const sensors;
  T *const y;

  General(const magloc_channels &m, const double *signals, Workspace &room)
      : n_sensors(m.n_sensors),
        n_channels(m.n_channels),
        sensors(m.sensors),
        y(room.take<T>(m.n_channels)),
        m_(m),
        signals_(signals),
        gain_(room.take<T>(3 * m.n_channels)),
        common_(room.take<T>(m.n_common * m.n_channels)) {
    for (int64_t &set : set_of_lane_) set = -1;
  }
  int64_t first(int64_t sensor) const { return m_.first_channel[sensor]; }

  void load(int lane, int64_t row) {
    for (int64_t c = 0; c < n_channels; ++c) set_lane(y[c], lane, signals_[row * n_channels + c]);
    load_model(lane, m_.n_sets == 1 ? 0 : row);
  }
  void load_model(int lane, int64_t set) {
    const int64_t n_gains = 3 * n_channels, n_common = m_.n_common * n_channels;
    if (set == set_of_lane_[lane]) return;
    set_of_lane_[lane] = set;
    for (int64_t i = 0; i < n_gains; ++i) set_lane(gain_[i], lane, m_.gain[set * n_gains + i]);
    for (int64_t i = 0; i < n_common; ++i) set_lane(common_[i], lane, m_.common[set * n_common + i]);
  }
  template <int D>
  MAGLOC_INLINE void read(int64_t s, const T (&f)[3][3], T *rows) const {
    for (int64_t c = first(s); c < first(s + 1); ++c, rows += D) {
      const T *g = gain_ + 3 * c;
      for (int j = 0; j < 3; ++j) rows[j] = g[0] * f[0][j] + g[1] * f[1][j] + g[2] * f[2][j];
    }
  }
  template <int D>
  MAGLOC_INLINE void project(T *columns) const {
    int64_t k = 0;
    for (; k + 3 <= m_.n_common; k += 3) project_some<D, 3>(common_ + k * n_channels, columns);
    for (; k < m_.n_common; ++k) project_some<D, 1>(common_ + k * n_channels, columns);
  }
  MAGLOC_INLINE void linearise_at(int64_t, const T (&)[3]) const {}
  MAGLOC_INLINE void fill_residual(int64_t s, const T (&b)[3], T *r) const {
    for (int64_t c = first(s); c < first(s + 1); ++c) r[c] = y[c] - gain_of(c, b);
  }
  // Readings of a small field b at one sensor.
  MAGLOC_INLINE void read_field(int64_t s, const T (&b)[3], T *r) const {
    for (int64_t c = first(s); c < first(s + 1); ++c) r[c] = gain_of(c, b);
  }
  bool few_digits_do(int64_t) const { return false; }

 protected:
  const magloc_channels &m_;
  const double *const signals_;
  T *const gain_, *const common_;

  MAGLOC_INLINE T gain_of(int64_t c, const T (&b)[3]) const {
    return gain_[3 * c] * b[0] + gain_[3 * c + 1] * b[1] + gain_[3 * c + 2] * b[2];
  }

 private:
  int64_t set_of_lane_[n_lanes<T>];

  template <int D, int n>
  MAGLOC_INLINE void project_some(const T *common, T *columns) const {
    T product[n][D] = {};
    for (int64_t c = 0; c < n_channels; ++c)
      for (int a = 0; a < n; ++a)
        for (int j = 0; j < D; ++j) product[a][j] += common[a * n_channels + c] * columns[D * c + j];
    for (int64_t c = 0; c < n_channels; ++c)
      for (int a = 0; a < n; ++a)
        for (int j = 0; j < D; ++j) columns[D * c + j] -= common[a * n_channels + c] * product[a][j];
  }
};

// Some channels read the modulus of the field. Their readings are those above the modulus of the ambient field.
template <class T>
struct Moduli : General<T> {
  static constexpr bool linear = false;
  using General<T>::m_, General<T>::y, General<T>::gain_, General<T>::n_sensors, General<T>::n_channels;

  Moduli(const magloc_channels &m, const double *signals, Workspace &room)
      : General<T>(m, signals, room),
        reading_(room.take<T>(m.n_channels)),
        weight_(room.take<T>(m.n_channels)),
        ambient_(room.take<T>(4 * m.n_sensors)) {}

  void load(int lane, int64_t row) {
    General<T>::load(lane, row);
    const int64_t set = m_.n_sets == 1 ? 0 : row, field = m_.n_fields == 1 ? 0 : row;
    for (int64_t c = 0; c < n_channels; ++c) {
      set_lane(reading_[c], lane, get_lane(y[c], lane));
      set_lane(weight_[c], lane, m_.gain[3 * (set * n_channels + c)]);
    }
    for (int64_t s = 0; s < n_sensors; ++s) {
      const double *b = m_.ambient + 3 * (n_sensors * field + s);
      for (int a = 0; a < 3; ++a) set_lane(ambient_[4 * s + a], lane, b[a]);
      set_lane(ambient_[4 * s + 3], lane, square_root(b[0] * b[0] + b[1] * b[1] + b[2] * b[2]));
    }
  }
  template <int K>
  MAGLOC_INLINE void linearise(const Ray<T> *rays, const T (&mu)[K][3]) {
    for (int64_t s = 0; s < n_sensors; ++s) {
      T b[3];
      field_of<K>(rays + s * K, mu, b);
      linearise_at(s, b);
    }
  }
  template <int K>
  MAGLOC_INLINE void residual(const Ray<T> *rays, const T (&mu)[K][3], T *r) const {
    for (int64_t c = 0; c < n_channels; ++c) r[c] = reading_[c];
    for (int64_t s = 0; s < n_sensors; ++s) {
      T b[3];
      field_of<K>(rays + s * K, mu, b);
      fill_residual(s, b, r);
    }
    this->template project<1>(r);
  }
  // The same for any field b at one sensor; the residual still has the common field.
  MAGLOC_INLINE void linearise_at(int64_t s, const T (&b)[3]) {
    for (int64_t c = this->first(s); c < this->first(s + 1); ++c) {
      if (!m_.is_modulus[c]) continue;
      T direction[3];
      const T rise = rise_of_modulus(b, ambient_ + 4 * s, direction);
      for (int a = 0; a < 3; ++a) gain_[3 * c + a] = weight_[c] * direction[a];
      y[c] = reading_[c] - weight_[c] * (rise - dot(direction, b));
    }
  }
  MAGLOC_INLINE void fill_residual(int64_t s, const T (&b)[3], T *r) const {
    T direction[3];
    const T rise = rise_of_modulus(b, ambient_ + 4 * s, direction);
    for (int64_t c = this->first(s); c < this->first(s + 1); ++c)
      r[c] = reading_[c] - (m_.is_modulus[c] ? weight_[c] * rise : this->gain_of(c, b));
  }

 private:
  T *const reading_, *const weight_, *const ambient_;  // ambient_: of each sensor the field and its modulus

  template <int K>
  MAGLOC_INLINE static void field_of(const Ray<T> *rays, const T (&mu)[K][3], T (&b)[3]) {
    b[0] = b[1] = b[2] = T{};
    for (int k = 0; k < K; ++k) {
      T of_source[3];
      field(rays[k], mu[k], of_source);
      for (int a = 0; a < 3; ++a) b[a] += of_source[a];
    }
  }
  // By how much a field b raises the modulus of the ambient field, to all digits, and the direction of their sum.
  MAGLOC_INLINE static T rise_of_modulus(const T (&b)[3], const T *ambient, T (&direction)[3]) {
    T total[3], sum[3];
    for (int a = 0; a < 3; ++a) {
      total[a] = ambient[a] + b[a];
      sum[a] = ambient[a] + total[a];
    }
    const T modulus = square_root(dot(total, total)), both = modulus + ambient[3];
    const T inverse = choose(modulus > 0.0, 1.0 / modulus, T{});
    for (int a = 0; a < 3; ++a) direction[a] = total[a] * inverse;
    return choose(both > 0.0, dot(b, sum) / both, T{});
  }
};

MAGLOC_END
