// Small symmetric positive definite matrices, of which only the lower triangle is read.
#pragma once
#include "numbers.hpp"

MAGLOC_BEGIN
// Factors of A = L D L^T. A pivot that is not above `lost` times its diagonal element consists of rounding alone.
template <class T, int n>
struct Ldl {
  T l[n][n], inverse_d[n];  // l below the diagonal
  T definite;               // 1, or NaN where a pivot is lost

  MAGLOC_INLINE Ldl(const T (&a)[n][n], double lost) {
    definite = broadcast<T>(1.0);
    for (int j = 0; j < n; ++j) {
      T d = a[j][j];
      for (int k = 0; k < j; ++k) {
        const T ld = l[j][k];  // rows below row j hold L D until it is their turn
        l[j][k] = ld * inverse_d[k];
        d -= l[j][k] * ld;
      }
      definite = choose(d > lost * a[j][j], definite, broadcast<T>(nan));
      inverse_d[j] = 1.0 / d;
      for (int i = j + 1; i < n; ++i) {
        l[i][j] = a[i][j];
        for (int k = 0; k < j; ++k) l[i][j] -= l[i][k] * l[j][k];
      }
    }
  }

  // x = A^-1 b
  MAGLOC_INLINE void solve(const T (&b)[n], T (&x)[n]) const {
    for (int i = 0; i < n; ++i) {
      x[i] = b[i];
      for (int k = 0; k < i; ++k) x[i] -= l[i][k] * x[k];
    }
    for (int i = n - 1; i >= 0; --i) {
      x[i] *= inverse_d[i];
      for (int k = i + 1; k < n; ++k) x[i] -= l[k][i] * x[k];
    }
  }
};

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
