// Functions of the headers as test_headers.py calls them; -DMAGLOC_LANES=4 computes four numbers at a time.
#include "adcs/gate.hpp"

using namespace magloc;

namespace {
template <class Function> void map(const double *x, double *y, int n, Function f) {
  for (int i = 0; i < n; i += n_lanes<Lanes>) {
    Lanes lanes{};
    for (int lane = 0; lane < n_lanes<Lanes>; ++lane) set_lane(lanes, lane, x[i + lane < n ? i + lane : n - 1]);
    lanes = f(lanes);
    for (int lane = 0; lane < n_lanes<Lanes> && i + lane < n; ++lane) y[i + lane] = get_lane(lanes, lane);
  }
}
Vector<double> vector_at(const double *v) { return {{v[0], v[1], v[2]}}; }
Quaternion<double> quaternion_at(const double *q) { return {q[0], vector_at(q + 1)}; }
Matrix matrix_at(const double *m) { return {{vector_at(m), vector_at(m + 3), vector_at(m + 6)}}; }
void put(const Quaternion<double> &q, double *out) {
  out[0] = q.scalar;
  for (int i = 0; i < 3; ++i) out[1 + i] = q.vector[i];
}
}  // namespace

extern "C" {
void arc_tangents(const double *x, double *y, int n) {
  map(x, y, n, [](Lanes lanes) { return arc_tangent(lanes); });
}
void hyperbolic_tangents(const double *x, double *y, int n) {
  map(x, y, n, [](Lanes lanes) { return hyperbolic_tangent(lanes); });
}
void logarithms(const double *x, double *y, int n) {
  for (int i = 0; i < n; ++i) y[i] = logarithm(x[i]);
}
void turn_onto(const double *q, const double *body, const double *reference, double *out) {
  put(turned_onto(quaternion_at(q), vector_at(body), vector_at(reference)), out);
}
void turn_about(const double *q, const double *axis, const double *body, const double *reference, double *out) {
  put(turned_about(quaternion_at(q), vector_at(axis), vector_at(body), vector_at(reference)), out);
}
void jacobian(const double *inertia, const double *inverse, const double *dipole, const double *q, const double *w,
              const double *momentum, double gravity, const double *field, double *out) {
  double F[6][8];
  transposed_error_jacobian({matrix_at(inertia), matrix_at(inverse)}, vector_at(dipole),
                            {quaternion_at(q), vector_at(w)}, vector_at(momentum), {0.0, gravity, vector_at(field)}, F);
  for (int i = 0; i < 6; ++i)
    for (int j = 0; j < 6; ++j) out[6 * j + i] = F[i][j];
}
// One step of a filter, as a microcontroller calls it.
void filter_step(Hypothesis *filter, const FilterModel *model, const Instant *now, const Instant *next,
                 const Readings *readings, const double *kept, const double *added_variance, double dt) {
  filter->predict(*model, *now, *next, kept, added_variance, dt);
  filter->begin_readings();
  for (int sensor = 0; sensor < Sensor::count; ++sensor)
    if (filter->update(*model, *next, *readings, sensor).eased > 30.0) filter->undo();
  filter->correct(*model);
}
}
