/* Kernels of magloc and adcs, callable from C, Python (cffi), MATLAB or Julia.

A kernel computes the items begin, ..., end - 1 of a problem. Its data are described by a struct of sizes and of
pointers to arrays in C order (last index fastest). Several threads may work at one problem, on different items. Only
the steps of a filter depend on each other: they are computed in order, with one workspace that keeps the state.

    int64_t magloc_<kernel>(const magloc_<problem> *problem, int64_t begin, int64_t end, double *workspace);

With workspace = NULL a kernel computes nothing and returns the number of doubles that its workspace must have.
Otherwise it returns 0. Each thread needs its own workspace. Kernels allocate nothing, do not check their input and
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

/* Field of a uniformly magnetised body and its derivatives at points outside it, in the body's frame; an item is a
   point. Inside the body and on its surface everything is NaN. */
typedef struct {
  int64_t n_points, shape; /* 0: dipole, 1: cuboid, 2: cylinder or ring about z, 3: sphere */
  double size[3];          /* 0; halves of the edges; inner radius, outer radius, half height; radius, 0, 0 */
  const double *points;    /* (n_points, 3): from the body's centre */
  const double *moments;   /* (n_points, 3) */
  double *fields;          /* (n_points, 3) */
  double *matrices;        /* (n_points, 3, 3): the fields by the moment */
  double *gradients;       /* (n_points, 3, 3): the fields by the point */
} magloc_magnets;
int64_t magloc_shape_fields(const magloc_magnets *problem, int64_t begin, int64_t end, double *workspace);

/* Field of bodies that are magnetised along their z axis, and its derivatives by their places and moments; an item is a
   point. A cuboid has equal edges across its moment. */
typedef struct {
  int64_t n_points, shape; /* as of magloc_magnets */
  double size[3];
  const double *rolls;   /* (n_points, 2): cosine and sine of a cuboid's roll; NULL: the mean over all rolls */
  const double *points;  /* (n_points, 3): from the body's centre */
  const double *moments; /* (n_points, 3) */
  double *fields;        /* (n_points, 3) */
  double *jacobians;     /* (n_points, 3, 7): by the body's place, by its moment, by its roll */
} magloc_aligned_magnets;
int64_t magloc_aligned_fields(const magloc_aligned_magnets *problem, int64_t begin, int64_t end, double *workspace);

/* Attitudes of a camera that triangles of its image's stars state by those of a catalogue. An item is a triangle of the
   image; calls are in order, and compute nothing more once the best attitudes match enough stars or enough attitudes
   were tried. Corners are ordered by the opposite side, shortest first; sides, all in units of the sphere's radius,
   too. */
typedef struct {
  int64_t n_image, n_checked;
  const double *tangents;                    /* (n_checked or more, 2): places of the image's stars, brightest first */
  const int64_t *image_corners;              /* (n_image, 3): numbers of stars */
  const double *image_sides;                 /* (n_image, 3) */
  const uint8_t *image_is_counter_clockwise; /* (n_image,) */
  int64_t n_ratios;                    /* cells of each of the ratios of the two shorter sides to the longest one */
  const int64_t *begins;               /* (n_ratios^2 + 1,): first triangle of the catalogue in each cell */
  const int64_t *corners;              /* (n, 3): numbers of stars; by cell, and in it by the longest side */
  const double *sides;                 /* (n, 3) */
  const uint8_t *is_counter_clockwise; /* (n,) */
  const double *bright;                /* (n_stars, 3): directions of the stars of these triangles */
  int64_t n_cells;                     /* of the cube [-1, 1]^3 along each axis */
  const int64_t *sky_begins;           /* (n_cells^3 + 1,): first star of the catalogue in each cell */
  const double *sky;                   /* (n, 3): directions of all stars, by cell */
  double side_gate, scale_gate;        /* how far sides and, relatively, the image's scale may be off */
  double star_gate;                    /* within which a star of the image is one of the catalogue */
  int64_t n_enough, n_most;            /* stars that match, attitudes tried: with either the search ends */
  int64_t *progress;                   /* (2,): triangles looked up, attitudes tried; zero at first */
  int64_t n_kept;
  int64_t *matched;  /* (n_kept,): stars that match with the best attitudes, ascending; zero at first */
  double *rotations; /* (n_kept, 3, 3): into the catalogue's frame from the image's */
  double *scales;    /* (n_kept,): relative to the image's */
} magloc_star_triangles;
int64_t magloc_star_search(const magloc_star_triangles *problem, int64_t begin, int64_t end, double *workspace);

/* Readings of a gyro and of two vectors, such as field and Sun, of several runs. A vector has any length, and is NaN
   where it was not read. Either all runs share the references and turns of the frame (n_references = 1) or each has its
   own. */
typedef struct {
  int64_t n_runs, n_steps, n_references;
  const double *dt;                                 /* (n_steps,): steps that end at each instant */
  const double *rate;                               /* (n_runs, n_steps, 3): mean rate of each step */
  const double *first, *second;                     /* (n_runs, n_steps, 3): body axes */
  const double *first_reference, *second_reference; /* (n_references, n_steps, 3): the same in the frame */
  const double *frame_turn;                         /* (n_references, n_steps, 4): turn of the frame in each step */
} magloc_vector_record;

/* Complementary filter of the attitude. Item run * n_steps + i is instant i of a run; those of a run are in order, with
   one workspace. Gains are K_P and K_I. */
typedef struct {
  const magloc_vector_record *record;
  int64_t is_gauss_newton;          /* 1: error against a measured quaternion, by Gauss and Newton; 0: explicit error */
  double mu;                        /* added to the diagonal of Gauss and Newton's normal equations */
  double weights[2];                /* of the two vectors in the explicit error */
  double gains[2], outage_gains[2]; /* with the second vector, and while it is missing */
  double boost, boost_level, boost_memory; /* factor of K_I while the smoothed error exceeds a level, and its memory */
  int64_t is_substituted, is_transported, delay; /* whether the first vector of so many steps ago stands in for a second
                                one that is missing, and whether it is turned as body and frame have turned since */
  const double *counted;                         /* (n_steps,): time for which the vectors of each instant count */
  double *q;          /* (n_runs, n_steps, 4): reference from body; the first one of a run is where it starts */
  double *integral;   /* (n_runs, n_steps, 3): minus the gyro's bias */
  double *q_measured; /* (n_runs, n_steps, 4): of Gauss and Newton's filter */
} magloc_complementary;
int64_t magloc_complementary_filter(const magloc_complementary *problem, int64_t begin, int64_t end, double *workspace);

/* Adaptive error-state filter of attitude and gyro bias; items as of magloc_complementary. */
typedef struct {
  const magloc_vector_record *record;
  double first_sigma, second_sigma;         /* noise of the first vector in its unit, and of the unit second one */
  double attitude_growth, bias_growth;      /* of the variances, in a second */
  double memory, threshold, changed_growth; /* of the smoothed NIS; above it the bias's variance grows by more */
  double *q;                                /* (n_runs, n_steps, 4) */
  double *bias;                             /* (n_runs, n_steps, 3) */
  double *covariance;   /* (n_runs, n_steps, 6, 6): of the error angle in body axes, and of the bias */
  double *smoothed_nis; /* (n_runs, n_steps) */
} magloc_adaptive;
int64_t magloc_adaptive_filter(const magloc_adaptive *problem, int64_t begin, int64_t end, double *workspace);

/* Attitudes of a gyro alone, from the identity on; an item is an instant, all in order. */
typedef struct {
  const double *rate; /* (n, 3): mean rate of the step that ends at each instant */
  const double *dt;   /* (n,) */
  double *q;          /* (n, 4) */
} magloc_gyro;
int64_t magloc_gyro_attitudes(const magloc_gyro *problem, int64_t begin, int64_t end, double *workspace);

/* Attitudes of a gyro, turned from the left so that a vector of its frame goes up; an item is an instant, all in order.
 */
typedef struct {
  double start[4];      /* level frame from that of the gyro, at first */
  const double *q_gyro; /* (n, 4) */
  const double *up;     /* (n, 3) */
  const double *part;   /* (n,): part of the angle that is corrected */
  double *q;            /* (n, 4) */
} magloc_level;
int64_t magloc_level_attitudes(const magloc_level *problem, int64_t begin, int64_t end, double *workspace);

/* Butterworth filter of second order in any steps, exact for an input that is its mean within each step; an item is an
   instant, all in order. NaN is the value before. */
typedef struct {
  int64_t n_columns;
  const double *values; /* (n, n_columns) */
  const double *start;  /* (n_columns,): where the filter rests at first */
  const double *steps;  /* (n,): s dt of the step that ends at each instant; the distance z of the filter to its input
                           obeys z'' + 2 s z' + 2 s^2 z = 0 */
  double *out;          /* (n, n_columns) */
} magloc_butterworth;
int64_t magloc_low_pass(const magloc_butterworth *problem, int64_t begin, int64_t end, double *workspace);

/* How much readings change, seen from a frame that does not turn, if they lag behind their attitude; an item is a lag.
 */
typedef struct {
  int64_t n_instants, n_rows, apart; /* rows between the two readings of a change */
  const double *time, *q, *field;    /* (n_instants), ascending; (n_instants, 4); (n_instants, 3) */
  const int64_t *rows;               /* (n_rows), ascending: instants that count */
  const uint8_t *is_good;            /* (n_rows) */
  const double *lags;                /* (n_lags) */
  double *changes;                   /* (n_lags), sum of squares */
} magloc_lags;
int64_t magloc_lag_changes(const magloc_lags *problem, int64_t begin, int64_t end, double *workspace);

/* How the states of a heading filter move on in each block: the heading, the gyro's drift, scales of its axes, the
   sensor's offset, and the slow and the quick variation of the room's field. */
typedef struct {
  const double *kept;   /* (n_blocks, 14): part of each state that remains */
  const double *growth; /* (n_blocks, 14): of its variance */
} magloc_heading_room;

/* Heading of an inertial unit from means over n blocks of time; an item of the filter is a block, all in order. The
   smoother has 2 n items, forwards and backwards, and uses the blocks that the filter has found to be known. */
typedef struct {
  int64_t n_blocks;
  const double *field; /* (n_blocks, 3): in the frame that is level and whose heading is the gyro's */
  const double *level; /* (n_blocks, 3, 3): to that frame from the body */
  const double *dt;    /* (n_blocks,) */
  const double *turn;  /* (n_blocks, 4): what drift and scales add to the heading */
  const magloc_heading_room *room, *other_room; /* the latter where the field is another one everywhere */
  const double *x, *P;                          /* (14,), (14, 14): at the start */
  double start_field[3];                        /* east, north, up */
  double noise;                                 /* of the field, 1 sigma, each axis */
  double gate, mean_nis, memory; /* limits of the NIS of a block and, each axis, of the mean of the last ones */
  double patience, trial;   /* how long blocks contradict before a change of the offset is tried, and for how long */
  double jump, evidence;    /* the change, 1 sigma, and the logarithm of its odds from which on it is believed */
  double *told, *variances; /* (n_blocks, 4): heading and offset */
  int64_t *used, *known;    /* (n_blocks,): 1 where a block is used, and where it is in hindsight; 2 where the offset
                               began to be another one; zero at first */
} magloc_heading;
int64_t magloc_heading_filter(const magloc_heading *problem, int64_t begin, int64_t end, double *workspace);
int64_t magloc_heading_smoother(const magloc_heading *problem, int64_t begin, int64_t end, double *workspace);

/* Attitude of an inertial unit, reading by reading; an item is a row, all in order. The state of the filter is the
   caller's: zero at first, it goes on from row to row and from call to call. */
typedef struct {
  const double *model;                       /* (22,), adcs.HeadingModel */
  double lag;                                /* of the magnetometer, s */
  int64_t is_point_sample, disturbance;      /* 0 automatic, 1 reject, 2 subtract, 3 keep */
  const double *time;                        /* (n,), s */
  const double *rate, *acceleration, *field; /* (n, 3), rad/s, m/s^2, T; NaN where missing */
  double *state;                             /* (attitude_filter_size doubles); resume: whether it has one */
  int64_t resume;
  double *q, *sigma;                      /* (n, 4) east, north, up from body; (n, 2) of tilt and heading, rad */
  double *corrected_rate, *bias, *offset; /* (n, 3), rad/s, rad/s, T */
  int64_t *flags, *status;                /* (n,), of AttitudeFlag and Status */
} magloc_attitude;
int64_t magloc_attitude_filter(const magloc_attitude *problem, int64_t begin, int64_t end, double *workspace);

/* Rotation of satellites whose wheels follow a reference, from one instant to another; an item is a run.
   The first instant of q, w and momentum is the start. Torque and dipole are held from each instant to the next. */
typedef struct {
  int64_t n_runs, n_instants, n_rods, first_instant, last_instant;
  double dt;
  const double *inertia, *inverse_inertia; /* (3, 3) */
  const double *attitude_gain, *rate_gain; /* (3,), of the wheels' control */
  double torque_limit, momentum_limit;
  const double *reference;                    /* (4,), attitude that the control holds */
  const double *rod_axes;                     /* (n_rods, 3) of hysteresis rods */
  double coercivity, steepness, rod_strength; /* H_c, k of the arc tangent, largest moment times 2/pi */
  const double *torque, *dipole;              /* (n_runs, n_instants, 3), body axes */
  const double *orbital_rate, *gravity;       /* (n_runs, n_instants); mu/r^3 */
  const double *field;                        /* (n_runs, n_instants, 3), orbital frame */
  double *q;                                  /* (n_runs, n_instants, 4) */
  double *w, *momentum, *wheel_torque;        /* (n_runs, n_instants, 3) */
  double *rod_fields;                         /* (n_runs, n_rods, 2): H and z at the first instant, then at the last */
} magloc_attitude_motion;
int64_t magloc_attitude_motion_runs(const magloc_attitude_motion *problem, int64_t begin, int64_t end,
                                    double *workspace);

/* Rotation of satellites at small angles to the orbital frame, in place; an item is a run. */
typedef struct {
  int64_t n_steps;
  double dt, orbital_rate;
  const double *inertia, *inverse_inertia; /* (3, 3) */
  const double *control;                   /* (n_runs, 3), torque that is held */
  const double *disturbance; /* (2 n_steps + 1, 3), torque at the beginning, middle and end of each step, of all runs */
  double *state;             /* (n_runs, 9): roll, pitch and yaw, rate in body axes, and the integral of the rate */
} magloc_small_motion;
int64_t magloc_small_motion_runs(const magloc_small_motion *problem, int64_t begin, int64_t end, double *workspace);

/* Guaranteed ellipsoids of the states of one linear system, in place; an item is a run. */
typedef struct {
  int64_t n_states, n_channels;
  const double *A, *disturbance; /* (n_states, n_states): transition; shape of the ellipsoid of disturbances */
  const double *inputs;          /* (n_runs, n_states), added by ellipsoids_predict */
  const double *directions;      /* (n_channels, n_states) */
  const double *readings;        /* (n_runs, n_channels), NaN where missing */
  int64_t rule;                  /* of the step: 0 lemma, 1 optimal, 2 tightened */
  double inflation;              /* least growth of a bound that is contradicted */
  const double *reinflation;     /* (n_states, n_states), added to an ellipsoid that is contradicted */
  double *centres, *shapes;      /* (n_runs, n_states), (n_runs, n_states, n_states) */
  double *bounds;                /* (n_runs, n_channels) of the readings' errors */
  int64_t *resets;               /* (n_runs), contradictions so far */
} magloc_ellipsoids;
int64_t magloc_ellipsoids_predict(const magloc_ellipsoids *problem, int64_t begin, int64_t end, double *workspace);
int64_t magloc_ellipsoids_correct(const magloc_ellipsoids *problem, int64_t begin, int64_t end, double *workspace);

/* Error-state Kalman filter of attitude and rate with a gate. Item run * n_instants + i is instant i of a run; those of
   a run are in order, with one workspace.
   The optional states, three numbers each, in this order: bias of field and gyro, disturbance, error of the field
   model, dipole, three rows of the magnetometer's gain. Sensors: star tracker, gyro, magnetometer, Sun sensor.
   Missing readings are NaN. */
typedef struct {
  int64_t n_runs, n_instants, n_states;
  const double *inertia, *inverse_inertia; /* (3, 3) */
  const double *residual_dipole;           /* (3,) */
  int64_t has_feedback;                    /* whether the control's feedback is taken for dynamics, as in the paper */
  const double *attitude_gain, *rate_gain; /* (3,), of the control */
  const double *dt;                        /* (n_instants - 1,), steps */
  const double *first_q, *first_w;         /* (n_runs, 4), (n_runs, 3): before the first reading */
  const double *first_optional;            /* (n_runs, n_states - 6) */
  const double *first_covariance;          /* (n_runs, n_states, n_states) */
  const double *momentum, *wheel_torque;   /* (n_runs, n_instants, 3), of the wheels */
  const double *torquers;                  /* (n_runs, n_instants, 3), their dipole */
  const double *orbital_rate, *gravity;    /* (n_runs, n_instants); mu/r^3 */
  const double *field_model, *sun_model;   /* (n_runs, n_instants, 3), orbital frame */
  const double *star, *star_whitening;     /* (n_runs, n_instants, 4), (n_runs, n_instants, 3, 3) */
  const double *gyro, *field, *sun;        /* (n_runs, n_instants, 3), readings */
  const uint8_t *used;                     /* (4,), sensors in use */
  const double *sigma;                     /* (4,), noise of a component */
  const int64_t *place;                    /* (8,), of the optional states in the error state, -1 if not in use */
  const double *kept, *added_variance;     /* (n_instants - 1, n_states), of each step */
  const double *open_variance;             /* (n_states,), where nothing is known */
  double gate_limit;
  const int64_t *patience;       /* (4,), instants */
  double *q, *w;                 /* (n_runs, n_instants, 4), (n_runs, n_instants, 3) */
  double *optional;              /* (n_runs, n_instants, n_states - 6) */
  double *covariance;            /* (n_runs, n_instants, n_states, n_states) */
  double *nis, *log_determinant; /* (n_runs, n_instants, 4), left as they are without a reading */
  uint8_t *rejected;             /* (n_runs, n_instants, 4), likewise */
  int64_t n_before;              /* of one run that goes on: instants so far, the last of them is instant 0 here and the
                                    workspace has the filter after it; else 0 */
} magloc_mekf;
int64_t magloc_mekf_runs(const magloc_mekf *problem, int64_t begin, int64_t end, double *workspace);
/* Ends of a filter from many starts, which are states (position, moment) of a dipole; an item is a start.
   The filter measures differences of the fields at the sensors. If the noise is the same along the axes of each sensor
   (n_differences = 0), a difference is a sensor's field minus the weighted mean over the sensors before it, and the
   stop rule takes differences to the first sensor. For any other noise a difference is a sum of weighted fields; zeros
   fill up their number to a multiple of three. Units are such that mu_0/4pi and the standard deviations of the prior,
   or of the process noise of a pass, are one. */
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
  const double *signals;      /* (n_rows, n_channels) whitened readings; of moduli, above the ambient field's */
  const int64_t *row;         /* (n_starts) of the readings */
  const double *start;        /* (n_starts, n_sources, 4) */
  const double *start_moment; /* (n_starts, n_sources, 3) about which moduli are linearised first, or NULL */
  const double *too_high;     /* (n_starts) chi-square above which a fit is of no use, or NULL */
  const uint8_t *free;        /* (n_sources, 3): two directions and the range may change, or NULL: all may */
  double *q, *mu, *chi2;      /* (n_starts, n_sources, 4), (n_starts, n_sources, 3), (n_starts) */
  int64_t *iterations;        /* (n_starts) */
  uint8_t *converged;         /* (n_starts) */
} magloc_refinement;
int64_t magloc_refine(const magloc_refinement *problem, int64_t begin, int64_t end, double *workspace);

/* A rigid body of dipoles; an item is a start. A pose is its position, in radii from the array's centroid, and the
   rotation matrix from the body's frame to the array's. Covariances are of the position in metres and of a small
   rotation about the body's axes; those of fits that did not converge are not written. */
typedef struct {
  const magloc_channels *channels;
  int64_t n_magnets, max_iterations;
  double radius;                        /* [m] */
  double tolerance, relative_tolerance; /* a fit ends if a step would lower chi-square by less */
  const double *places, *moments;       /* (n_magnets, 3) in the body's frame: radii, and T at one radius */
  const double *signals;            /* (n_rows, n_channels) whitened readings; of moduli, above the ambient field's */
  const int64_t *row;               /* (n_starts) of the readings */
  const double *start;              /* (n_starts, 12) */
  double *pose, *chi2, *covariance; /* (n_starts, 12), (n_starts), (n_starts, 6, 6) */
  int64_t *iterations;              /* (n_starts) */
  uint8_t *converged;               /* (n_starts) */
} magloc_pose_refinement;
int64_t magloc_refine_poses(const magloc_pose_refinement *problem, int64_t begin, int64_t end, double *workspace);

/* Distinct poses of a body that fit a row of readings, best first; an item is a row. */
typedef struct {
  const magloc_pose_refinement *fit; /* its row: of each item; starts and results are not used */
  int64_t n_candidates, n_features, n_starts, n_kept;
  double keep_within;       /* above the best optimum's chi-square */
  double apart;             /* least distance of two starts, in radii and radians together */
  const double *candidates; /* (n_candidates, 12) */
  const float *table;       /* (n_features, n_candidates) */
  const float *features;    /* (n_rows, n_features) of the readings; starts have the largest products with the table */
  double low[3], high[3], least_trace; /* limits of positions, in radii, and of the trace of rotation matrices */
  double most_chi2;                    /* of plain rows */
  double *bend;      /* (n_rows) of the readings over one standard deviation of the best pose, in units of the noise */
  uint8_t *is_plain; /* (n_rows) 1 if all optima are apart and within the limits, and the best one's chi-square is */
  double *pose, *chi2, *covariance; /* (n_rows, n_kept, 12), (n_rows, n_kept), (n_rows, n_kept, 6, 6); NaN for none */
  int64_t *counts;                  /* (n_rows, 3): optima, starts that did not converge, linearisations */
} magloc_pose_search;
int64_t magloc_search_poses(const magloc_pose_search *problem, int64_t begin, int64_t end, double *workspace);

/* A body followed by one Gaussian over rows, each with its own set of channels or one for all; an item is a row.
   States are the pose (position, then a small rotation in the body's frame), errors of the magnets and of the sensors,
   and the rates: velocity in the array's frame, rotation rate in the body's. Positions are in radii. */
typedef struct {
  const magloc_pose_refinement *fit; /* channels, magnets, signals and row; starts and results are not used */
  int64_t n_magnet_errors, n_sensor_errors, max_iterations, most_contradictions;
  double tolerance;                        /* square of a step, in its standard deviations, that ends an iteration */
  const double *magnet_errors;             /* (n_magnets, n_magnet_errors) relative change of each moment */
  const double *sensor_errors;             /* (n_rows, n_sensor_errors, n_channels) whitened readings, or NULL */
  const double *lasting, *added;           /* (n_rows, n_sensor_errors) share that lasts, and noise, of a step */
  const double *steps;                     /* (n_rows, 2, 5) of position and rotation: time that the rate lasts, share
                                              that is left of it, and lower roots (00, 10, 11) of the noise */
  const double *nis_limits;                /* (n_rows) above which a row contradicts the track */
  const double *curvature;                 /* (n_rows) weight of what the linearisation neglects, in the noise */
  double *pose, *rates, *errors;           /* (12), (6), (errors): the state before the next row, changed by calls, */
  double *covariance;                      /* (n, n) */
  int64_t *progress;                       /* (2) contradictions in succession, and 1 as long as the track continues */
  double *poses, *all_rates, *covariances; /* (n_rows, 12), (n_rows, 6) and (n_rows, 12, 12) of pose and rates */
  double *nis;                             /* (n_rows) */
  int64_t *status;                         /* (n_rows) 1 updated, 2 contradiction, 0 after the end of the track */
} magloc_pose_track;
int64_t magloc_follow_body(const magloc_pose_track *problem, int64_t begin, int64_t end, double *workspace);

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
int64_t magloc_choose_candidates(const magloc_candidate_choice *problem, int64_t begin, int64_t end, double *workspace);
int64_t magloc_search_optima(const magloc_search *problem, int64_t begin, int64_t end, double *workspace);

/* What is known of the fits of one source by vector sensors, all solutions of a row together; an item is a row.
   Covariances are of the position in radii and the moment in T at s = 1. */
typedef struct {
  const magloc_channels *channels;
  int64_t most_fits;        /* of a row */
  const double *signals;    /* (n_rows, n_channels) */
  const double *energy;     /* (n_rows), square of what they differ */
  const int64_t *first_fit; /* (n_rows + 1) of each row, best first */
  const int64_t *row;       /* (n_fits) */
  const double *q, *mu;     /* (n_fits, 4), (n_fits, 3) */
  const double *chi2;       /* (n_fits) */
  double detected;          /* energy above which there is a source */
  double misfit, dof;       /* chi-square above which a fit is none, and its degrees of freedom */
  double level, outside;    /* rise of chi-square within the set of ranges, and the probability outside */
  double certain_weight;    /* of a solution, */
  double largest_sigma;     /* standard deviations over range and moment, */
  double largest_bend;      /* and how far chi-square may be from a parabola, with which errors are Gaussian */
  int64_t n_strengths;
  const double *strengths, *gained; /* (n_strengths), ascending: roots of energies, and what detection tells of them */
  double *covariance;               /* (n_fits, 6, 6), NaN where it is singular */
  double *weight;                   /* (n_fits), probability of a solution */
  double *ranges;                   /* (n_fits, most_fits, 2) radii, 95 % set of intervals, NaN behind them */
  uint8_t *gaussian;                /* (n_fits), whether the covariance describes the errors */
} magloc_source_uncertainty;
int64_t magloc_source_uncertainties(const magloc_source_uncertainty *problem, int64_t begin, int64_t end,
                                    double *workspace);

/* Sensors, as Cramer-Rao bounds see them. What readings depend on beside the source are nuisances of these kinds: 0 to
   2, a field that is common to all vector sensors; 3, a modulus common to all that read one; 4 to 6, the ambient
   field's error; 7 to 9 and 10 to 12, turns and shifts of the array; 13 and so on, errors of a body. */
typedef struct {
  int64_t n_sensors, n_channels, n_nuisances, n_errors;
  const double *ambient;        /* (n_sensors, 3) field */
  const uint8_t *is_modulus;    /* (n_sensors): such a sensor has one channel, others have three */
  const int64_t *first_channel; /* (n_sensors + 1) of each sensor */
  const double *gain;           /* (n_channels, 3), (g, 0, 0) of a modulus */
  const double *noise;          /* (n_channels) */
  int64_t noise_depends_on_field;
  const double *errors_of_sensor; /* (n_sensors, 3): sigma of its turns, part of the field that it induces in the
                                     carrier, part of the field that is noise */
  const double *gain_errors;      /* (n_channels, 3, 3): what sigma of the gain of each axis adds to the channel's */
  const int64_t *nuisances;       /* (n_nuisances), kinds, ascending */
  const double *prior;            /* (n_nuisances), one over the standard deviation, 0 where nothing is known */
  double modulus_prior;           /* the same of the moment's modulus */
  double lever_arm[3];            /* to the array's origin from the point about which it turns */
  double lost;                    /* a parameter of which the others leave less than this part is not known */
} magloc_bound_array;

/* Cramer-Rao bounds of sources: least standard deviations of any unbiased estimate from one set of readings; an item is
   a source. All places have the same moments, or each has its own; source n_moments * i + k is at place i. */
typedef struct {
  const magloc_bound_array *array;
  int64_t n_moments, moments_are_own;
  const double *sensors;     /* (n_sensors, 3) */
  double centroid[3];        /* from which ranges count */
  const double *positions;   /* (n_places, 3) */
  const double *moments;     /* (n_moments, 3) or (n_places, n_moments, 3) */
  const double *body_errors; /* (n_places, n_sensors, n_errors, 6): xx, xy, xz, yy, yz, zz of the matrices that make an
                                error's field of the moment */
  double *sigma_range, *sigma_bearing, *sigma_position; /* (n): infinite where they are not known */
  double *slopes; /* (n, n_sensors, 3): d log(sigma of the range)/d sensor, or NULL; for noise that depends on no field,
                     and no nuisances but common fields */
} magloc_bounds;
int64_t magloc_source_bounds(const magloc_bounds *problem, int64_t begin, int64_t end, double *workspace);

/* Filter that makes the noise of a survey white: measurements of unit noise, and states that decay and grow. The last
   two states are a value and its slope. An item is a row, all in order. */
typedef struct {
  int64_t n_states, n_measurements;
  const double *H;            /* (n_rows, n_measurements, n_states) */
  const double *kept, *added; /* (n_rows, n_states): part of each state that remains; growth of its variance */
  const double *dt;           /* (n_rows) */
  const double *start;        /* (n_states), variances before the first step */
  double *gains;              /* (n_rows, n_measurements, n_states + 1): Kalman gains, and the innovation's 1/sigma */
} magloc_survey_filter;
int64_t magloc_survey_gains(const magloc_survey_filter *problem, int64_t begin, int64_t end, double *workspace);

/* Innovations of columns over their standard deviation, by a filter whose gains are known; an item is a row of them,
   all in order. Rejected rows of the filter have columns of zeros. */
typedef struct {
  const magloc_survey_filter *filter;
  int64_t n_columns;
  const int64_t *rows; /* (n), ascending */
  double *columns;     /* (n, n_measurements, n_columns) */
} magloc_survey_whitening;
int64_t magloc_survey_whiten(const magloc_survey_whitening *problem, int64_t begin, int64_t end, double *workspace);

/* Columns that sources add to the measurements of a survey. A measurement is the sum over the rows of a group, divided
   by the root of their number; an item is a group. */
typedef struct {
  int64_t n_sensors, n_channels, n_measurements, n_sources;
  const double *sensors;            /* (n_rows, n_sensors, 3) */
  const double *directions;         /* (n_rows, n_channels, 3) that channels measure */
  const double *mixing;             /* (n_measurements, n_channels) */
  const int64_t *sensor_of_channel; /* (n_channels) */
  const double *sources, *moments;  /* (n_sources, 3); moments for survey_sources only, else NULL */
  const int64_t *first_row;         /* (n_groups + 1) of each group */
  const int64_t *groups;            /* (n) that are wanted */
  double *out;                      /* (n, n_measurements, size) */
} magloc_survey_columns;
/* Columns of moments of unit x, y and z: size 3 n_sources, by axis, then by source. */
int64_t magloc_survey_moments(const magloc_survey_columns *problem, int64_t begin, int64_t end, double *workspace);
/* Derivatives by position and moment: size 6 n_sources, by source. */
int64_t magloc_survey_sources(const magloc_survey_columns *problem, int64_t begin, int64_t end, double *workspace);
/* Columns of poles, whose field is d/r^3: size n_sources. */
int64_t magloc_survey_poles(const magloc_survey_columns *problem, int64_t begin, int64_t end, double *workspace);

/* Rows of readings of an array, as they depend on sources: n_readings combinations of channels, in units of their
   noise; a row of fewer ones has zeros behind them. */
typedef struct {
  int64_t n_sensors, n_channels, n_readings, n_nuisances, n_pose;
  const double *sensors; /* (n_sensors, 3) */
  double array_centroid[3], radius;
  const int64_t *sensor;           /* (n_channels) of each channel, ascending */
  const double *gain;              /* (n_channels, 3); of a modulus the first number counts */
  const uint8_t *is_modulus;       /* (n_channels) */
  const double *readings;          /* (n_rows, n_readings) */
  const int64_t *counts;           /* (n_rows) of readings */
  const double *transforms;        /* (n_transforms, n_readings, n_channels) from channels to readings */
  const int64_t *transform_of_row; /* (n_rows) */
  const double *effects;           /* (n_effects, n_readings, n_nuisances) of nuisances on readings */
  const int64_t *effect_of_row;    /* (n_rows) */
  const double *origins;           /* (n_rows, 3) of the array */
  const double *rotations;         /* (n_rows, 3, 3) to the world from the array */
  const double *ambients;          /* (n_ambients, n_sensors, 3) field */
  const int64_t *ambient_of_row;   /* (n_rows) */
  const double *pose_effects;      /* (n_rows, 12, n_pose) of errors of the pose on turn, place, lever arm, ambient */
  double lever_arm[3];             /* from the pose's reference point to the array's origin, in the array's axes */
  int64_t shape;                   /* of the sources, as of magloc_aligned_magnets */
  double size[3];
} magloc_rows;

/* Gaussians, each of the states of several sources: n_states numbers of each source, 6 (position and moment), 9 (the
   velocity as well) or more, and behind them nuisances: errors of the pose, then such as are linear in the readings.
   magloc/tracking/chart explains the chart. */
typedef struct {
  int64_t n_sources, n_states, n_nuisances;
  int64_t power; /* of the range, 0 or 4, with which moments grow along the chart */
  double firm;   /* share of a moment that is open, below which strength and direction are its coordinates */
  double *x;     /* (n, N) means, N = n_sources n_states + n_nuisances */
  double *roots; /* (n, N, N) of the covariances in the charts about them */
} magloc_sources;

/* Steps of a source: transition F and root of its noise, which are A + |m| B, or those of a rate of turn that lasts
   (n_states = 12, n_noise = 15). With `moved`, one step for each source of each Gaussian. */
typedef struct {
  int64_t n_noise;
  const double *F;       /* (n_steps, n_states, n_states) */
  const double *A, *B;   /* (n_steps, n_states, n_noise); B may be null */
  const double *moved;   /* (n, n_sources, n_states) after the steps, or null */
  const double *turning; /* (n_steps, 12), or null: part of a second that velocities last, part that is kept of them,
                            both of rates of turn; lower root (00, 10, 11) of the noise of position and velocity,
                            of turn and rate; noise of the moment, relative to it, across and along */
  const double *kept, *added; /* (n_steps, n_nuisances) of nuisances, and standard deviation of their noise; or null */
  const int64_t *step_of_row; /* (n_rows) */
} magloc_motion;

/* When an iterated update has converged. */
typedef struct {
  double tolerance;            /* of the next step, in standard deviations */
  double least_gain, rounding; /* a step that gains less, of what a linear problem would, is halved */
  int64_t max_iterations;
} magloc_convergence;

/* Prediction of all Gaussians to a row; an item is a Gaussian, as of the next problems. */
typedef struct {
  const magloc_sources *before, *after;
  const magloc_motion *motion;
  const magloc_rows *rows;
  int64_t row;
  double centroid[3]; /* of the sensors, before */
} magloc_row_prediction;
int64_t magloc_predict_row(const magloc_row_prediction *problem, int64_t begin, int64_t end, double *workspace);

/* Update of all Gaussians by a row. */
typedef struct {
  const magloc_sources *before, *after;
  const magloc_rows *rows;
  const magloc_convergence *convergence;
  int64_t row;
  const uint8_t *bends;     /* (n) whether predictions of sources and pose bend as the readings do, or null */
  const double *pose_lasts; /* (n_pose) share of each error of the pose with which they do, or null: all of it */
  double least_share;   /* standard deviation of a prediction below which what the readings tell of it does not count */
  double followed;      /* variance that readings have beside their noise in the test of sensors */
  double *nis, *chi2;   /* (n) least sum of squares, and the readings' part of it */
  double *log_evidence; /* (n) by Laplace's method, up to a constant */
  int64_t *iterations;  /* (n) */
  uint8_t *converged;   /* (n) */
  double *innovation;   /* (n, n_readings) whitened, or null */
  double *correction;   /* (n), with that: square by which readings move a prediction, in its sigma, less its mean */
  double *standardised; /* (n, n_sensors, 3) residuals of each sensor's channels, of unit covariance, or null */
  double *misfits;      /* (n, 2, n_readings) at the prediction and after the update, or null */
  double *projectors;   /* (n, 2, d, n_readings) Q of the same: I - Q^T Q is the readings' information; or null */
} magloc_row_update;
int64_t magloc_update_row(const magloc_row_update *problem, int64_t begin, int64_t end, double *workspace);

/* How far readings bend along axes of position and moment, over what a row leaves open of them, in sigma of as many
   rows as are remembered. */
typedef struct {
  const magloc_sources *sources;
  const magloc_rows *rows;
  int64_t row;
  double memory;
  double *bends;      /* (n, 6 n_sources) */
  double *directions; /* (n, 6 n_sources, N): one sigma of the whole state along each axis */
} magloc_row_bends;
int64_t magloc_bend_row(const magloc_row_bends *problem, int64_t begin, int64_t end, double *workspace);

/* Sources followed by one Gaussian, from a state before row progress[0] to the first row that does not continue their
   track; an item is one more row. */
typedef struct {
  const magloc_rows *rows;
  const magloc_motion *motion;
  const magloc_convergence *convergence;
  const double *nis_limits;    /* (n_readings + 1) by the number of readings, above which they contradict */
  double largest_width;        /* standard deviation of log-range and direction beyond which a source has no place */
  double largest_bend;         /* of readings, beyond which the state is not one Gaussian */
  int64_t longest_memory;      /* rows in which a bend is counted */
  double largest_growth;       /* of standard deviations in a step, beyond which the prediction does not bend, */
  int64_t full_count;          /* nor in rows of fewer readings, */
  double least_share;          /* nor along what readings tell of less, in its standard deviation */
  const magloc_sources *state; /* one: before the next row, and changed by calls, as are the next three */
  double *centroid;            /* (3) of the sensors there */
  double *open_loop;           /* (n_sources, n_states, n_states) covariance had no readings been taken */
  int64_t *progress;           /* (3): next row, 1 as long as the track continues, and updates that led to the state */
  const magloc_sources *predicted, *updated; /* by rows, where the track continues */
  double *means, *covariances;               /* (n_rows, n_sources, 6) and (.., 6, 6) of positions and moments */
  double *estimability;                      /* (n_rows, n_sources, 6): 1 - sigma / sigma without any readings */
  double *nis;                               /* (n_rows); NaN without readings */
  double *innovation, *correction;           /* (n_rows, n_readings) and (n_rows), as of magloc_row_update */
  int64_t *iterations;                       /* (n_rows) */
} magloc_track;
int64_t magloc_follow_sources(const magloc_track *problem, int64_t begin, int64_t end, double *workspace);

/* A filter and smoother along trajectories, linearised there, in the charts about them; an item is a trajectory. */
typedef struct {
  int64_t n_rows;
  const double *trajectories;  /* (n, n_rows, n_sources n_states + n_pose) */
  const magloc_sources *prior; /* before the first row: means are offsets in the chart about its state */
  const magloc_rows *rows;
  const magloc_motion *motion; /* to each row but the first; with `moved`, n_rows steps for each trajectory */
  double *offsets;             /* as trajectories: from these to the smoothed ones, in the charts */
  const magloc_sources *last;  /* after the last row; means are offsets, too */
  double *nis, *log_evidence;  /* (n) of all rows but the first, and of all */
} magloc_smoothing;
int64_t magloc_smooth_rows(const magloc_smoothing *problem, int64_t begin, int64_t end, double *workspace);

/* end of the declarations */
#ifdef __GNUC__
#pragma GCC visibility pop
#endif
#ifdef __cplusplus
}
#endif
#endif
