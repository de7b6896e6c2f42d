// Multiplicative (error-state) Kalman filter of attitude and rate: one prediction, and one update by a reading.
// adcs/kalman/mekf.py is the readable reference and has the formulas. Nothing is allocated; a microcontroller runs it.
//
// Readings are taken one scalar after the other, all linearised at the predicted state, which for independent noise is
// the update of all at once without a matrix to invert. The covariance of an update is in Joseph's form.
#pragma once
#include "adcs/dynamics.hpp"

MAGLOC_BEGIN
struct Sensor {
  enum { star_tracker, gyro, magnetometer, sun_sensor, count };
};
// Optional states, each of three numbers; the gain matrix D of the magnetometer is three rows.
struct Optional {
  enum { field_bias, gyro_bias, disturbance, field_model, dipole, field_gain, count = field_gain + 3 };
};

// Numbers of the error state - attitude, rate, and the optional states in use -, and the place of each optional state
// in it, or -1.
struct StatePlaces {
  int n, place[Optional::count];
};

// Optional states that are chosen when the program runs.
struct RuntimeStates {
  static constexpr int most = 6 + 3 * Optional::count;
  static constexpr bool may_close_loop = true;
  StatePlaces places;
};

// Optional states that are chosen when the program is compiled. A field gain has three equal rows: the first represents
// all.
template <int... chosen>
constexpr StatePlaces places_of() {
  StatePlaces found = {6, {}};
  for (int k = 0; k < Optional::count; ++k) {
    const bool is_chosen = ((chosen == (k < Optional::field_gain ? k : Optional::field_gain)) || ...);
    found.place[k] = is_chosen ? found.n : -1;
    if (is_chosen) found.n += 3;
  }
  return found;
}
template <int... chosen>
struct FixedStates {
  static constexpr StatePlaces places = places_of<chosen...>();
  static constexpr int most = places.n;
  static constexpr bool may_close_loop = false;
};

// Rows of matrices are computed four numbers at a time; those beyond the last number are zero.
template <class States>
constexpr int row_length = (States::most + 3) / 4 * 4;
template <class Real, class States>
using Covariance = Real[States::most][row_length<States>];

// Constant inputs of a filter.
template <class Real = double, class States = RuntimeStates>
struct FilterModel {
  Body<Real> body;
  Vector<Real> residual_dipole;
  States states;
  Real variance[Sensor::count];
  const Control<Real> *feedback;     // taken for dynamics as in the source paper, or null: the wheels' torque is known
  Real open_variance[States::most];  // of an error state of which nothing is known

  int n() const { return states.places.n; }
  int place(int optional) const { return states.places.place[optional]; }
  bool has(int optional) const { return place(optional) >= 0; }
  int width() const { return (n() + 3) / 4 * 4; }
};

// Inputs of a filter at one instant, besides the readings.
template <class Real = double>
struct Instant {
  Wheels<Real> wheels;
  Vector<Real> torquers;  // their dipole
  Surroundings<Real> around;
  Vector<Real> sun;  // orbital frame
};

template <class Real = double>
struct Readings {
  Quaternion<Real> star;
  MatrixOf<Real> star_whitening;  // makes the errors of its three angles alike
  Vector<Real> gyro, field, sun;

  Real first_number(int sensor) const {
    const Real numbers[Sensor::count] = {star.scalar, gyro[0], field[0], sun[0]};
    return numbers[sensor];
  }
};

template <class Real = double>
struct Estimate {
  Motion<Real> motion;
  Vector<Real> optional[Optional::count];  // zero where it is not in use
};

// A row of H by its numbers that may differ from zero.
template <class Real>
struct SparseRow {
  int n = 0, column[10];
  Real value[10];

  void add(int at, Real number) { column[n] = at, value[n++] = number; }
  void add(int at, const Vector<Real> &numbers) {
    for (int k = 0; k < 3; ++k) add(at + k, numbers[k]);
  }
};

// A reading linearised at a state: residual = H error + noise.
template <class Real>
struct Measurement {
  Vector<Real> residual;
  SparseRow<Real> H[3];
  Real length;  // of a direction or field, else 0
};

// Normalised innovation squared of a reading, the same with the error of linearising as noise, and log|S| of the
// innovation in units of the noise.
struct Fit {
  double nis, eased, log_determinant;
};

template <class Real, class States>
inline Measurement<Real> linearised(const FilterModel<Real, States> &model, const Estimate<Real> &x,
                                    const Instant<Real> &now, const Readings<Real> &readings, int sensor) {
  const Quaternion<Real> &q = x.motion.q;
  Measurement<Real> m;
  m.length = 0;
  if (sensor == Sensor::star_tracker) {
    m.residual = readings.star_whitening * error_vector(q, readings.star);
    for (int j = 0; j < 3; ++j) m.H[j].add(0, readings.star_whitening.row[j]);
    return m;
  }
  if (sensor == Sensor::gyro) {
    m.residual = readings.gyro - x.motion.w - x.optional[Optional::gyro_bias];
    for (int j = 0; j < 3; ++j) {
      m.H[j].add(3 + j, 1.0);
      if (model.has(Optional::gyro_bias)) m.H[j].add(model.place(Optional::gyro_bias) + j, 1.0);
    }
    return m;
  }
  if (sensor == Sensor::sun_sensor) {
    const Vector<Real> sun = rotate_back(q, now.sun);
    m.residual = readings.sun - sun;
    for (int j = 0; j < 3; ++j) m.H[j].add(0, 2.0 * cross(unit_vector<Real>(j), sun));
    m.length = square_root(dot(sun, sun));
    return m;
  }
  const Vector<Real> field = rotate_back(q, now.around.field + x.optional[Optional::field_model]);
  m.residual = readings.field - field - x.optional[Optional::field_bias];
  m.length = square_root(dot(field, field));
  for (int j = 0; j < 3; ++j) {
    const Vector<Real> &deviation = x.optional[Optional::field_gain + j], gain = unit_vector<Real>(j) + deviation;
    m.residual[j] -= dot(deviation, field);
    m.H[j].add(0, 2.0 * cross(gain, field));
    if (model.has(Optional::field_bias)) m.H[j].add(model.place(Optional::field_bias) + j, 1.0);
    if (model.has(Optional::field_gain)) m.H[j].add(model.place(Optional::field_gain) + 3 * j, field);
    if (model.has(Optional::field_model))
      for (int k = 0; k < 3; ++k) m.H[j].add(model.place(Optional::field_model) + k, dot(gain, axis_back(q, k)));
  }
  return m;
}

// y += a x, for rows whose length is a multiple of four.
template <class Real>
MAGLOC_INLINE void add_scaled(int length, Real a, const Real *__restrict x, Real *__restrict y) {
  for (int j = 0; j < length; j += 4)
    for (int k = 0; k < 4; ++k) y[j + k] += a * x[j + k];
}

// z = x - a y, for the same rows.
template <class Real>
MAGLOC_INLINE void subtract_scaled(int length, const Real *__restrict x, Real a, const Real *__restrict y,
                                   Real *__restrict z) {
  for (int j = 0; j < length; j += 4)
    for (int k = 0; k < 4; ++k) z[j + k] = x[j + k] - a * y[j + k];
}

// The innovation of a scalar, and its variance.
template <class Real>
struct Innovation {
  Real value, variance;
};

// Update covariance and correction by a scalar with noise of variance r; the results may replace P and dx.
template <class Real, int rows, int columns>
inline Innovation<Real> scalar_update(int n, int width, const SparseRow<Real> &h, Real residual, Real r,
                                      const Real (&P)[rows][columns], const Real *dx, Real (&new_P)[rows][columns],
                                      Real *new_dx) {
  Real PHt[columns] = {}, A[columns];
  Innovation<Real> innovation = {residual, r};
  for (int k = 0; k < h.n; ++k) {
    add_scaled(width, h.value[k], P[h.column[k]], PHt);
    innovation.value -= h.value[k] * dx[h.column[k]];
  }
  for (int k = 0; k < h.n; ++k) innovation.variance += h.value[k] * PHt[h.column[k]];
  const Real inverse = 1 / innovation.variance, scaled = innovation.value * inverse;
  for (int i = 0; i < n; ++i) new_dx[i] = dx[i] + PHt[i] * scaled;
  // Row i of A = (E - K h) P, and then of A (E - K h)^T + K r K^T = A - (A h^T - K r) K^T: what is left of a direction
  // that the reading fixes is not the difference of large numbers.
  for (int i = 0; i < n; ++i) {
    const Real gain = PHt[i] * inverse;
    subtract_scaled(width, P[i], gain, PHt, A);
    Real rest = -r * gain;
    for (int k = 0; k < h.n; ++k) rest += h.value[k] * A[h.column[k]];
    subtract_scaled(width, A, rest * inverse, PHt, new_P[i]);
  }
  return innovation;
}

// An estimate with its covariance, and the correction by the readings of an instant that were taken so far.
template <class Real = double, class States = RuntimeStates>
class Hypothesis {
  typedef FilterModel<Real, States> Model;
  Covariance<Real, States> P_[2];
  Real dx_[2][row_length<States>];
  int current_ = 0;  // the other half is what they were before the last reading
  Real attitude_variance_;

 public:
  Estimate<Real> x;

  Covariance<Real, States> &P() { return P_[current_]; }
  const Covariance<Real, States> &P() const { return P_[current_]; }

  // Start from an estimate of which nothing is known yet.
  void start(const Estimate<Real> &first) {
    x = first;
    current_ = 0;
    __builtin_memset(P_, 0, sizeof P_);
    __builtin_memset(dx_, 0, sizeof dx_);
  }

  // Go to the next instant by the equations of motion; kept (n) and added variance (n) are those of the step.
  void predict(const Model &model, const Instant<Real> &now, const Instant<Real> &next, const Real *kept,
               const Real *added_variance, double dt) {
    decay(model, kept);
    const Vector<Real> own_dipole = model.residual_dipole + x.optional[Optional::dipole];
    const Vector<Real> dipole = own_dipole + now.torquers;
    Real F[6][8], next_F[6][8];
    linearise(model, dipole, now, F);
    const Vector<Real> b = rotate_back(x.motion.q, now.around.field);
    Wheels<Real> wheels = now.wheels;
    step(model.body, dipole, x.motion, wheels, model.body.inertia * x.optional[Optional::disturbance], now.around, dt);
    linearise(model, own_dipole + next.torquers, next, next_F);
    for (int i = 0; i < 6; ++i)
      for (int j = 0; j < 8; ++j) F[i][j] = Real(0.5) * (F[i][j] + next_F[i][j]);
    const Vector<Real> mean_b = 0.5 * (b + rotate_back(x.motion.q, next.around.field));
    propagate(model, F, mean_b, added_variance, Real(dt));
  }

  // Keep the variance of the attitude, by which readings are linearised.
  void keep_attitude_variance() { attitude_variance_ = P()[0][0] + P()[1][1] + P()[2][2]; }

  // Prepare for the readings of an instant.
  void begin_readings() {
    keep_attitude_variance();
    __builtin_memset(dx_[current_], 0, sizeof dx_[current_]);
  }

  // Take a reading into covariance and correction, and return how it fits.
  Fit update(const Model &model, const Instant<Real> &now, const Readings<Real> &readings, int sensor) {
    const Measurement<Real> m = linearised(model, x, now, readings, sensor);
    const Real r = model.variance[sensor];
    const int before = current_, after = 1 - current_;
    double nis = 0.0, determinant = 1.0;
    for (int j = 0; j < 3; ++j) {
      const int from = j == 0 ? before : after;
      const Innovation<Real> innovation =
          scalar_update(model.n(), model.width(), m.H[j], m.residual[j], r, P_[from], dx_[from], P_[after], dx_[after]);
      nis += innovation.value * innovation.value / innovation.variance;
      determinant *= innovation.variance / r;
    }
    current_ = after;
    for (int i = 1; i < model.n(); ++i)
      for (int j = 0; j < i; ++j) P()[j][i] = P()[i][j];
    const double linearisation = 2.0 * attitude_variance_ * m.length;
    return {nis, nis * r / (r + linearisation * linearisation), logarithm(determinant)};
  }

  // Undo the last reading.
  void undo() { current_ = 1 - current_; }

  // Put the correction into the estimate.
  void correct(const Model &model) {
    const Real *dx = dx_[current_];
    const Vector<Real> turn = {{dx[0], dx[1], dx[2]}};
    const Real square = dot(turn, turn), scalar = square < 1 ? square_root(1 - square) : Real(0);
    const Quaternion<Real> delta = {scalar, (square > 1 ? 1 / square_root(square) : Real(1)) * turn};
    x.motion.q = normalised(x.motion.q * delta);
    for (int j = 0; j < 3; ++j) {
      x.motion.w[j] += dx[3 + j];
      for (int k = 0; k < Optional::count; ++k)
        if (model.has(k)) x.optional[k][j] += dx[model.place(k) + j];
    }
  }

 private:
  // The transposed Jacobian of the error's rate of change at an instant.
  void linearise(const Model &model, const Vector<Real> &dipole, const Instant<Real> &at, Real (&F)[6][8]) const {
    if constexpr (States::may_close_loop)
      if (model.feedback)
        return transposed_closed_loop_jacobian(model.body, *model.feedback, x.motion, at.around.gravity, F);
    transposed_error_jacobian(model.body, dipole, x.motion, at.wheels.momentum, at.around, F);
  }

  // Shrink the states that have a time constant.
  void decay(const Model &model, const Real *kept) {
    for (int k = 0; k < Optional::count; ++k)
      for (int j = 0; model.has(k) && j < 3; ++j) {
        const int at = model.place(k) + j;
        if (!(kept[at] < 1)) continue;
        x.optional[k][j] *= kept[at];
        for (int i = 0; i < model.n(); ++i) P()[at][i] *= kept[at], P()[i][at] *= kept[at];
      }
  }

  // P = Phi P Phi^T + Q with Phi = E + F dt + (F dt)^2/2 + (F dt)^3/6, of which the first six rows differ from E.
  void propagate(const Model &model, const Real (&F)[6][8], const Vector<Real> &b, const Real *added_variance,
                 Real dt) {
    // Columns of those rows that are not zero: attitude and rate, disturbance, dipole.
    Real columns[12][8] = {};
    int at[12] = {0, 1, 2, 3, 4, 5}, n_columns = 6;
    Real F2[6][8] = {}, F3[6][8] = {};
    for (int i = 0; i < 6; ++i)
      for (int k = 0; k < 6; ++k) add_scaled(8, F[i][k], F[k], F2[i]);
    for (int i = 0; i < 6; ++i)
      for (int k = 0; k < 6; ++k) add_scaled(8, F2[i][k], F[k], F3[i]);
    const Real half = dt * dt / 2, sixth = dt * dt * dt / 6;
    for (int i = 0; i < 6; ++i) {
      columns[i][i] = 1;
      for (int j = 0; j < 8; ++j) columns[i][j] += dt * F[i][j] + half * F2[i][j] + sixth * F3[i][j];
    }
    Real by_acceleration[3][8] = {};
    for (int i = 0; i < 3; ++i) {
      by_acceleration[i][3 + i] = dt;
      for (int j = 0; j < 8; ++j) by_acceleration[i][j] += half * F[3 + i][j] + sixth * F2[3 + i][j];
    }
    if (model.has(Optional::disturbance))
      for (int i = 0; i < 3; ++i, ++n_columns) {
        at[n_columns] = model.place(Optional::disturbance) + i;
        add_scaled(8, Real(1), by_acceleration[i], columns[n_columns]);
      }
    if (model.has(Optional::dipole))
      for (int i = 0; i < 3; ++i, ++n_columns) {
        at[n_columns] = model.place(Optional::dipole) + i;
        const Vector<Real> acceleration = model.body.inverse_inertia * cross(unit_vector<Real>(i), b);
        for (int k = 0; k < 3; ++k) add_scaled(8, acceleration[k], by_acceleration[k], columns[n_columns]);
      }
    const int n = model.n(), width = model.width();
    Covariance<Real, States> &P = P_[current_];
    Real product[6][row_length<States>] = {};  // first rows of Phi P
    for (int i = 0; i < 6; ++i)
      for (int c = 0; c < n_columns; ++c) add_scaled(width, columns[c][i], P[at[c]], product[i]);
    for (int i = 0; i < 6; ++i) {
      Real row[8] = {};
      for (int c = 0; c < n_columns; ++c) add_scaled(8, product[i][at[c]], columns[c], row);
      for (int j = 0; j <= i; ++j) P[i][j] = P[j][i] = row[j];
      for (int j = 6; j < n; ++j) P[i][j] = P[j][i] = product[i][j];
    }
    for (int i = 0; i < n; ++i) P[i][i] += added_variance[i];
  }
};
MAGLOC_END
