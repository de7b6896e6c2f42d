// Small linear algebra in lanes.
#pragma once
#include "numbers.hpp"

MAGLOC_BEGIN
// Modified Gram-Schmidt of D columns a (n, D) and of a vector y (n,), in place: the columns become orthogonal to each
// other, and y to all of them. A column that loses all but `lost` of its square is rounding; it counts as zero.
template <class T, int D>
class Orthogonalisation {
  T square_[D] = {}, share_[D][D] = {}, share_of_y_[D] = {};  // share_[j][k] of column j in column k

  // Subtract column j - 1 from the later ones and from y, then project these on column j.
  template <int j>
  MAGLOC_INLINE void pass(T *a, T *y, int64_t n, double lost) {
    T product[D] = {}, product_y = {}, sum_y = {};
    for (int64_t i = 0; i < n; ++i) {
      T *row = a + i * D, rest = y[i];
      if constexpr (j > 0) {
        for (int k = j; k < D; ++k) row[k] -= share_[j - 1][k] * row[j - 1];
        rest -= share_of_y_[j - 1] * row[j - 1];
        y[i] = rest;
      } else {
        for (int k = 1; k < D; ++k) square_[k] += row[k] * row[k];
      }
      if constexpr (j < D) {
        for (int k = j; k < D; ++k) product[k] += row[j] * row[k];
        product_y += row[j] * rest;
      } else {
        sum_y += rest * rest;
      }
    }
    if constexpr (j < D) {
      const T before = j > 0 ? square_[j] : product[j];
      inverse[j] = choose(product[j] > lost * before, 1.0 / product[j], T{});
      for (int k = j + 1; k < D; ++k) share_[j][k] = inverse[j] * product[k];
      share_of_y_[j] = inverse[j] * product_y;
      pass<j + 1>(a, y, n, lost);
    } else {
      rest_square = sum_y;
    }
  }

 public:
  T inverse[D], rest_square;  // one over the squares of the orthogonal columns; the square of what is left of y

  // Share of orthogonal column j in the original column k.
  MAGLOC_INLINE T share(int j, int k) const { return share_[j][k]; }

  MAGLOC_INLINE Orthogonalisation(T *a, T *y, int64_t n, double lost) { pass<0>(a, y, n, lost); }

  // Fill the lower triangle of (a^T a)^-1 of the original columns; NaN if a column is lost.
  MAGLOC_INLINE void fill_inverse_squares(T (&result)[D][D]) const {
    T inverse_share[D][D] = {};  // of the unit upper triangle of shares
    for (int k = 0; k < D; ++k) {
      inverse_share[k][k] = broadcast<T>(1.0);
      for (int j = k; j-- > 0;)
        for (int i = j + 1; i <= k; ++i) inverse_share[j][k] -= share_[j][i] * inverse_share[i][k];
    }
    for (int i = 0; i < D; ++i)
      for (int j = 0; j <= i; ++j) {
        result[i][j] = T{};
        for (int k = i; k < D; ++k) result[i][j] += inverse_share[i][k] * inverse[k] * inverse_share[j][k];
        for (const T &x : inverse) result[i][j] = choose(x > 0.0, result[i][j], broadcast<T>(nan));
      }
  }

  // Solve the least-squares problem y = a x of the original columns.
  MAGLOC_INLINE void solve(T (&x)[D]) const {
    for (int j = D; j-- > 0;) {
      x[j] = share_of_y_[j];
      for (int k = j + 1; k < D; ++k) x[j] -= share_[j][k] * x[k];
    }
  }
};

// Unit vectors u, v at right angles to a unit vector n and each other. Duff et al., "Building an orthonormal basis,
// revisited".
template <class T>
MAGLOC_INLINE void fill_tangents(const T (&n)[3], T (&u)[3], T (&v)[3]) {
  const T x = n[0], y = n[1], z = n[2], one = broadcast<T>(1.0);
  const T sign = choose(z >= 0.0, one, -one), a = -1.0 / (sign + z), b = x * y * a;
  u[0] = 1.0 + sign * x * x * a, u[1] = sign * b, u[2] = -sign * x;
  v[0] = b, v[1] = sign + y * y * a, v[2] = -y;
}

// Factors L D L^T of a positive matrix (lower triangle) whose diagonal a_jj may be raised to (1 + damping) a_jj +
// added_j. A pivot that loses all but `lost` of its diagonal counts as infinite: its variable stays zero.
template <class T, int n>
struct Ldl {
  T l[n][n], inverse[n];  // inverse: of D, or zero where a pivot is lost

  MAGLOC_INLINE Ldl(const T (&a)[n][n], double lost) : Ldl(a, T{}, no_ridge, lost) {}
  MAGLOC_INLINE Ldl(const T (&a)[n][n], T damping, const T (&added)[n], double lost) {
    for (int j = 0; j < n; ++j) {
      const T diagonal = (1.0 + damping) * a[j][j] + added[j];
      T pivot = diagonal;
      for (int k = 0; k < j; ++k) {
        const T scaled = l[j][k];  // l times the pivot, until here
        l[j][k] *= inverse[k];
        pivot -= scaled * l[j][k];
      }
      inverse[j] = choose(pivot > lost * diagonal, 1.0 / pivot, T{});
      for (int i = j + 1; i < n; ++i) {
        l[i][j] = a[i][j];
        for (int k = 0; k < j; ++k) l[i][j] -= l[i][k] * l[j][k];
      }
    }
  }
  // One, or NaN if a pivot is lost.
  MAGLOC_INLINE T definite() const {
    T result = broadcast<T>(1.0);
    for (const T &x : inverse) result = choose(x > 0.0, result, broadcast<T>(nan));
    return result;
  }
  MAGLOC_INLINE void solve(const T (&b)[n], T (&x)[n]) const {
    for (int i = 0; i < n; ++i) {
      x[i] = b[i];
      for (int k = 0; k < i; ++k) x[i] -= l[i][k] * x[k];
    }
    for (int i = n; i-- > 0;) {
      x[i] *= inverse[i];
      for (int k = i + 1; k < n; ++k) x[i] -= l[k][i] * x[k];
    }
  }

 private:
  static constexpr T no_ridge[n] = {};
};

// A row of numbers in registers, one after the other; the rest of the last register is zero.
template <class T>
MAGLOC_INLINE void set_number(T *row, int64_t i, double value) {
  set_lane(row[i / n_lanes<T>], i % n_lanes<T>, value);
}
template <class T>
MAGLOC_INLINE double dot(const T *a, const T *b, int64_t width) {
  T sum{};
  for (int64_t r = 0; r < width; ++r) sum += a[r] * b[r];
  return sum_of_lanes(sum);
}

// Gram-Schmidt's method, twice, on n rows of `width` registers in place. The upper triangle becomes R with
// rows = R^T times the orthonormal rows; a row of zeros remains.
template <class T, int n>
void orthonormalise(T *rows, int64_t width, double (&triangle)[n][n]) {
  for (int j = 0; j < n; ++j) {
    T *const row = rows + j * width;
    for (int k = 0; k < j; ++k) triangle[k][j] = 0.0;
    for (int pass = 0; pass < 2; ++pass)
      for (int k = 0; k < j; ++k) {
        const T *const before = rows + k * width;
        const double share = dot(before, row, width);
        triangle[k][j] += share;
        for (int64_t r = 0; r < width; ++r) row[r] -= share * before[r];
      }
    const double norm = square_root(dot(row, row, width)), inverse = norm > 0.0 ? 1.0 / norm : 0.0;
    triangle[j][j] = norm;
    for (int64_t r = 0; r < width; ++r) row[r] *= inverse;
  }
}

// Replace the lower triangle of A by that of -A^-1: the sweep operator on every variable.
template <class T, int n>
MAGLOC_INLINE void invert_and_negate(T (&a)[n][n]) {
  MAGLOC_UNROLL
  for (int k = 0; k < n; ++k) {
    const T inverse = 1.0 / a[k][k];
    T column[n];
    MAGLOC_UNROLL
    for (int i = 0; i < n; ++i) column[i] = i < k ? a[k][i] : a[i][k];
    MAGLOC_UNROLL
    for (int i = 0; i < n; ++i) {
      const T scaled = inverse * column[i];
      MAGLOC_UNROLL
      for (int j = 0; j <= i; ++j)
        if (i != k && j != k) a[i][j] -= scaled * column[j];
      if (i != k) (i < k ? a[k][i] : a[i][k]) = scaled;
    }
    a[k][k] = -inverse;
  }
}
MAGLOC_END
