// Runs of satellites: their rotation, and the filters that estimate it.
#include "adcs/dynamics.hpp"
#include "adcs/gate.hpp"
#include "magloc/kernel.hpp"

MAGLOC_BEGIN
// Several runs, one in each lane, of arrays (n_runs, n_instants, size). Lanes beyond the last run repeat it.
class Runs {
  int64_t first_row_[n_lanes<Lanes>];

 public:
  Runs(int64_t run, int64_t end, int64_t n_instants) {
    for (int lane = 0; lane < n_lanes<Lanes>; ++lane)
      first_row_[lane] = (run + lane < end ? run + lane : end - 1) * n_instants;
  }
  Lanes load(const double *array, int64_t instant, int size = 1, int column = 0) const {
    Lanes x{};
    for (int lane = 0; lane < n_lanes<Lanes>; ++lane)
      set_lane(x, lane, array[(first_row_[lane] + instant) * size + column]);
    return x;
  }
  Vector<Lanes> load_vector(const double *array, int64_t instant, int size = 3, int column = 0) const {
    return {{load(array, instant, size, column), load(array, instant, size, column + 1),
             load(array, instant, size, column + 2)}};
  }
  void store(double *array, int64_t instant, Lanes x, int size, int column) const {
    for (int lane = 0; lane < n_lanes<Lanes>; ++lane)
      array[(first_row_[lane] + instant) * size + column] = get_lane(x, lane);
  }
  void store(double *array, int64_t instant, const Vector<Lanes> &v, int size = 3, int column = 0) const {
    for (int i = 0; i < 3; ++i) store(array, instant, v[i], size, column + i);
  }
};

// Roll, pitch and yaw against the orbital frame, the rate against inertial space in body axes, and its integral.
struct SmallMotion {
  Vector<Lanes> angles, w, turned;
};

inline SmallMotion operator+(const SmallMotion &a, const SmallMotion &b) {
  return {a.angles + b.angles, a.w + b.w, a.turned + b.turned};
}
inline SmallMotion operator*(double scale, const SmallMotion &a) {
  return {scale * a.angles, scale * a.w, scale * a.turned};
}

inline SmallMotion slope(const Body<> &body, double orbital_rate, const SmallMotion &x, const Vector<Lanes> &torque) {
  const Vector<Lanes> orbit = {{x.angles[2], broadcast<Lanes>(1.0), -x.angles[0]}};
  return {x.w + orbital_rate * orbit, body.inverse_inertia * (torque - gyroscopic_torque(body, x.w, {})), x.w};
}

inline FilterModel<> model_of(const magloc_mekf &p, const Control<> *feedback) {
  FilterModel<> model = {{matrix_at(p.inertia), matrix_at(p.inverse_inertia)},
                         vector_at(p.residual_dipole),
                         {{(int)p.n_states, {}}},
                         {},
                         feedback,
                         {}};
  __builtin_memcpy(model.open_variance, p.open_variance, model.n() * sizeof(double));
  for (int k = 0; k < Optional::count; ++k) model.states.places.place[k] = (int)p.place[k];
  for (int k = 0; k < Sensor::count; ++k) model.variance[k] = p.sigma[k] * p.sigma[k];
  return model;
}

// row is a row of an array (n_runs, n_instants, ...).
inline Instant<> instant_at(const magloc_mekf &p, int64_t row) {
  return {{vector_at(p.momentum + 3 * row), vector_at(p.wheel_torque + 3 * row)},
          vector_at(p.torquers + 3 * row),
          {p.orbital_rate[row], p.gravity[row], vector_at(p.field_model + 3 * row)},
          vector_at(p.sun_model + 3 * row)};
}

inline Readings<> readings_at(const magloc_mekf &p, int64_t row) {
  Readings<> readings = {quaternion_at(p.star + 4 * row), matrix_at(p.star_whitening + 9 * row),
                         vector_at(p.gyro + 3 * row), vector_at(p.field + 3 * row), vector_at(p.sun + 3 * row)};
  if (!p.used[Sensor::star_tracker]) readings.star.scalar = nan;
  if (!p.used[Sensor::gyro]) readings.gyro[0] = nan;
  if (!p.used[Sensor::magnetometer]) readings.field[0] = nan;
  if (!p.used[Sensor::sun_sensor]) readings.sun[0] = nan;
  return readings;
}

inline void start(const magloc_mekf &p, const FilterModel<> &model, int64_t run, GatedFilter<> &filter) {
  Estimate<> first = {{quaternion_at(p.first_q + 4 * run), vector_at(p.first_w + 3 * run)}, {}};
  for (int k = 0; k < Optional::count; ++k)
    if (model.has(k)) first.optional[k] = vector_at(p.first_optional + run * (model.n() - 6) + model.place(k) - 6);
  filter.start(first);
  for (int i = 0; i < model.n(); ++i)
    for (int j = 0; j < model.n(); ++j)
      filter.main().P()[i][j] = p.first_covariance[(run * model.n() + i) * model.n() + j];
}

inline void store(const Hypothesis<> &found, const FilterModel<> &model, int64_t row, const magloc_mekf &p) {
  store(found.x.motion.q, p.q + 4 * row);
  store(found.x.motion.w, p.w + 3 * row);
  for (int k = 0; k < Optional::count; ++k)
    if (model.has(k)) store(found.x.optional[k], p.optional + row * (model.n() - 6) + model.place(k) - 6);
  for (int i = 0; i < model.n(); ++i)
    __builtin_memcpy(p.covariance + (row * model.n() + i) * model.n(), found.P()[i], model.n() * sizeof(double));
}
MAGLOC_END

using namespace magloc;

MAGLOC_KERNEL(attitude_motion_runs, attitude_motion) {
  const auto &p = *problem;
  Workspace room(workspace);
  auto *iron = room.take<Hysteresis<Lanes>>(p.n_rods);
  if (!workspace) return room.size();
  const Body<> body = {matrix_at(p.inertia), matrix_at(p.inverse_inertia)};
  const Control<> control = {vector_at(p.attitude_gain), vector_at(p.rate_gain), p.torque_limit, p.momentum_limit,
                             quaternion_at(p.reference)};
  const Rods rods = {p.rod_axes, p.n_rods, p.coercivity, p.steepness, p.rod_strength};
  for (int64_t run = begin; run < end; run += n_lanes<Lanes>) {
    const Runs runs(run, end, p.n_instants), rod_runs(run, end, p.n_rods);
    for (int64_t k = 0; k < p.n_rods; ++k)
      iron[k] = {rod_runs.load(p.rod_fields, k, 2, 0), rod_runs.load(p.rod_fields, k, 2, 1)};
    Motion<Lanes> motion = {{runs.load(p.q, p.first_instant, 4), runs.load_vector(p.q, p.first_instant, 4, 1)},
                            runs.load_vector(p.w, p.first_instant)};
    Wheels<Lanes> wheels = {runs.load_vector(p.momentum, p.first_instant), {}};
    for (int64_t i = p.first_instant;; ++i) {
      const Surroundings<Lanes> around = {runs.load(p.orbital_rate, i), runs.load(p.gravity, i),
                                          runs.load_vector(p.field, i)};
      wheels.torque = commanded_torque(body, control, motion, wheels.momentum, around.orbital_rate, p.dt);
      runs.store(p.q, i, motion.q.scalar, 4, 0);
      runs.store(p.q, i, motion.q.vector, 4, 1);
      runs.store(p.w, i, motion.w);
      runs.store(p.momentum, i, wheels.momentum);
      runs.store(p.wheel_torque, i, wheels.torque);
      if (i == p.last_instant) break;
      Vector<Lanes> dipole = runs.load_vector(p.dipole, i);
      if (p.n_rods > 0) {
        // The field at the middle of the step: the moment is held, too, and would lag by half a step more.
        const Vector<Lanes> b = rotate_back(motion.q, around.field), middle = b + 0.5 * p.dt * cross(b, motion.w);
        dipole += follow_field(rods, middle, iron);
      }
      step(body, dipole, motion, wheels, runs.load_vector(p.torque, i), around, p.dt);
    }
    for (int64_t k = 0; k < p.n_rods; ++k) {
      rod_runs.store(p.rod_fields, k, iron[k].followed, 2, 0);
      rod_runs.store(p.rod_fields, k, iron[k].lagging, 2, 1);
    }
  }
  return 0;
}

MAGLOC_KERNEL(small_motion_runs, small_motion) {
  if (!workspace) return 0;
  const auto &p = *problem;
  const Body<> body = {matrix_at(p.inertia), matrix_at(p.inverse_inertia)};
  for (int64_t run = begin; run < end; run += n_lanes<Lanes>) {
    const Runs runs(run, end, 1);
    SmallMotion x = {runs.load_vector(p.state, 0, 9), runs.load_vector(p.state, 0, 9, 3),
                     runs.load_vector(p.state, 0, 9, 6)};
    const Vector<Lanes> control = runs.load_vector(p.control, 0);
    for (int64_t i = 0; i < p.n_steps; ++i) {
      const double *disturbance = p.disturbance + 6 * i;
      const Vector<Lanes> at_begin = control + broadcast<Lanes>(vector_at(disturbance));
      const Vector<Lanes> at_middle = control + broadcast<Lanes>(vector_at(disturbance + 3));
      const Vector<Lanes> at_end = control + broadcast<Lanes>(vector_at(disturbance + 6));
      const SmallMotion k1 = slope(body, p.orbital_rate, x, at_begin);
      const SmallMotion k2 = slope(body, p.orbital_rate, x + 0.5 * p.dt * k1, at_middle);
      const SmallMotion k3 = slope(body, p.orbital_rate, x + 0.5 * p.dt * k2, at_middle);
      const SmallMotion k4 = slope(body, p.orbital_rate, x + p.dt * k3, at_end);
      x = x + p.dt / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4);
    }
    runs.store(p.state, 0, x.angles, 9);
    runs.store(p.state, 0, x.w, 9, 3);
    runs.store(p.state, 0, x.turned, 9, 6);
  }
  return 0;
}

MAGLOC_KERNEL(mekf_runs, mekf) {
  const auto &p = *problem;
  Workspace room(workspace);
  auto *filter = room.take<GatedFilter<>>(1);
  if (!workspace) return room.size();
  const Control<> feedback = {vector_at(p.attitude_gain), vector_at(p.rate_gain), 0.0, 0.0, {}};
  const FilterModel<> model = model_of(p, p.has_feedback ? &feedback : nullptr);
  Gate gate = {p.gate_limit, {}};
  for (int k = 0; k < Sensor::count; ++k) gate.patience[k] = p.patience[k];
  const int64_t first = p.n_before > 0 ? p.n_before - 1 : 0;
  for (int64_t row = begin; row < end; ++row) {
    const int64_t run = row / p.n_instants, i = row % p.n_instants, step = (i - 1) * model.n();
    const Instant<> now = instant_at(p, row);
    if (i == 0 && p.n_before > 0) continue;
    if (i == 0)
      start(p, model, run, *filter);
    else
      filter->predict(model, instant_at(p, row - 1), now, p.kept + step, p.added_variance + step, p.dt[i - 1]);
    filter->update(model, gate, now, readings_at(p, row), first + i, p.nis + 4 * row, p.log_determinant + 4 * row,
                   p.rejected + 4 * row);
    store(filter->main(), model, row, p);
  }
  return 0;
}
