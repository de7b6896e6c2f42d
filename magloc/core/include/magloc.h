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

/* Attitudes of a camera that triangles of its image's stars state by those of a catalogue. An item is a triangle of the
   image; calls are in order, and compute nothing more once the best attitudes match enough stars or enough attitudes
   were tried. Corners are ordered by the opposite side, shortest first; sides, all in units of the sphere's radius, too. */
typedef struct {
  int64_t n_image, n_checked;
  const double *tangents;         /* (n_checked or more, 2): places of the image's stars, brightest first */
  const int64_t *image_corners;   /* (n_image, 3): numbers of stars */
  const double *image_sides;      /* (n_image, 3) */
  const uint8_t *image_is_counter_clockwise; /* (n_image,) */
  int64_t n_ratios;               /* cells of each of the ratios of the two shorter sides to the longest one */
  const int64_t *begins;          /* (n_ratios^2 + 1,): first triangle of the catalogue in each cell */
  const int64_t *corners;         /* (n, 3): numbers of stars; by cell, and in it by the longest side */
  const double *sides;            /* (n, 3) */
  const uint8_t *is_counter_clockwise; /* (n,) */
  const double *bright;           /* (n_stars, 3): directions of the stars of these triangles */
  int64_t n_cells;                /* of the cube [-1, 1]^3 along each axis */
  const int64_t *sky_begins;      /* (n_cells^3 + 1,): first star of the catalogue in each cell */
  const double *sky;              /* (n, 3): directions of all stars, by cell */
  double side_gate, scale_gate;   /* how far sides and, relatively, the image's scale may be off */
  double star_gate;               /* within which a star of the image is one of the catalogue */
  int64_t n_enough, n_most;       /* stars that match, attitudes tried: with either the search ends */
  int64_t *progress;              /* (2,): triangles looked up, attitudes tried; zero at first */
  int64_t n_kept;
  int64_t *matched;               /* (n_kept,): stars that match with the best attitudes, ascending; zero at first */
  double *rotations;              /* (n_kept, 3, 3): into the catalogue's frame from the image's */
  double *scales;                 /* (n_kept,): relative to the image's */
} magloc_star_triangles;
int64_t magloc_star_search(const magloc_star_triangles *problem, int64_t begin, int64_t end, double *workspace);

/* end of the declarations */
#ifdef __GNUC__
#pragma GCC visibility pop
#endif
#ifdef __cplusplus
}
#endif
#endif
