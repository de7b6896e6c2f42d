// A prediction that bends as the readings h do: those numbers have a normal distribution that are, at standard numbers
// zeta of the straight one, zeta + M (h(zeta) - h(0) - J zeta). M J = 1 along what J tells in more than a share of the
// prediction's standard deviation, and 0 where it tells next to nothing.
//
// Columns are J by the n seen numbers: k registers of the readings, and behind them, from a place on, n numbers.
// Nuisances are part of the readings' noise. tests/magloc/tracking/test_row_filter.py has the reference.
#pragma once
#include "elementary.hpp"
#include "padded.hpp"

MAGLOC_BEGIN
template <class T>
class BentPrediction {
  const int64_t k_, n_, first_;
  Padded<T> slopes_, bend_, derivatives_, factors_;  // J(0), M, and the derivatives filled last, by rows
  T *const values_, *const rest_;                    // h(0)

 public:
  bool bends = false;

  BentPrediction(int64_t k, int64_t n, int64_t first, Workspace &space)
      : k_(k),
        n_(n),
        first_(first),
        slopes_(space, n, k * n_lanes<T>),
        bend_(space, n, k * n_lanes<T>),
        derivatives_(space, n, n),
        factors_(space, 2 * n, n),
        values_(space.take<T>(k)),
        rest_(space.take<T>(k)) {}

  // Bend from 0 on, where the readings are known and the columns behind those of nuisances, which are orthonormal. The
  // former are used up.
  void bend(const T *values, const Padded<T> &columns, double least_share, const Padded<T> &triangle) {
    bends = true;
    const Padded<T> seen = columns.from(first_);
    __builtin_memcpy(values_, values, k_ * sizeof(T));
    for (int64_t i = 0; i < n_; ++i) {
      __builtin_memcpy(slopes_.lanes(i), seen.lanes(i), k_ * sizeof(T));
      for (int64_t j = 0; j < n_; ++j) tail(seen, i)[j] = i == j ? least_share : 0.0;
    }
    triangularise(columns, first_ + n_, triangle, first_);
    for (int64_t i = n_; i-- > 0;) {
      const double *const shares = triangle[first_ + i] + first_ + i;
      __builtin_memcpy(bend_.lanes(i), seen.lanes(i), k_ * sizeof(T));
      add_rows(bend_.lanes(i), {shares + 1, 1, -1.0}, bend_.from(i + 1), n_ - i - 1);
      scale(bend_.lanes(i), 1.0 / shares[0], k_);
    }
  }

  // Fill the numbers that have a normal distribution, where the readings have some values.
  void fill_standard(const double *zeta, const T *values, double *standard) const {
    __builtin_memcpy(standard, zeta, n_ * sizeof(double));
    if (!bends) return;
    for (int64_t r = 0; r < k_; ++r) rest_[r] = values[r] - values_[r];
    add_rows(rest_, {zeta, 1, -1.0}, slopes_, n_);
    for (int64_t i = 0; i < n_; ++i) standard[i] += dot(bend_.lanes(i), rest_, k_);
  }
  // Fill their derivatives by zeta.
  void fill_derivatives(const Padded<T> &columns) const {
    for (int64_t c = 0; c < n_; ++c) {
      for (int64_t r = 0; bends && r < k_; ++r) rest_[r] = columns.lanes(c)[r] - slopes_.lanes(c)[r];
      for (int64_t i = 0; i < n_; ++i) derivatives_[c][i] = (i == c) + (bends ? dot(bend_.lanes(i), rest_, k_) : 0.0);
    }
  }
  // Put them behind those of the readings.
  void append_derivatives(const Padded<T> &columns) const {
    for (int64_t c = 0; c < n_; ++c) __builtin_memcpy(tail(columns, c), derivatives_[c], n_ * sizeof(double));
  }

  // Replace a row by the standard numbers by one by zeta.
  void bend_row(double *row, double *work) const {
    for (int64_t c = 0; c < n_; ++c) {
      work[c] = 0.0;
      for (int64_t i = 0; i < n_; ++i) work[c] += row[i] * derivatives_[c][i];
    }
    __builtin_memcpy(row, work, n_ * sizeof(double));
  }

  // Logarithm of the derivatives' determinant: the prediction's density by zeta is the greater, the more it bends.
  double log_determinant() const {
    double sum = 0.0;
    factors_.copy(derivatives_, n_);
    triangularise(factors_, n_, factors_.from(n_));
    for (int64_t i = 0; i < n_; ++i) sum += logarithm(factors_[n_ + i][i]);
    return sum;
  }

  // Turn derivatives of the readings by zeta into those by the numbers that have a normal distribution.
  void straighten(const Padded<T> &columns) const {
    for (int64_t i = 0; bends && i < n_; ++i) {
      int64_t pivot = i;
      for (int64_t c = i + 1; c < n_; ++c)
        if (__builtin_fabs(tail(columns, c)[i]) > __builtin_fabs(tail(columns, pivot)[i])) pivot = c;
      T *const row = columns.lanes(i), *const other = columns.lanes(pivot);
      for (int64_t r = 0; pivot != i && r < columns.width(); ++r) {
        const T before = row[r];
        row[r] = other[r];
        other[r] = before;
      }
      scale(row, 1.0 / tail(columns, i)[i], columns.width());
      for (int64_t c = 0; c < n_; ++c) {
        const double share = tail(columns, c)[i];
        if (c != i) add_rows(columns.lanes(c), {&share, 1, -1.0}, columns.from(i), 1);
      }
    }
  }

 private:
  double *tail(const Padded<T> &columns, int64_t column) const {
    return reinterpret_cast<double *>(columns.lanes(column) + k_) + first_;
  }
};
MAGLOC_END
