// Functions of the headers as test_headers.py calls them.
#include "adcs/gate.hpp"

using namespace magloc;

extern "C" {
void turn_onto(const double *q, const double *body, const double *reference, double *out) {
  store(turned_onto(quaternion_at(q), vector_at(body), vector_at(reference)), out);
}
void turn_about(const double *q, const double *axis, const double *body, const double *reference, double *out) {
  store(turned_about(quaternion_at(q), vector_at(axis), vector_at(body), vector_at(reference)), out);
}
void jacobian(const double *inertia, const double *inverse, const double *dipole, const double *q, const double *w,
              const double *momentum, double gravity, const double *field, double *out) {
  double F[6][8];
  transposed_error_jacobian({matrix_at(inertia), matrix_at(inverse)}, vector_at(dipole),
                            {quaternion_at(q), vector_at(w)}, vector_at(momentum), {0.0, gravity, vector_at(field)}, F);
  for (int i = 0; i < 6; ++i)
    for (int j = 0; j < 6; ++j) out[6 * j + i] = F[i][j];
}
void closed_loop_jacobian(const double *inertia, const double *inverse, const double *attitude_gain,
                          const double *rate_gain, const double *q, const double *w, double gravity, double *out) {
  double F[6][8];
  transposed_closed_loop_jacobian({matrix_at(inertia), matrix_at(inverse)},
                                  {vector_at(attitude_gain), vector_at(rate_gain), 0.0, 0.0, {}},
                                  {quaternion_at(q), vector_at(w)}, gravity, F);
  for (int i = 0; i < 6; ++i)
    for (int j = 0; j < 6; ++j) out[6 * j + i] = F[i][j];
}
// One step of a filter, as a microcontroller calls it.
void filter_step(Hypothesis<> *filter, const FilterModel<> *model, const Instant<> *now, const Instant<> *next,
                 const Readings<> *readings, const double *kept, const double *added_variance, double dt) {
  filter->predict(*model, *now, *next, kept, added_variance, dt);
  filter->begin_readings();
  for (int sensor = 0; sensor < Sensor::count; ++sensor)
    if (filter->update(*model, *next, *readings, sensor).eased > 30.0) filter->undo();
  filter->correct(*model);
}
}
