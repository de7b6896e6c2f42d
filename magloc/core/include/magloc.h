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

/* Whitened channels of an array: what the kernels of fits know of it. Positions are in radii of the array, from its
   centroid; of a channel all numbers are in units of its noise. One set of gains and common fields serves all rows of
   readings, or each row has its own; the same holds for the ambient field. */
typedef struct {
  int64_t n_sensors, n_channels, n_common, n_sets, n_fields;
  const double *sensors;        /* (n_sensors, 3) */
  const int64_t *first_channel; /* (n_sensors + 1) of each sensor; known parts of the common field come behind */
  const double *gain;           /* (n_sets, n_channels, 3); of a modulus the first number counts */
  const double *common;         /* (n_sets, n_common, n_channels) orthonormal or zero, projected out */
  const uint8_t *is_modulus;    /* (n_channels), or NULL: none is */
  const double *ambient;        /* (n_fields, n_sensors, 3) field, or NULL without moduli */
  int64_t is_isotropic;         /* whether a sensor's gains are a turned unit matrix times a weight, and the common
                                   field is unknown; then common is not read */
} magloc_channels;

/* Fits of sources from starts; an item is a start. Positions are (u, s) on the unit sphere of R^4, at u/s radii;
   moments are in T at s = 1. */
typedef struct {
  const magloc_channels *channels;
  int64_t n_sources, max_iterations;
  double tolerance, relative_tolerance; /* a fit ends if a step would lower chi-square by less */
  const double *signals;                /* (n_rows, n_channels) whitened; of moduli, above the ambient field's */
  const int64_t *row;                   /* (n_starts) of the readings */
  const double *start;                  /* (n_starts, n_sources, 4) */
  const double *start_moment;           /* (n_starts, n_sources, 3) about which moduli are linearised first, or NULL */
  const double *too_high;               /* (n_starts) chi-square above which a fit is of no use, or NULL */
  const uint8_t *free;                  /* (n_sources, 3): two directions and the range may change, or NULL: all may */
  double *q, *mu, *chi2;                /* (n_starts, n_sources, 4), (n_starts, n_sources, 3), (n_starts) */
  int64_t *iterations;                  /* (n_starts) */
  uint8_t *converged;                   /* (n_starts) */
} magloc_refinement;
int64_t magloc_refine(const magloc_refinement *problem, int64_t begin, int64_t end, double *workspace);

/* Orthonormal readings of the three unit moments at candidate positions, by channels of one set; an item is a
   candidate. */
typedef struct {
  const magloc_channels *channels;
  int64_t n_candidates;
  const double *candidates; /* (n_candidates, 4) */
  float *bases;             /* (n_channels, 3, n_candidates) */
} magloc_candidate_positions;

/* Starts among candidates: those that explain most of a row's energy, some angle apart; an item is a row. */
typedef struct {
  int64_t n_candidates, n_chosen;
  double cosine;            /* of the least angle between two of them on the sphere of R^4 */
  const double *candidates; /* (n_candidates, 4) */
  const float *components;  /* (n_rows, 3, n_candidates) of the readings along the bases */
  int64_t *chosen;          /* (n_rows, n_chosen); the first one again if there are too few */
} magloc_candidate_choice;

/* Distinct optima that starts of one source lead to, best first; an item is a row. */
typedef struct {
  const magloc_channels *channels;
  int64_t n_starts, max_iterations;
  double keep_within;          /* above the best optimum's chi-square */
  const double *signals;       /* (n_readings, n_channels) */
  const int64_t *row;          /* (n_rows) of the readings */
  const double *starts;        /* (n_rows, n_starts, 4) */
  const double *start_moments; /* (n_rows, n_starts, 3) or NULL */
  double *q, *mu, *chi2;       /* (n_rows, n_starts, 4), (n_rows, n_starts, 3), (n_rows, n_starts); NaN where none is */
  int64_t *iterations;         /* (n_rows, n_starts) */
  int64_t *counts;             /* (n_rows, 3): optima, starts that did not converge, linearisations */
} magloc_search;
int64_t magloc_candidate_bases(const magloc_candidate_positions *problem, int64_t begin, int64_t end,
                               double *workspace);
int64_t magloc_choose_candidates(const magloc_candidate_choice *problem, int64_t begin, int64_t end,
                                 double *workspace);
int64_t magloc_search_optima(const magloc_search *problem, int64_t begin, int64_t end, double *workspace);

/* end of the declarations */
#ifdef __GNUC__
#pragma GCC visibility pop
#endif
#ifdef __cplusplus
}
#endif
#endif
