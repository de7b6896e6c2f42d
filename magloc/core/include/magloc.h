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

/* Rotation of satellites whose wheels follow a reference, from one instant to another; an item is a run.
   The first instant of q, w and momentum is the start. Torque and dipole are held from each instant to the next. */
typedef struct {
  int64_t n_runs, n_instants, n_rods, first_instant, last_instant;
  double dt;
  const double *inertia, *inverse_inertia;     /* (3, 3) */
  const double *attitude_gain, *rate_gain;     /* (3,), of the wheels' control */
  double torque_limit, momentum_limit;
  const double *reference;                     /* (4,), attitude that the control holds */
  const double *rod_axes;                      /* (n_rods, 3) of hysteresis rods */
  double coercivity, steepness, rod_strength;  /* H_c, k of the arc tangent, largest moment times 2/pi */
  const double *torque, *dipole;               /* (n_runs, n_instants, 3), body axes */
  const double *orbital_rate, *gravity;        /* (n_runs, n_instants); mu/r^3 */
  const double *field;                         /* (n_runs, n_instants, 3), orbital frame */
  double *q;                                   /* (n_runs, n_instants, 4) */
  double *w, *momentum, *wheel_torque;         /* (n_runs, n_instants, 3) */
  double *rod_fields;                          /* (n_runs, n_rods, 2): H and z at the first instant, then at the last */
} magloc_attitude_motion;
int64_t magloc_attitude_motion_runs(const magloc_attitude_motion *problem, int64_t begin, int64_t end,
                                    double *workspace);

/* Error-state Kalman filter of attitude and rate with a gate, over whole runs; an item is a run.
   The optional states, three numbers each, in this order: bias of field and gyro, disturbance, error of the field
   model, dipole, three rows of the magnetometer's gain. Sensors: star tracker, gyro, magnetometer, Sun sensor.
   Missing readings are NaN. The first call starts at instant 0; a later one goes on where the one before ended. */
typedef struct {
  int64_t n_runs, n_instants, n_states;
  int64_t first_instant, end_instant;
  const double *inertia, *inverse_inertia;       /* (3, 3) */
  const double *residual_dipole;                 /* (3,) */
  const double *dt;                              /* (n_instants - 1,), steps */
  const double *first_q, *first_w;               /* (n_runs, 4), (n_runs, 3): before the first reading */
  const double *first_optional;                  /* (n_runs, n_states - 6) */
  const double *first_covariance;                /* (n_runs, n_states, n_states) */
  const double *momentum, *wheel_torque;         /* (n_runs, n_instants, 3), of the wheels */
  const double *torquers;                        /* (n_runs, n_instants, 3), their dipole */
  const double *orbital_rate, *gravity;          /* (n_runs, n_instants); mu/r^3 */
  const double *field_model, *sun_model;         /* (n_runs, n_instants, 3), orbital frame */
  const double *star, *star_whitening;           /* (n_runs, n_instants, 4), (n_runs, n_instants, 3, 3) */
  const double *gyro, *field, *sun;              /* (n_runs, n_instants, 3), readings */
  const uint8_t *used;                           /* (4,), sensors in use */
  const double *sigma;                           /* (4,), noise of a component */
  const int64_t *place;                          /* (8,), of the optional states in the error state, -1 if not in use */
  const double *kept, *added_variance;           /* (n_instants - 1, n_states), of each step */
  const double *open_variance;                   /* (n_states,), where nothing is known */
  double gate_limit;
  const int64_t *patience;                       /* (4,), instants */
  double *memory;                                /* (n_runs, workspace) between calls, or null if one does all */
  double *q, *w;                                 /* (n_runs, n_instants, 4), (n_runs, n_instants, 3) */
  double *optional;                              /* (n_runs, n_instants, n_states - 6) */
  double *covariance;                            /* (n_runs, n_instants, n_states, n_states) */
  double *nis, *log_determinant;                 /* (n_runs, n_instants, 4), left as they are without a reading */
  uint8_t *rejected;                             /* (n_runs, n_instants, 4), likewise */
} magloc_mekf;
int64_t magloc_mekf_runs(const magloc_mekf *problem, int64_t begin, int64_t end, double *workspace);

/* end of the declarations */
#ifdef __GNUC__
#pragma GCC visibility pop
#endif
#ifdef __cplusplus
}
#endif
#endif
