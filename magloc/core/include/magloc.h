/* Kernels of magloc and adcs, callable from C, Python (cffi), MATLAB or Julia.

A kernel computes the items begin, ..., end - 1 of a problem. Its data are described by a struct of sizes and of
pointers to arrays in C order (last index fastest). Items do not depend on each other: several threads may work at one
problem, on different items.

    int64_t magloc_<kernel>(const magloc_<problem> *problem, int64_t begin, int64_t end, double *workspace);

With workspace = NULL a kernel computes nothing and returns the number of doubles that its workspace must have. Otherwise
it returns 0. Each thread needs a workspace of its own. Kernels allocate nothing, do not check their input and never
fail: what cannot be computed is NaN.

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

/* Ends of a filter from many starts, which are states (position, moment) of a dipole; an item is a start.
   The filter measures differences of the fields at the sensors. If the noise is the same along the axes of each sensor
   (n_differences = 0), a difference is a sensor's field minus the weighted mean over the sensors before it, and the stop
   rule takes differences to the first sensor. For any other noise a difference is a sum of weighted fields; zeros fill
   up their number to a multiple of three.
   Units are such that mu_0/4pi and the standard deviations of the prior, or of the process noise of a pass, are one. */
typedef struct {
  int64_t method; /* 0: iterated Kalman filter, start as the prior's mean; 1: Kalman filter repeated with process noise;
                     2: as 0, damped; 3: as 1, linearised before each difference, which needs weights */
  int64_t n_sensors, n_differences, max_iterations;
  double tolerance2;      /* a start stops when the differences change by less than its root */
  double first_damping;   /* method 2 */
  const double *sensors;  /* (n_sensors, 3) */
  const double *readings; /* (n_sensors, 3) fields at the sensors, up to one that is common to all */
  const double *blend;    /* (n_sensors) weight of a sensor in the mean over the sensors so far */
  const double *whiten;   /* (n_sensors) inverse standard deviation of a sensor minus the mean before it */
  const double *weights;  /* (n_differences, n_sensors, 3) of the fields in a difference, divided by its deviation */
  const double *measured; /* (n_differences) divided by their standard deviations */
  const double *variance; /* (n_differences) */
  const double *starts;   /* (n, 6) */
  double *states;         /* (n, 6) */
  double *chi2;           /* (n) */
  int64_t *iterations;    /* (n) passes over the differences */
  uint8_t *stopped;       /* (n) whether the stop rule was met */
} magloc_starts;
int64_t magloc_filter_starts(const magloc_starts *problem, int64_t begin, int64_t end, double *workspace);

/* end of the declarations */
#ifdef __GNUC__
#pragma GCC visibility pop
#endif
#ifdef __cplusplus
}
#endif
#endif
