// Matrices of any size whose rows fill whole registers, and factors of positive ones. What lies beyond the end of a row
// is never used.
#pragma once
#include "kernel.hpp"
#include "linear.hpp"

MAGLOC_BEGIN
// Numbers at equal steps in memory, such as a column of a matrix, with a sign.
struct Strided {
  const double *first;
  int64_t step = 1;
  double sign = 1.0;

  Strided operator-() const { return {first, step, -sign}; }
};

template <class T>
class Padded {
  int64_t width_;
  T *start_;

  Padded(int64_t width, T *start) : width_(width), start_(start) {}

 public:
  Padded(Workspace &space, int64_t n_rows, int64_t n_columns)
      : width_(n_registers<T>(n_columns)), start_(space.take<T>(n_rows * width_)) {}

  int64_t width() const { return width_; }  // in lanes
  T *lanes(int64_t row) const { return start_ + row * width_; }
  double *operator[](int64_t row) const { return reinterpret_cast<double *>(lanes(row)); }
  Strided column(int64_t column) const { return {(*this)[0] + column, width_ * n_lanes<T>}; }
  Padded from(int64_t row) const { return {width_, lanes(row)}; }

  void clear(int64_t n_rows) const { __builtin_memset(start_, 0, n_rows * width_ * sizeof(T)); }
  void load(const double *matrix, int64_t n_rows, int64_t n_columns) const {
    clear(n_rows);
    for (int64_t i = 0; i < n_rows; ++i)
      __builtin_memcpy((*this)[i], matrix + i * n_columns, n_columns * sizeof(double));
  }
  void copy(const Padded &other, int64_t n_rows) const {
    __builtin_memcpy(start_, other.start_, n_rows * width_ * sizeof(T));
  }
  void store(double *matrix, int64_t n_rows, int64_t n_columns) const {
    for (int64_t i = 0; i < n_rows; ++i)
      __builtin_memcpy(matrix + i * n_columns, (*this)[i], n_columns * sizeof(double));
  }
};

template <int m, class T>
MAGLOC_INLINE void add_in_registers(T *target, Strided coefficients, const T *rows, int64_t width, int64_t n) {
  T sum[m], odd[m] = {};  // two of each, as a sum waits for the one before it
  for (int i = 0; i < m; ++i) sum[i] = target[i];
  const double *next = coefficients.first;
  int64_t k = 0;
  for (; k + 1 < n; k += 2, next += 2 * coefficients.step, rows += 2 * width) {
    const double a = coefficients.sign * next[0], b = coefficients.sign * next[coefficients.step];
    MAGLOC_UNROLL
    for (int i = 0; i < m; ++i) {
      sum[i] += a * rows[i];
      odd[i] += b * rows[width + i];
    }
  }
  if (k < n)
    for (int i = 0; i < m; ++i) sum[i] += coefficients.sign * next[0] * rows[i];
  for (int i = 0; i < m; ++i) target[i] = sum[i] + odd[i];
}

// Add to a row the first n rows of a matrix, each times a coefficient, from some register of the row on.
template <class T>
void add_rows(T *target, Strided coefficients, const Padded<T> &rows, int64_t n, int64_t begin = 0) {
  const int64_t width = rows.width();
  const T *first = rows.lanes(0);
  for (; begin + 4 <= width; begin += 4) add_in_registers<4>(target + begin, coefficients, first + begin, width, n);
  if (begin + 3 == width) add_in_registers<3>(target + begin, coefficients, first + begin, width, n);
  if (begin + 2 == width) add_in_registers<2>(target + begin, coefficients, first + begin, width, n);
  if (begin + 1 == width) add_in_registers<1>(target + begin, coefficients, first + begin, width, n);
}

// Fill a row with the sum of the first n rows of a matrix, each times a coefficient.
template <class T>
MAGLOC_INLINE void set_rows(T *target, Strided coefficients, const Padded<T> &rows, int64_t n) {
  for (int64_t i = 0; i < rows.width(); ++i) target[i] = T{};
  add_rows(target, coefficients, rows, n);
}

template <class T>
MAGLOC_INLINE void scale(T *row, double factor, int64_t width, int64_t begin = 0) {
  for (int64_t i = begin; i < width; ++i) row[i] *= factor;
}

// Replace n rows [A | B], A (n, n) symmetric and positive, by [U | U^-T B] with A = U^T U, U upper triangular. Only the
// upper triangle of A is used. NaN follows a pivot that is not positive.
template <class T>
void factorise(const Padded<T> &rows, int64_t n) {
  for (int64_t i = 0; i < n; ++i) {
    const int64_t begin = i / n_lanes<T>;
    add_rows(rows.lanes(i), -rows.column(i), rows, i, begin);
    scale(rows.lanes(i), 1.0 / square_root(rows[i][i]), rows.width(), begin);
    for (int64_t j = 0; j < i; ++j) rows[i][j] = 0.0;
  }
}

// Solve U^T X = B of n rows B in place.
template <class T>
void solve_transposed(const Padded<T> &root, int64_t n, const Padded<T> &b) {
  for (int64_t i = 0; i < n; ++i) {
    add_rows(b.lanes(i), -root.column(i), b, i);
    scale(b.lanes(i), 1.0 / root[i][i], b.width());
  }
}

// Solve U^T x = b in place.
template <class T>
void solve_transposed(const Padded<T> &root, int64_t n, double *b) {
  for (int64_t i = 0; i < n; ++i) {
    b[i] /= root[i][i];
    for (int64_t j = i + 1; j < n; ++j) b[j] -= b[i] * root[i][j];
  }
}

// Solve U x = b in place.
template <class T>
void solve(const Padded<T> &root, int64_t n, double *b) {
  for (int64_t i = n; i-- > 0;) {
    for (int64_t j = i + 1; j < n; ++j) b[i] -= root[i][j] * b[j];
    b[i] /= root[i][i];
  }
}

// Take the shares of a unit vector, or a part of each, out of m rows.
template <int m, class T>
MAGLOC_INLINE void project(const T *unit, T *rows, int64_t width, double *shares, double part = 1.0) {
  T sum[m] = {};
  for (int64_t r = 0; r < width; ++r) {
    MAGLOC_UNROLL
    for (int i = 0; i < m; ++i) sum[i] += unit[r] * rows[i * width + r];
  }
  for (int i = 0; i < m; ++i) shares[i] = sum_of_lanes(sum[i]);
  for (int64_t r = 0; r < width; ++r) {
    MAGLOC_UNROLL
    for (int i = 0; i < m; ++i) rows[i * width + r] -= part * shares[i] * unit[r];
  }
}

// Gram and Schmidt's modified method on rows of which the first n_done are orthonormal. The upper triangle becomes R
// with rows = R^T times the orthonormal rows; a row of zeros remains. R is as good as Householder's.
template <class T>
void triangularise(const Padded<T> &rows, int64_t n, const Padded<T> &triangle, int64_t n_done = 0) {
  const int64_t width = rows.width();
  for (int64_t j = 0; j < n; ++j) {
    T *const unit = rows.lanes(j);
    if (j >= n_done) {
      const double norm = square_root(dot(unit, unit, width));
      triangle[j][j] = norm;
      scale(unit, norm > 0.0 ? 1.0 / norm : 0.0, width);
    }
    int64_t k = j < n_done ? n_done : j + 1;
    for (; k + 4 <= n; k += 4) project<4>(unit, rows.lanes(k), width, triangle[j] + k);
    for (; k < n; ++k) project<1>(unit, rows.lanes(k), width, triangle[j] + k);
  }
}

// Replace a matrix by its transpose.
template <class T>
void transpose(const Padded<T> &a, int64_t n) {
  for (int64_t i = 0; i < n; ++i)
    for (int64_t j = 0; j < i; ++j) {
      const double below = a[i][j];
      a[i][j] = a[j][i];
      a[j][i] = below;
    }
}

// Reflect columns `first` to first + n of the rows of a matrix, so that what they are turned into stands in the first h
// of them: by Householder's reflections, each of which leaves the h-th number of some vectors of h numbers, one for
// each column, in the first of the rest of them.
template <class T>
void gather(const Padded<T> &vectors, int64_t h, int64_t n, const Padded<T> &rows, int64_t n_rows, int64_t first,
            const Padded<T> &work) {
  for (int64_t r = 0; r < h; ++r) {
    double square = 0.0;
    work.clear(1);
    for (int64_t c = r; c < n; ++c) {
      work[0][first + c] = vectors[c][r];
      square += vectors[c][r] * vectors[c][r];
    }
    if (square == 0.0) continue;
    const double norm = square_root(square), at = vectors[r][r];
    work[0][first + r] += at < 0.0 ? -norm : norm;
    const double share = 1.0 / (square + norm * __builtin_fabs(at));
    for (int64_t i = 0; i < n_rows; ++i) {
      const double product = -share * dot(work.lanes(0), rows.lanes(i), rows.width());
      add_rows(rows.lanes(i), {&product}, work, 1);
    }
    T *const sum = work.lanes(1);
    set_rows(sum, {work[0] + first + r}, vectors.from(r), n - r);
    for (int64_t c = r; c < n; ++c)
      for (int64_t i = 0; i < vectors.width(); ++i) vectors.lanes(c)[i] -= share * work[0][first + c] * sum[i];
  }
}

// Make the first k registers of rows orthogonal to each other by Jacobi's rotations, which turn the rest of the rows,
// too.
template <class T>
void make_orthogonal(const Padded<T> &rows, int64_t begin, int64_t end, int64_t k) {
  double rounding = 0.0;
  for (int64_t i = begin; i < end; ++i) rounding += 1e-15 * dot(rows.lanes(i), rows.lanes(i), k);
  bool is_turned = true;
  for (int sweep = 0; sweep < 30 && is_turned; ++sweep) {
    is_turned = false;
    for (int64_t i = begin; i < end; ++i)
      for (int64_t j = i + 1; j < end; ++j) {
        T *const a = rows.lanes(i), *const b = rows.lanes(j);
        const double product = dot(a, b, k), of_a = dot(a, a, k), of_b = dot(b, b, k);
        if (product * product <= 1e-16 * of_a * of_b + rounding * rounding) continue;
        is_turned = true;
        const double slope = 0.5 * (of_b - of_a) / product;
        const double tangent = 1.0 / (slope + (slope < 0.0 ? -1.0 : 1.0) * square_root(1.0 + slope * slope));
        const double cosine = inverse_root(1.0 + tangent * tangent), sine = tangent * cosine;
        for (int64_t r = 0; r < rows.width(); ++r) {
          const T before = a[r];
          a[r] = cosine * before - sine * b[r];
          b[r] = sine * before + cosine * b[r];
        }
      }
  }
}
MAGLOC_END
