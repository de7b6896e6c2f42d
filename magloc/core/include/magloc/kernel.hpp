// The list of kernels, and how one is defined for an instruction set.
#pragma once
#include "../magloc.h"
#include "numbers.hpp"

// X(kernel, problem)
#define MAGLOC_KERNELS(X)                     \
  X(dipole_fields, dipoles)                   \
  X(dipole_gradients, dipoles)                \
  X(shape_fields, magnets)                    \
  X(star_search, star_triangles)              \
  X(complementary_filter, complementary)      \
  X(adaptive_filter, adaptive)                \
  X(gyro_attitudes, gyro)                     \
  X(level_attitudes, level)                   \
  X(low_pass, butterworth)                    \
  X(lag_changes, lags)                        \
  X(heading_filter, heading)                  \
  X(heading_smoother, heading)                \
  X(attitude_filter, attitude)                \
  X(attitude_motion_runs, attitude_motion)    \
  X(small_motion_runs, small_motion)          \
  X(ellipsoids_predict, ellipsoids)           \
  X(ellipsoids_correct, ellipsoids)           \
  X(mekf_runs, mekf)                          \
  X(filter_starts, starts)                    \
  X(refine, refinement)                       \
  X(refine_poses, pose_refinement)            \
  X(search_poses, pose_search)                \
  X(follow_body, pose_track)                  \
  X(candidate_bases, candidate_positions)     \
  X(choose_candidates, candidate_choice)      \
  X(search_optima, search)                    \
  X(source_uncertainties, source_uncertainty) \
  X(source_bounds, bounds)                    \
  X(survey_gains, survey_filter)              \
  X(survey_whiten, survey_whitening)          \
  X(survey_moments, survey_columns)           \
  X(survey_sources, survey_columns)           \
  X(survey_poles, survey_columns)             \
  X(predict_row, row_prediction)              \
  X(update_row, row_update)                   \
  X(bend_row, row_bends)                      \
  X(smooth_rows, smoothing)                   \
  X(follow_sources, track)

#define MAGLOC_JOIN_(a, b, c) magloc_##a##_##b##c
#define MAGLOC_JOIN(a, b, c) MAGLOC_JOIN_(a, b, c)
// Define the kernel of this instruction set: MAGLOC_KERNEL(dipole_fields, dipoles) { ... return 0; }
#define MAGLOC_KERNEL(name, problem_type)                                                                              \
  extern "C" int64_t MAGLOC_JOIN(name, MAGLOC_ISA, )(const magloc_##problem_type *problem, int64_t begin, int64_t end, \
                                                     double *workspace)

MAGLOC_BEGIN
// The caller's workspace, handed out in pieces that start at multiples of 64 bytes. With a null pointer it only counts.
class Workspace {
  double *start_;
  int64_t used_ = 0;

 public:
  explicit Workspace(double *memory) : start_(memory) {
    if (memory) start_ += (64 - (uintptr_t)memory % 64) % 64 / sizeof(double);
  }
  template <class T>
  T *take(int64_t count) {
    T *piece = start_ ? reinterpret_cast<T *>(start_ + used_) : nullptr;
    used_ += (count * (int64_t)sizeof(T) + 63) / 64 * 8;
    return piece;
  }
  int64_t size() const { return used_ + 8; }
};
MAGLOC_END
