/* Kernels of magloc and adcs, callable from C, Python (cffi), MATLAB or Julia.

A kernel computes the items begin, ..., end - 1 of a problem. Its data are described by a struct of sizes and of
pointers to arrays in C order (last index fastest). Items do not depend on each other: several threads may work at one
problem, on different items.

    int64_t magloc_<kernel>(const magloc_<problem> *problem, int64_t begin, int64_t end, double *workspace);

With workspace = NULL a kernel computes nothing and returns the number of doubles that its workspace must have.
Otherwise it returns 0. Each thread needs a workspace of its own. Kernels allocate nothing, do not check their input and
never fail: what cannot be computed is NaN.

All quantities are in SI units: m, A m^2, T, s, rad.
*/
#ifndef MAGLOC_H
#define MAGLOC_H
#include <stdint.h>
#ifdef __cplusplus
extern "C" {
#endif
#ifdef __GNUC__
#pragma GCC visibility push(default)
#endif
/* cffi reads the declarations from here to the end. */

/* Instruction set in use: "baseline", "avx2" or "avx512". */
const char *magloc_instruction_set(void);
/* Use an instruction set by its name; returns 0, or 1 and changes nothing if this machine or build lacks it.
   The best one is used from the start. */
int magloc_use_instruction_set(const char *name);

/* Field or its gradient at points of several dipoles together; an item is a point. */
typedef struct {
  int64_t n_points, n_sources;
  const double *points;  /* (n_points, 3) */
  const double *sources; /* (n_sources, 3) */
  const double *moments; /* (n_sources, 3) */
  double *out;           /* fields (n_points, 3) or gradient tensors (n_points, 3, 3) */
} magloc_dipoles;
int64_t magloc_dipole_fields(const magloc_dipoles *problem, int64_t begin, int64_t end, double *workspace);
int64_t magloc_dipole_gradients(const magloc_dipoles *problem, int64_t begin, int64_t end, double *workspace);

/* end of the declarations */
#ifdef __GNUC__
#pragma GCC visibility pop
#endif
#ifdef __cplusplus
}
#endif
#endif
