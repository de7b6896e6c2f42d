// Which sensor contradicts the others in a row of readings.
#pragma once
#include "linear.hpp"
#include "padded.hpp"

MAGLOC_BEGIN
// Variance of readings in units of their noise, and length of what is left of the misfit.
struct ResidualScale {
  double variance, left;
};

// Fill residuals (n_sensors, 3) of each sensor's channels, of unit covariance, after an update with the orthonormal
// columns of its d numbers and of what is left of the misfit, k registers of readings. Their square is the chi-square
// that free readings of the sensor would explain. magloc/tracking/multi_target/update.py has the meaning.
template <class T>
void fill_sensor_residuals(const magloc_rows &rows, const Padded<T> &transform, const Padded<T> &columns, int64_t d,
                           int64_t k, const ResidualScale &scale, double *residuals) {
  for (int64_t s = 0, c = 0; s < rows.n_sensors; ++s) {
    int64_t n = 0;
    double square[3][3] = {}, left[3] = {}, share[3];
    for (; c + n < rows.n_channels && n < 3 && rows.sensor[c + n] == s; ++n)
      for (int64_t i = 0; i <= n; ++i)
        square[n][i] = scale.variance * dot(transform.lanes(c + n), transform.lanes(c + i), k);
    for (int64_t q = 0; q <= d; ++q)
      for (int64_t i = 0; i < n; ++i) {
        share[i] = dot(transform.lanes(c + i), columns.lanes(q), k);
        if (q == d)
          left[i] = scale.left * share[i];
        else
          for (int64_t j = 0; j <= i; ++j) square[i][j] -= share[i] * share[j];
      }
    for (int64_t i = n; i < 3; ++i) square[i][i] = 1.0;
    const Ldl<double, 3> factors(square, 1e-9);
    for (int64_t i = 0; i < 3; ++i) {
      for (int64_t j = 0; j < i; ++j) left[i] -= factors.l[i][j] * left[j];
      residuals[3 * s + i] = left[i] * square_root(factors.inverse[i]);
    }
    c += n;
  }
}
MAGLOC_END
