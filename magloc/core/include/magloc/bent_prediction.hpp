// A prediction that bends as the readings h do: those numbers have a normal distribution that are, at standard numbers
// zeta of the straight one, s = zeta + M (h(zeta) - h(0) - J zeta). M J = 1 along what J tells in more than a share of
// the prediction's standard deviation, and 0 where it tells next to nothing. Rows before told the sum of h and of
// nuisances: these bend by what h bends besides, h(zeta) - h(0) - J s. M counts nuisances as part of the readings'
// noise.
//
// Columns are derivatives by nuisances, then J by the n seen numbers: k registers of the readings, and behind them as
// many numbers. tests/magloc/tracking/test_row_filter.py has the reference.
#pragma once
#include "elementary.hpp"
#include "padded.hpp"

MAGLOC_BEGIN
template <class T>
class BentPrediction {
  const int64_t k_, n_, first_;
  Padded<T> slopes_, bend_, derivatives_, factors_;     // J(0), M, and the derivatives filled last, by rows
  Padded<T> nuisances_, absorb_, triangle_, absorbed_;  // the same of nuisances, whose bend takes up the rest
  T *const values_, *const rest_;                       // h(0)

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
        nuisances_(space, first, k * n_lanes<T> + first),
        absorb_(space, first, k * n_lanes<T>),
        triangle_(space, first, first),
        absorbed_(space, n, first),
        values_(space.take<T>(k)),
        rest_(space.take<T>(k)) {}

  // Bend from 0 on, where the readings are known, the columns by nuisances (first, k), and all columns, those of
  // nuisances being orthonormal. The others are used up.
  void bend(const T *values, const Padded<T> &nuisances, const Padded<T> &columns, double least_share,
            const Padded<T> &triangle) {
    bends = true;
    __builtin_memcpy(values_, values, k_ * sizeof(T));
    for (int64_t i = 0; i < n_; ++i) {
      __builtin_memcpy(slopes_.lanes(i), columns.lanes(first_ + i), k_ * sizeof(T));
      for (int64_t j = 0; j < n_; ++j) tail(columns, first_ + i)[first_ + j] = i == j ? least_share : 0.0;
    }
    fill_inverse(columns, first_, n_, triangle, bend_);
    nuisances_.clear(first_);
    for (int64_t i = 0; i < first_; ++i) {
      __builtin_memcpy(nuisances_.lanes(i), nuisances.lanes(i), k_ * sizeof(T));
      tail(nuisances_, i)[i] = least_share;
    }
    fill_inverse(nuisances_, 0, first_, triangle_, absorb_);
  }

  // Fill the numbers that have a normal distribution, nuisances last, where the readings have some values.
  void fill_standard(const double *zeta, const T *values, double *standard) const {
    __builtin_memcpy(standard, zeta, (n_ + first_) * sizeof(double));
    if (!bends) return;
    for (int64_t r = 0; r < k_; ++r) rest_[r] = values[r] - values_[r];
    add_rows(rest_, {zeta, 1, -1.0}, slopes_, n_);
    for (int64_t i = 0; i < n_; ++i) standard[i] += dot(bend_.lanes(i), rest_, k_);
    for (int64_t r = 0; r < k_; ++r) rest_[r] = values[r] - values_[r];
    add_rows(rest_, {standard, 1, -1.0}, slopes_, n_);
    for (int64_t i = 0; i < first_; ++i) standard[n_ + i] += dot(absorb_.lanes(i), rest_, k_);
  }
  // Fill their derivatives by zeta.
  void fill_derivatives(const Padded<T> &columns) const {
    for (int64_t c = 0; c < n_; ++c) {
      const T *const column = columns.lanes(first_ + c);
      for (int64_t r = 0; bends && r < k_; ++r) rest_[r] = column[r] - slopes_.lanes(c)[r];
      for (int64_t i = 0; i < n_; ++i) derivatives_[c][i] = (i == c) + (bends ? dot(bend_.lanes(i), rest_, k_) : 0.0);
      for (int64_t r = 0; bends && r < k_; ++r) rest_[r] = column[r];
      if (bends) add_rows(rest_, {derivatives_[c], 1, -1.0}, slopes_, n_);
      for (int64_t i = 0; i < first_; ++i) absorbed_[c][i] = bends ? dot(absorb_.lanes(i), rest_, k_) : 0.0;
    }
  }
  // Put them behind those of the readings.
  void append_derivatives(const Padded<T> &columns) const {
    for (int64_t c = 0; c < n_; ++c) {
      __builtin_memcpy(tail(columns, first_ + c), absorbed_[c], first_ * sizeof(double));
      __builtin_memcpy(tail(columns, first_ + c) + first_, derivatives_[c], n_ * sizeof(double));
    }
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
    const Padded<T> seen = columns.from(first_);
    for (int64_t i = 0; bends && i < n_; ++i) add_rows(seen.lanes(i), {absorbed_[i], 1, -1.0}, columns, first_);
    for (int64_t i = 0; bends && i < n_; ++i) {
      int64_t pivot = i;
      for (int64_t c = i + 1; c < n_; ++c)
        if (__builtin_fabs(share(seen, c, i)) > __builtin_fabs(share(seen, pivot, i))) pivot = c;
      T *const row = seen.lanes(i), *const other = seen.lanes(pivot);
      for (int64_t r = 0; pivot != i && r < seen.width(); ++r) {
        const T before = row[r];
        row[r] = other[r];
        other[r] = before;
      }
      scale(row, 1.0 / share(seen, i, i), seen.width());
      for (int64_t c = 0; c < n_; ++c) {
        const double of_row = share(seen, c, i);
        if (c != i) add_rows(seen.lanes(c), {&of_row, 1, -1.0}, seen.from(i), 1);
      }
    }
  }

 private:
  double *tail(const Padded<T> &columns, int64_t column) const {
    return reinterpret_cast<double *>(columns.lanes(column) + k_);
  }
  double share(const Padded<T> &seen, int64_t column, int64_t i) const { return tail(seen, column)[first_ + i]; }

  // Fill the inverse (n, k) of n columns in the sense of least squares; `first` ones before are orthonormal.
  void fill_inverse(const Padded<T> &columns, int64_t first, int64_t n, const Padded<T> &triangle,
                    const Padded<T> &inverse) const {
    triangularise(columns, first + n, triangle, first);
    for (int64_t i = n; i-- > 0;) {
      const double *const shares = triangle[first + i] + first + i;
      __builtin_memcpy(inverse.lanes(i), columns.lanes(first + i), k_ * sizeof(T));
      add_rows(inverse.lanes(i), {shares + 1, 1, -1.0}, inverse.from(i + 1), n - i - 1);
      scale(inverse.lanes(i), 1.0 / shares[0], k_);
    }
  }
};
MAGLOC_END
