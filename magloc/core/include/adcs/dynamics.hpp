// Rotation of a satellite with wheels: adcs/satellite/dynamics.py is the readable reference and has the formulas.
#pragma once
#include "adcs/rotation.hpp"
#include "magloc/elementary.hpp"

MAGLOC_BEGIN
template <class Real = double>
struct Body {
  MatrixOf<Real> inertia, inverse_inertia;
};

// The attitude, orbital from body, and the rate against inertial space in body axes.
template <class T>
struct Motion {
  Quaternion<T> q;
  Vector<T> w;
};

// The momentum of the wheels, and the torque that drives them.
template <class T>
struct Wheels {
  Vector<T> momentum, torque;
};

// The rate of the orbit, the gravity mu/r^3, and the field in the orbital frame.
template <class T>
struct Surroundings {
  T orbital_rate, gravity;
  Vector<T> field;
};

// The rate against the orbital frame.
template <class T>
MAGLOC_INLINE Vector<T> relative_rate(const Motion<T> &motion, T orbital_rate) {
  return motion.w - orbital_rate * axis_back(motion.q, 1);
}

// The torque of the gravity gradient and of a dipole.
template <class Real, class T>
MAGLOC_INLINE Vector<T> environment_torque(const Body<Real> &body, const Vector<T> &dipole, const Quaternion<T> &q,
                                           const Surroundings<T> &around) {
  const Vector<T> eta = axis_back(q, 2);
  return 3.0 * around.gravity * cross(eta, body.inertia * eta) + cross(dipole, rotate_back(q, around.field));
}

template <class Real, class T>
MAGLOC_INLINE Vector<T> gyroscopic_torque(const Body<Real> &body, const Vector<T> &w, const Vector<T> &momentum) {
  return cross(w, momentum + body.inertia * w);
}

// The rate of change of a motion under a torque from outside besides those of the surroundings.
template <class Real, class T>
MAGLOC_INLINE Motion<T> slope(const Body<Real> &body, const Vector<T> &dipole, const Motion<T> &motion,
                              const Wheels<T> &wheels, const Vector<T> &torque, const Surroundings<T> &around) {
  const Vector<T> outside = torque + environment_torque(body, dipole, motion.q, around);
  const Vector<T> gyroscopic = gyroscopic_torque(body, motion.w, wheels.momentum);
  const Quaternion<T> rate = {T{}, 0.5 * relative_rate(motion, around.orbital_rate)};
  return {motion.q * rate, body.inverse_inertia * (outside - wheels.torque - gyroscopic)};
}

// One step of the classical Runge-Kutta method; torques, dipole and surroundings are held.
template <class Real, class T>
MAGLOC_INLINE void step(const Body<Real> &body, const Vector<T> &dipole, Motion<T> &motion, Wheels<T> &wheels,
                        const Vector<T> &torque, const Surroundings<T> &around, double dt) {
  const Vector<T> first_momentum = wheels.momentum;
  const double part[4] = {0.0, 0.5 * dt, 0.5 * dt, dt}, weight[4] = {dt / 6.0, dt / 3.0, dt / 3.0, dt / 6.0};
  Motion<T> sum = motion, rate;
  for (int stage = 0; stage < 4; ++stage) {
    Motion<T> there = motion;
    if (stage > 0) {
      there = {motion.q + part[stage] * rate.q, motion.w + part[stage] * rate.w};
      wheels.momentum = first_momentum + part[stage] * wheels.torque;
    }
    rate = slope(body, dipole, there, wheels, torque, around);
    sum = {sum.q + weight[stage] * rate.q, sum.w + weight[stage] * rate.w};
  }
  motion = {normalised(sum.q), sum.w};
}

// Proportional-derivative control of the wheels towards an attitude that rests in the orbital frame.
template <class Real = double>
struct Control {
  Vector<Real> attitude_gain, rate_gain;
  Real torque_limit, momentum_limit;
  Quaternion<Real> reference;
};

template <class T>
MAGLOC_INLINE T clipped(T x, double limit) {
  return choose(x > limit, broadcast<T>(limit), choose(x < -limit, broadcast<T>(-limit), x));
}

// The torque of the wheels until the next instant, within the limits of torque and momentum. The readable form is in
// tests/adcs/attitudes.py.
template <class Real, class T>
MAGLOC_INLINE Vector<T> commanded_torque(const Body<Real> &body, const Control<Real> &control, const Motion<T> &motion,
                                         const Vector<T> &momentum, T orbital_rate, double dt) {
  const Quaternion<T> reference = {broadcast<T>(control.reference.scalar), broadcast<T>(control.reference.vector)};
  const Vector<T> angle = error_vector(reference, motion.q), rate = relative_rate(motion, orbital_rate);
  const Vector<T> gyroscopic = gyroscopic_torque(body, motion.w, momentum);
  Vector<T> torque;
  for (int i = 0; i < 3; ++i) {
    const T wanted = control.attitude_gain[i] * angle[i] + control.rate_gain[i] * rate[i] - gyroscopic[i];
    const T next = momentum[i] + dt * clipped(wanted, control.torque_limit);
    torque[i] = (clipped(next, control.momentum_limit) - momentum[i]) / dt;
  }
  return torque;
}

// Hysteresis rods: adcs/satellite/magnetic_control.py is the readable reference.
struct Rods {
  const double *axes;  // (n, 3), unit vectors
  int64_t n;
  double coercivity, steepness, strength;  // H_c, k of the arc tangent, and the largest moment times 2/pi
};

// The field H that a rod has followed, and the field z that lags behind it.
template <class T>
struct Hysteresis {
  T followed, lagging;
};

// The moment of all rods after they have followed a field in body axes.
template <class T>
inline Vector<T> follow_field(const Rods &rods, const Vector<T> &field, Hysteresis<T> *states) {
  constexpr double mu0 = 4e-7 * 3.14159265358979323846;
  Vector<T> moment = {};
  for (int64_t i = 0; i < rods.n; ++i) {
    const double *axis = rods.axes + 3 * i;
    T &before = states[i].followed, &z = states[i].lagging;
    const T H = (axis[0] * field[0] + axis[1] * field[1] + axis[2] * field[2]) / mu0, change = H - before;
    const T way = choose(change < 0.0, broadcast<T>(-1.0), broadcast<T>(1.0));
    const T s = 0.5 + 0.5 * way * (before - z) / rods.coercivity;
    const T t = hyperbolic_tangent(0.5 * way * change / rods.coercivity);
    z = H - way * rods.coercivity * (2.0 * (s + t) / (1.0 + s * t) - 1.0);
    before = H;
    const T size = rods.strength * arc_tangent(rods.steepness * z);
    for (int k = 0; k < 3; ++k) moment[k] += size * axis[k];
  }
  return moment;
}

// The transposed Jacobian of the error's rate of change: row i is the rate (6) by the unit error i, with two zeros
// more. The error is (dq, dw) with half angles dq; the torque of the wheels is known.
template <class Real>
inline void transposed_error_jacobian(const Body<Real> &body, const Vector<Real> &dipole, const Motion<Real> &motion,
                                      const Vector<Real> &momentum, const Surroundings<Real> &around, Real (&F)[6][8]) {
  const Vector<Real> eta = axis_back(motion.q, 2), J_eta = body.inertia * eta;
  const Vector<Real> b = rotate_back(motion.q, around.field), total = momentum + body.inertia * motion.w;
  for (int i = 0; i < 3; ++i) {
    const Vector<Real> e = unit_vector<Real>(i), d_eta = cross(eta, e), turned = cross(e, motion.w);
    const Vector<Real> gradient = cross(d_eta, J_eta) + cross(eta, body.inertia * d_eta);
    const Vector<Real> torque = 6.0 * around.gravity * gradient + 2.0 * cross(dipole, cross(b, e));
    const Vector<Real> by_attitude = body.inverse_inertia * torque;
    const Vector<Real> gyroscopic = cross(total, e) - cross(motion.w, body.inertia * e);
    const Vector<Real> by_rate = body.inverse_inertia * gyroscopic;
    for (int j = 0; j < 3; ++j) {
      F[i][j] = turned[j];
      F[i][3 + j] = by_attitude[j];
      F[3 + i][j] = Real(0.5) * e[j];
      F[3 + i][3 + j] = by_rate[j];
    }
  }
  for (auto &row : F) row[6] = row[7] = 0;
}

// The same as the source paper has it: the torque of the wheels is that of a control which sees the true attitude,
// against the orbital frame, and rate. That is wrong, and here to reproduce the paper.
template <class Real>
inline void transposed_closed_loop_jacobian(const Body<Real> &body, const Control<Real> &control,
                                            const Motion<Real> &motion, Real gravity, Real (&F)[6][8]) {
  transposed_error_jacobian<Real>(body, {}, motion, {}, {0, gravity, {}}, F);
  const Real sign = motion.q.scalar < 0 ? -1 : 1;
  for (int i = 0; i < 3; ++i) {
    const Vector<Real> e = unit_vector<Real>(i);
    Vector<Real> by_attitude = sign * (motion.q.scalar * e + cross(motion.q.vector, e)), by_rate = e;
    for (int j = 0; j < 3; ++j) by_attitude[j] *= control.attitude_gain[j], by_rate[j] *= control.rate_gain[j];
    by_attitude = body.inverse_inertia * by_attitude, by_rate = body.inverse_inertia * by_rate;
    for (int j = 0; j < 3; ++j) F[i][3 + j] -= by_attitude[j], F[3 + i][3 + j] = -by_rate[j];
  }
}
MAGLOC_END
