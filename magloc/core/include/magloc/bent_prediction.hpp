// A prediction that bends as the readings h do: those numbers have a normal distribution that are, at standard numbers
// zeta of the straight one, zeta + M (h(zeta) - h(0) - J(0) zeta). M J = 1 along what J tells in more than a share of
// the prediction's standard deviation, and 0 where it tells next to nothing.
//
// Columns are those of the linearised problem: k registers of the readings, and d numbers behind them, of the standard
// numbers. magloc/tracking/chart/update.py is the reference.
#pragma once
#include "elementary.hpp"
#include "padded.hpp"

MAGLOC_BEGIN
template <class T>
class BentPrediction {
  const int64_t k_, d_;
  Padded<T> slopes_, bend_, determinant_;  // J(0) and M
  T *const misfit_, *const rest_;          // misfit of the readings at 0

 public:
  bool bends = false;

  BentPrediction(int64_t k, int64_t d, Workspace &space)
      : k_(k),
        d_(d),
        slopes_(space, d, k * n_lanes<T>),
        bend_(space, d, k * n_lanes<T>),
        determinant_(space, 2 * d, d),
        misfit_(space.take<T>(k)),
        rest_(space.take<T>(k)) {}

  // Bend from 0 on, where the readings have a misfit and the columns J(0); the latter are used up.
  void bend(const T *misfit, const Padded<T> &columns, double least_share, const Padded<T> &triangle) {
    bends = true;
    __builtin_memcpy(misfit_, misfit, k_ * sizeof(T));
    for (int64_t i = 0; i < d_; ++i) {
      __builtin_memcpy(slopes_.lanes(i), columns.lanes(i), k_ * sizeof(T));
      for (int64_t j = 0; j < d_; ++j) tail(columns, i)[j] = i == j ? least_share : 0.0;
    }
    triangularise(columns, d_, triangle);
    for (int64_t i = d_; i-- > 0;) {
      __builtin_memcpy(bend_.lanes(i), columns.lanes(i), k_ * sizeof(T));
      add_rows(bend_.lanes(i), {triangle[i] + i + 1, 1, -1.0}, bend_.from(i + 1), d_ - i - 1);
      scale(bend_.lanes(i), 1.0 / triangle[i][i], k_);
    }
  }

  // Fill the numbers that have a normal distribution, where the readings have a misfit.
  void fill_standard(const double *zeta, const T *misfit, double *standard) const {
    __builtin_memcpy(standard, zeta, d_ * sizeof(double));
    if (!bends) return;
    for (int64_t r = 0; r < k_; ++r) rest_[r] = misfit_[r] - misfit[r];
    add_rows(rest_, {zeta, 1, -1.0}, slopes_, d_);
    for (int64_t i = 0; i < d_; ++i) standard[i] += dot(bend_.lanes(i), rest_, k_);
  }
  // Fill their derivatives by zeta, behind those of the readings.
  void fill_derivatives(const Padded<T> &columns) const {
    for (int64_t c = 0; bends && c < d_; ++c) {
      for (int64_t r = 0; r < k_; ++r) rest_[r] = columns.lanes(c)[r] - slopes_.lanes(c)[r];
      for (int64_t i = 0; i < d_; ++i) tail(columns, c)[i] = (i == c) + dot(bend_.lanes(i), rest_, k_);
    }
  }

  // Logarithm of the determinant of the numbers behind the readings. That of orthonormal columns times their triangle's
  // is that of the columns: the prediction's density by zeta is the greater, the more it bends.
  double log_determinant(const Padded<T> &columns) const {
    double sum = 0.0;
    determinant_.clear(d_);
    for (int64_t c = 0; c < d_; ++c) __builtin_memcpy(determinant_[c], tail(columns, c), d_ * sizeof(double));
    triangularise(determinant_, d_, determinant_.from(d_));
    for (int64_t i = 0; i < d_; ++i) sum += logarithm(determinant_[d_ + i][i]);
    return sum;
  }

  // Turn derivatives of the readings by zeta into those by the numbers that have a normal distribution.
  void straighten(const Padded<T> &columns) const {
    for (int64_t i = 0; bends && i < d_; ++i) {
      int64_t pivot = i;
      for (int64_t c = i + 1; c < d_; ++c)
        if (__builtin_fabs(tail(columns, c)[i]) > __builtin_fabs(tail(columns, pivot)[i])) pivot = c;
      T *const row = columns.lanes(i), *const other = columns.lanes(pivot);
      for (int64_t r = 0; pivot != i && r < columns.width(); ++r) {
        const T before = row[r];
        row[r] = other[r];
        other[r] = before;
      }
      scale(row, 1.0 / tail(columns, i)[i], columns.width());
      for (int64_t c = 0; c < d_; ++c) {
        const double share = tail(columns, c)[i];
        if (c != i) add_rows(columns.lanes(c), {&share, 1, -1.0}, columns.from(i), 1);
      }
    }
  }

 private:
  double *tail(const Padded<T> &columns, int64_t column) const {
    return reinterpret_cast<double *>(columns.lanes(column) + k_);
  }
};
MAGLOC_END
