// Cramer-Rao bounds of sources: what their readings tell of the position when nothing else is known.
// Equations: docs/theory/cramer-rao-bounds.md. Readable reference: magloc/bounds/crlb.py.
#pragma once
#include "dipole.hpp"
#include "kernel.hpp"
#include "linear.hpp"

MAGLOC_BEGIN
// What all moments at a place have in common if neither axes nor noise depend on them: nine rows whose columns have the
// same products as those of all channels, freed of nuisances. A row reads r[0], r[1], r[2] of a change of the moment,
// and G m of minus a change of the position with G = r[3], ..., r[8] (xx, xy, xz, yy, yz, zz).
class PlaceRows {
  const magloc_bounds &p_;
  const int64_t n_nuisances_, n_columns_;
  double *const rows_;

 public:
  static constexpr int64_t n = 9, fewest_moments = 8;
  const bool are_used;
  int64_t place = -1;
  double r[n][n];

  PlaceRows(const magloc_bounds &p, Workspace &room)
      : p_(p),
        n_nuisances_(p.array->n_nuisances),
        n_columns_(n_nuisances_ + n),
        rows_(room.take<double>((p.array->n_channels + n_nuisances_) * n_columns_)),
        are_used(p.n_moments >= fewest_moments && !p.slopes && !p.array->noise_depends_on_field &&
                 p.array->n_channels == 3 * p.array->n_sensors &&
                 (n_nuisances_ == 0 || p.array->nuisances[n_nuisances_ - 1] < 3)) {}

  // R of a QR decomposition by modified Gram-Schmidt; what is left of a column may be rounding.
  void fill(int64_t at) {
    place = at;
    fill_rows();
    const int64_t n_rows = p_.array->n_channels + n_nuisances_;
    double before[n + 3] = {};
    for (int64_t i = 0; i < n_rows * n_columns_; ++i) before[i % n_columns_] += rows_[i] * rows_[i];
    for (int64_t k = 0; k < n_columns_; ++k) {
      double product[n + 3] = {};
      for (int64_t i = 0; i < n_rows; ++i)
        for (int64_t j = k; j < n_columns_; ++j) product[j] += rows_[i * n_columns_ + k] * rows_[i * n_columns_ + j];
      const double inverse = product[k] <= 1e-26 * before[k] ? 0.0 : 1.0 / product[k];
      for (int64_t j = n_nuisances_; j < n_columns_ && k >= n_nuisances_; ++j)
        r[k - n_nuisances_][j - n_nuisances_] = j < k ? 0.0 : square_root(inverse) * product[j];
      for (int64_t i = 0; i < n_rows; ++i)
        for (int64_t j = n_columns_; j-- > k;)
          rows_[i * n_columns_ + j] -= inverse * product[j] * rows_[i * n_columns_ + k];
    }
  }

 private:
  void fill_rows() {
    const magloc_bound_array &array = *p_.array;
    for (int64_t c = 0; c < array.n_channels; ++c) {
      double axis[3], d[3], by_moment[3], g[3][3], *row = rows_ + c * n_columns_;
      for (int a = 0; a < 3; ++a) {
        axis[a] = array.gain[3 * c + a] / array.noise[c];
        d[a] = p_.sensors[c / 3 * 3 + a] - p_.positions[3 * place + a];
      }
      const auto ray = Ray<double>::from(d);
      field(ray, axis, by_moment);
      gradient(ray, axis, g);
      for (int64_t q = 0; q < n_nuisances_; ++q) *row++ = axis[array.nuisances[q]];
      for (const double x : by_moment) *row++ = mu0_over_4pi * x;
      for (int a = 0; a < 3; ++a)
        for (int b = a; b < 3; ++b) *row++ = mu0_over_4pi * g[a][b];
    }
    for (int64_t q = 0; q < n_nuisances_; ++q)
      for (int64_t j = 0; j < n_columns_; ++j)
        rows_[(array.n_channels + q) * n_columns_ + j] = j == q ? array.prior[q] : 0.0;
  }
};

// Sources side by side, one in each lane.
template <class T>
class Bounds {
  // Kinds of nuisances, as in magloc.h.
  static constexpr int64_t common_modulus = 3, ambient = 4, turn = 7, shift = 10, body = 13;
  // Position is not seen at all if the nuisances leave less of its square. The reference adds so much to singular
  // covariances.
  static constexpr double rounding = 1e-26, regular = 1.0 + 1e-13;

  const magloc_bounds &p_;
  const magloc_bound_array &array_;
  PlaceRows place_rows_;
  const int64_t n_nuisances_;
  // The whitened Jacobian (n_rows, ...): nuisances; moment and position across (u, v), and along (n) the line from the
  // centroid.
  T *const nuisances_, *const others_, *const range_;
  T *const products_, *const shares_, *const axes_, *const fields_, *const body_fields_;
  T position_[3], moment_[3], frame_[3][3], distance_, mean_field_[3], mean_modulus_[3], square_;
  T r_[PlaceRows::n][PlaceRows::n] = {};  // of PlaceRows
  int64_t n_rows_, place_[n_lanes<T>];

 public:
  Bounds(const magloc_bounds &p, Workspace &room)
      : p_(p),
        array_(*p.array),
        place_rows_(p, room),
        n_nuisances_(place_rows_.are_used ? 0 : p.array->n_nuisances),
        nuisances_(room.take<T>(most_rows() * p.array->n_nuisances)),
        others_(room.take<T>(5 * most_rows())),
        range_(room.take<T>(most_rows())),
        products_(room.take<T>(p.array->n_nuisances)),
        shares_(room.take<T>(p.array->n_nuisances)),
        axes_(room.take<T>(3 * p.array->n_channels)),
        fields_(room.take<T>(3 * p.array->n_sensors)),
        body_fields_(room.take<T>(3 * p.array->n_errors)) {
    for (int64_t &place : place_) place = -1;
    for (int64_t i = 0; axes_ && i < 3 * p.array->n_channels; ++i)
      axes_[i] = broadcast<T>(p.array->gain[i] / p.array->noise[i / 3]);
  }

  // Sources begin, begin + 1, ... before end.
  void run(int64_t begin, int64_t end) {
    load(begin, end);
    if (place_rows_.are_used) {
      fill_rows_of_place();
    } else {
      fill_fields();
      fill_rows();
    }
    T square[3], x[5], slope[3];
    eliminate_nuisances(square);
    const Orthogonalisation<T, 5> others(others_, range_, n_rows_, array_.lost);
    others.solve(x);
    // NaN on a sensor and in the centroid.
    const T unknown = choose(square[2] < infinity, broadcast<T>(infinity), broadcast<T>(nan));
    const auto is_seen = square[0] + square[1] + square[2] > rounding * square_;
    const T rest = others.rest_square;
    const T range2 = choose(rest > array_.lost * square[2], choose(is_seen, 1.0 / rest, unknown), unknown);
    // Variance across the line: that for a known range, and what the range's error brings along.
    const T l = others.share(3, 4), with_range = x[3] * x[3] + x[4] * x[4];
    T across2 = others.inverse[3] + (1.0 + l * l) * others.inverse[4];
    for (int k = 3; k < 5; ++k) across2 = choose(others.inverse[k] > 0.0, across2, unknown);
    across2 +=
        choose(with_range > array_.lost, with_range * range2, choose(range2 < infinity, with_range * range2, T{}));
    across2 = choose(is_seen, across2, unknown);
    const T range = square_root(range2), bearing = square_root(across2) / distance_,
            all = square_root(range2 + across2);
    const int n_used = end - begin < n_lanes<T> ? (int)(end - begin) : n_lanes<T>;
    for (int i = 0; i < n_used; ++i) {
      p_.sigma_range[begin + i] = get_lane(range, i);
      p_.sigma_bearing[begin + i] = get_lane(bearing, i);
      p_.sigma_position[begin + i] = get_lane(all, i);
    }
    for (int64_t s = 0; p_.slopes && s < array_.n_sensors; ++s) {
      fill_slope(s, x, rest, slope);
      for (int i = 0; i < n_used; ++i)
        for (int a = 0; a < 3; ++a) p_.slopes[3 * ((begin + i) * array_.n_sensors + s) + a] = get_lane(slope[a], i);
    }
  }

 private:
  int64_t most_rows() const { return array_.n_channels + array_.n_nuisances + 1; }

  // The last source is repeated in the lanes that are left.
  void load(int64_t begin, int64_t end) {
    int64_t place = begin / p_.n_moments, k = begin % p_.n_moments;
    for (int lane = 0; lane < n_lanes<T>; ++lane) {
      if (place_rows_.are_used && place_[lane] != place) {
        if (place_rows_.place != place) place_rows_.fill(place);
        for (int64_t i = 0; i < PlaceRows::n; ++i)
          for (int64_t j = i; j < PlaceRows::n; ++j) set_lane(r_[i][j], lane, place_rows_.r[i][j]);
      }
      place_[lane] = place;
      const double *moment = p_.moments + 3 * (k + (p_.moments_are_own ? place * p_.n_moments : 0));
      for (int a = 0; a < 3; ++a) {
        set_lane(position_[a], lane, p_.positions[3 * place + a]);
        set_lane(moment_[a], lane, moment[a]);
      }
      if (begin + lane + 1 < end && ++k == p_.n_moments) k = 0, ++place;
    }
    T line[3];
    for (int a = 0; a < 3; ++a) line[a] = position_[a] - p_.centroid[a];
    distance_ = square_root(dot(line, line));
    for (int a = 0; a < 3; ++a) frame_[2][a] = line[a] / distance_;
    fill_tangents(frame_[2], frame_[0], frame_[1]);
  }
  Ray<T> ray_to(int64_t sensor) const {
    T d[3];
    for (int a = 0; a < 3; ++a) d[a] = p_.sensors[3 * sensor + a] - position_[a];
    return Ray<T>::from(d);
  }

  // Whole fields at the sensors, and their means as far as the noise depends on them: (modulus, 0, 0) of moduli.
  void fill_fields() {
    int64_t n_moduli = 0;
    for (T &x : mean_field_) x = T{};
    for (T &x : mean_modulus_) x = T{};
    for (int64_t s = 0; s < array_.n_sensors; ++s) {
      if (!array_.is_modulus[s] && !array_.noise_depends_on_field) continue;
      T b[3];
      field(ray_to(s), moment_, b);
      for (int a = 0; a < 3; ++a) fields_[3 * s + a] = b[a] = mu0_over_4pi * b[a] + array_.ambient[3 * s + a];
      n_moduli += array_.is_modulus[s];
      if (array_.is_modulus[s])
        mean_modulus_[0] += square_root(dot(b, b));
      else
        for (int a = 0; a < 3; ++a) mean_field_[a] += b[a];
    }
    mean_modulus_[0] /= broadcast<T>(n_moduli);
    for (T &x : mean_field_) x /= broadcast<T>(array_.n_sensors - n_moduli);
  }

  void fill_rows_of_place() {
    square_ = T{};
    n_rows_ = PlaceRows::n;
    for (int64_t i = 0; i < n_rows_; ++i) {
      const T *r = r_[i], g[3][3] = {{r[3], r[4], r[5]}, {r[4], r[6], r[7]}, {r[5], r[7], r[8]}};
      T by_position[3];
      for (int a = 0; a < 3; ++a) by_position[a] = -dot(g[a], moment_);
      put_row(i, {r[0], r[1], r[2]}, by_position);
    }
  }
  MAGLOC_INLINE void put_row(int64_t i, const T (&by_moment)[3], const T (&by_position)[3]) {
    for (int a = 0; a < 3; ++a) others_[5 * i + a] = by_moment[a];
    for (int a = 0; a < 2; ++a) others_[5 * i + 3 + a] = dot(by_position, frame_[a]);
    range_[i] = dot(by_position, frame_[2]);
  }

  void fill_rows() {
    square_ = T{};
    n_rows_ = array_.n_channels;
    for (int64_t s = 0; s < array_.n_sensors; ++s) {
      const int64_t first = array_.first_channel[s];
      const Ray<T> ray = ray_to(s);
      T b[3], gain = {}, by_moment[3][3], by_place[3][3];
      field_matrix(ray, by_moment);
      gradient(ray, moment_, by_place);
      for (int a = 0; a < 3; ++a) b[a] = fields_[3 * s + a];
      if (array_.is_modulus[s]) {
        const T modulus = square_root(dot(b, b)), read[3] = {modulus, T{}, T{}};
        T axis[1][3];
        whiten<1>(s, read, mean_modulus_, axis);
        gain = axis[0][0];
        for (int a = 0; a < 3; ++a) axes_[3 * first + a] = gain * (b[a] / modulus);
      } else if (array_.noise_depends_on_field) {
        whiten<3>(s, b, mean_field_, reinterpret_cast<T(&)[3][3]>(axes_[3 * first]));
      }
      fill_body_fields(s);
      for (int64_t c = first; c < array_.first_channel[s + 1]; ++c) fill_row(c, s, gain, by_moment, by_place);
    }
  }

  // Axes of n channels times the inverse root of their covariance, arrays.noise.reading_covariance.
  template <int n>
  MAGLOC_INLINE void whiten(int64_t s, const T (&b)[3], const T (&mean)[3], T (&axes)[n][3]) const {
    const int64_t first = array_.first_channel[s];
    T read[n][3], errors[n][6], covariance[n][n], difference[3];
    for (int i = 0; i < n; ++i)
      for (int a = 0; a < 3; ++a) read[i][a] = broadcast<T>(array_.gain[3 * (first + i) + a]);
    if (!array_.noise_depends_on_field) {
      for (int i = 0; i < n; ++i)
        for (int a = 0; a < 3; ++a) axes[i][a] = read[i][a] / array_.noise[first + i];
      return;
    }
    for (int a = 0; a < 3; ++a) difference[a] = b[a] - mean[a];
    const double *errs = array_.errors_of_sensor + 3 * s;
    const T induced2 = errs[1] * errs[1] * dot(b, b), proportional2 = errs[2] * errs[2] * dot(difference, difference);
    // A turn t of the sensor adds t . (b x a) to a channel of the axis a.
    for (int i = 0; i < n; ++i) {
      T(&by_turn)[3] = reinterpret_cast<T(&)[3]>(errors[i]);
      cross(b, read[i], by_turn);
      for (int k = 0; k < 3; ++k) {
        const double *g = array_.gain_errors + 9 * (first + i) + 3 * k;
        errors[i][k] *= errs[0];
        errors[i][3 + k] = g[0] * b[0] + g[1] * b[1] + g[2] * b[2];
      }
    }
    for (int i = 0; i < n; ++i)
      for (int j = 0; j <= i; ++j) {
        covariance[i][j] = induced2 * dot(read[i], read[j]);
        for (int k = 0; k < 6; ++k) covariance[i][j] += errors[i][k] * errors[j][k];
        if (i != j) continue;
        const double noise2 = array_.noise[first + i] * array_.noise[first + i];
        covariance[i][i] = regular * covariance[i][i] + noise2 + proportional2 * dot(read[i], read[i]);
      }
    const Ldl<T, n> factors(covariance, 0.0);
    for (int i = 0; i < n; ++i)
      for (int k = 0; k < i; ++k)
        for (int a = 0; a < 3; ++a) read[i][a] -= factors.l[i][k] * read[k][a];
    for (int i = 0; i < n; ++i)
      for (int a = 0; a < 3; ++a) axes[i][a] = square_root(factors.inverse[i]) * read[i][a];
  }

  // Fields of a body that are not its dipole's.
  void fill_body_fields(int64_t s) {
    for (int64_t k = 0; k < array_.n_errors; ++k) {
      T e[6];
      for (int j = 0; j < 6; ++j) {
        T x = {};
        for (int lane = 0; lane < n_lanes<T>; ++lane)
          set_lane(x, lane, p_.body_errors[6 * ((place_[lane] * array_.n_sensors + s) * array_.n_errors + k) + j]);
        e[j] = x;
      }
      const T(&m)[3] = moment_;
      body_fields_[3 * k] = e[0] * m[0] + e[1] * m[1] + e[2] * m[2];
      body_fields_[3 * k + 1] = e[1] * m[0] + e[3] * m[1] + e[4] * m[2];
      body_fields_[3 * k + 2] = e[2] * m[0] + e[4] * m[1] + e[5] * m[2];
    }
  }

  // Row of a channel; a and g are derivatives of the field with respect to the moment and minus the position.
  MAGLOC_INLINE void fill_row(int64_t c, int64_t s, T gain, const T (&a)[3][3], const T (&g)[3][3]) {
    const T(&axis)[3] = reinterpret_cast<T(&)[3]>(axes_[3 * c]);
    T by_moment[3], by_position[3], *row = nuisances_ + c * array_.n_nuisances;
    for (int k = 0; k < 3; ++k) {
      by_moment[k] = mu0_over_4pi * dot(a[k], axis);
      by_position[k] = -mu0_over_4pi * dot(g[k], axis);
    }
    for (int64_t q = 0; q < array_.n_nuisances; ++q) {
      const int64_t kind = array_.nuisances[q];
      if (kind < common_modulus)
        *row++ = array_.is_modulus[s] ? T{} : axis[kind];
      else if (kind == common_modulus)
        *row++ = gain;
      else if (kind < turn)
        *row++ = axis[kind - ambient];
      else if (kind < shift)
        *row++ = by_turn(kind - turn, s, axis, by_moment, by_position);
      else if (kind < body)
        *row++ = by_position[kind - shift];
      else
        *row++ = dot(axis, reinterpret_cast<T(&)[3]>(body_fields_[3 * (kind - body)]));
    }
    put_row(c, by_moment, by_position);
    square_ += dot(by_position, by_position);
  }
  // A turn of the array about axis k turns the place of the source, its moment and the ambient field back.
  MAGLOC_INLINE T by_turn(int64_t k, int64_t s, const T (&axis)[3], const T (&by_moment)[3],
                          const T (&by_position)[3]) const {
    const int64_t a = (k + 1) % 3, b = (k + 2) % 3;
    const T arm_a = position_[a] + array_.lever_arm[a], arm_b = position_[b] + array_.lever_arm[b];
    return by_moment[a] * moment_[b] - by_moment[b] * moment_[a] + by_position[a] * arm_b - by_position[b] * arm_a +
           axis[a] * array_.ambient[3 * s + b] - axis[b] * array_.ambient[3 * s + a];
  }

  // Turn columns to right angles to those of the nuisances; the columns themselves, for their products have half the
  // digits. What is known of a nuisance is a row of its own, which no column before it reaches. Squares of the columns
  // u, v and n are what is left of them.
  void eliminate_nuisances(T (&squares)[3]) {
    const int64_t n = n_nuisances_;
    if (array_.modulus_prior > 0.0) {
      const int64_t i = add_row();
      const T scale = array_.modulus_prior / square_root(dot(moment_, moment_));
      for (int a = 0; a < 3; ++a) others_[5 * i + a] = scale * moment_[a];
    }
    T share[6] = {};
    for (T &x : squares) x = T{};
    for (int64_t k = 0; k <= n; ++k) {
      if (k < n && array_.prior[k] > 0.0) nuisances_[add_row() * n + k] = broadcast<T>(array_.prior[k]);
      T product[6] = {}, square = {};
      for (int64_t j = k + 1; j < n; ++j) products_[j] = T{};
      for (int64_t i = 0; i < n_rows_; ++i) {
        T *const row = nuisances_ + i * n, *const other = others_ + 5 * i;
        if (k > 0) {
          const T x = row[k - 1];
          for (int64_t j = k; j < n; ++j) row[j] -= x * shares_[j];
          for (int j = 0; j < 5; ++j) other[j] -= x * share[j];
          range_[i] -= x * share[5];
        }
        if (k < n) {
          const T x = row[k];
          square += x * x;
          for (int64_t j = k + 1; j < n; ++j) products_[j] += x * row[j];
          for (int j = 0; j < 5; ++j) product[j] += x * other[j];
          product[5] += x * range_[i];
        } else {
          squares[0] += other[3] * other[3], squares[1] += other[4] * other[4], squares[2] += range_[i] * range_[i];
        }
      }
      const T inverse = choose(square > 0.0, 1.0 / square, T{});
      for (int j = 0; j < 6; ++j) share[j] = inverse * product[j];
      for (int64_t j = k + 1; j < n; ++j) shares_[j] = inverse * products_[j];
    }
  }
  int64_t add_row() {
    for (int64_t j = 0; j < n_nuisances_; ++j) nuisances_[n_rows_ * n_nuisances_ + j] = T{};
    for (int j = 0; j < 5; ++j) others_[5 * n_rows_ + j] = T{};
    range_[n_rows_] = T{};
    return n_rows_++;
  }

  // Derivative of log sigma of the range as sensor s moves. The change c of the source for which H c, with H the
  // Jacobian freed of nuisances, is what is left of the range's column, has the coefficients -x, 1.
  void fill_slope(int64_t s, const T (&x)[5], T rest, T (&slope)[3]) const {
    const T(&n)[3] = frame_[2];
    T moved[3], z[3] = {}, turned[3] = {};
    for (int a = 0; a < 3; ++a) moved[a] = n[a] - x[3] * frame_[0][a] - x[4] * frame_[1][a];
    Dual<T, 1> d[3], m[3], change[3], g[3][3];
    for (int a = 0; a < 3; ++a) {
      d[a].value = p_.sensors[3 * s + a] - position_[a], d[a].derivative[0] = -moved[a];
      m[a].value = moment_[a], m[a].derivative[0] = -x[a];
    }
    const auto ray = Ray<Dual<T, 1>>::from(d);
    field(ray, m, change);
    gradient(ray, m, g);
    for (int64_t c = array_.first_channel[s]; c < array_.first_channel[s + 1]; ++c)
      for (int a = 0; a < 3; ++a) z[a] += range_[c] * axes_[3 * c + a];
    if (array_.is_modulus[s]) {  // the direction of the field turns, too
      const T(&b)[3] = reinterpret_cast<T(&)[3]>(fields_[3 * s]);
      const T b2 = dot(b, b), scale = mu0_over_4pi * dot(z, b) / b2;
      T along = {};
      for (int a = 0; a < 3; ++a) along += b[a] * change[a].derivative[0];
      for (int a = 0; a < 3; ++a) turned[a] = scale * (change[a].derivative[0] - along * b[a] / b2);
    }
    // The centroid moves with the sensor, and turns n.
    const T scale = 1.0 / (distance_ * (double)array_.n_sensors), along = dot(n, moved);
    for (int a = 0; a < 3; ++a) {
      T sum = {};
      for (int b = 0; b < 3; ++b) sum += g[a][b].derivative[0] * z[b] + g[a][b].value * turned[b];
      slope[a] = -scale * (moved[a] - along * n[a]) - mu0_over_4pi * sum / rest;
    }
  }
};
MAGLOC_END
