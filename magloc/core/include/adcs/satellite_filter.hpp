// Attitude of a satellite by an error-state Kalman filter, one reading at a time: no heap, no library, float or double.
//
//     adcs::SatelliteFilter<double, adcs::State::gyro_bias> filter(config);
//     adcs::SatelliteReadings<double> now = {};
//     now.star = q, now.gyro_rad_s = rate;
//     if (filter.update(time_s, now, orbit) == adcs::Status::ok) use(filter.estimate());
//
// The states after the kind of number are estimated besides attitude and rate. adcs/kalman/satellite_filter.py is the
// same filter in Python. A filter is a plain struct: its bytes are its state, and a copy of them resumes bit for bit.
#pragma once
#include "adcs/gate.hpp"
#include "adcs/satellite_config.hpp"
#include "adcs/status.hpp"
#include "magloc/linear.hpp"

MAGLOC_BEGIN
template <class Real, int... chosen>
class SatelliteFilter {
  typedef FixedStates<chosen...> States;
  static constexpr double mu = 3.986004418e14, silent_s = 60.0, patience_s = 300.0, same_step = 1e-6;
  static constexpr double largest_time = 1e14, most_steps = 1e5;
  static constexpr double again = 10.0, open_rad = 2.0, known_rad = 1.3089969389957472,
                          open_rate = 0.008726646259971648;

 public:
  static constexpr uint32_t version = 1;  // of the state's bytes
  static constexpr int n = States::most;  // numbers of the error state

  void start(const SatelliteConfig<Real> &config) {
    __builtin_memset(static_cast<void *>(this), 0, sizeof *this);
    config_ = config;
    const Vector<Real> *const J = model_.body.inertia.row;
    for (int i = 0; i < 3; ++i) model_.body.inertia.row[i] = vector(config.inertia_kgm2[i]);
    for (int i = 0; i < 3; ++i) {
      const Vector<Real> column = cross(J[(i + 1) % 3], J[(i + 2) % 3]);
      const Real scale = 1 / dot(J[i], column);
      for (int j = 0; j < 3; ++j) model_.body.inverse_inertia.row[j][i] = scale * column[j];
    }
    model_.residual_dipole = vector(config.residual_dipole_Am2);
    const Real sigma[Sensor::count] = {
        config.sigma_star, config.sigma_gyro_rad_s,
        length(config.sigma_field_T, has(Optional::field_model) ? 0 : config.field_error_T), config.sigma_sun};
    for (int k = 0; k < Sensor::count; ++k) {
      model_.variance[k] = sigma[k] * sigma[k];
      const double instants = patience_s / config.step_s + 0.5;
      gate_.patience[k] = k == Sensor::gyro ? ContestRules::patient_readings : (int64_t)instants;
    }
    gate_.limit = config.gate_limit;
    for (int i = 0; i < 6; ++i) model_.open_variance[i] = Real(i < 3 ? open_rad * open_rad / 4 : open_rate * open_rate);
    for_each_number(
        [&](int state, int j, int at) { model_.open_variance[at] = start_sigma(state, j) * start_sigma(state, j); });
    restart();
  }
  explicit SatelliteFilter(const SatelliteConfig<Real> &config) noexcept { start(config); }
  SatelliteFilter() noexcept : SatelliteFilter(SatelliteConfig<Real>{}) {}

  const SatelliteEstimate<Real, n> &estimate() const { return estimate_; }
  double time_s() const { return time_; }

  // Covariance of a small rotation about the body's axes (rad), of the rate, and of the states.
  Real covariance(int i, int j) const { return filter_.main().P()[i][j] * Real((i < 3 ? 2 : 1) * (j < 3 ? 2 : 1)); }

  // Take the readings of a time, in rad/s, T, N m s and A m^2. A time that does not ascend or is beyond 1e14 s, a
  // reading that is infinite, beyond all sensors, or a direction of no length, and an orbit that is not one change
  // nothing. After a step that is longer than a usual one, surroundings between are interpolated linearly.
  Status update(double time_s, const SatelliteReadings<Real> &given, const OrbitPoint<Real> &at) {
    if (!(time_s >= -largest_time && time_s <= largest_time) || (is_begun_ && !(time_s > time_)))
      return Status::bad_time;
    Instant<Real> next = now_;
    Readings<Real> readings = {};
    Quaternion<Real> orbital;
    if (!set_surroundings(at, next, orbital)) return Status::bad_orbit;
    const bool is_late = is_begun_ && time_s - time_ > longest_step();
    if (is_late) next.wheels = {}, next.torquers = {};
    const bool has_momentum = has_momentum_ && !is_late;
    const Status status = read(given, orbital, readings, next);
    if (status != Status::ok) return status;
    Vector<Real> momentum;
    const bool is_momentum_read = copy(given.wheels_Nms, momentum);
    if (is_late) restart();
    // The momentum before its first reading is that reading.
    if (is_momentum_read && !has_momentum) now_.wheels.momentum = momentum;
    has_momentum_ = has_momentum || is_momentum_read;
    for (int k = 0; k < Sensor::count; ++k)
      if (!is_begun_ || is_finite(readings.first_number(k))) read_s_[k] = time_s;
    const double before = time_;
    is_begun_ = true, time_ = time_s;
    leave_out_unused(readings);
    rejected_ = 0;
    for (double &nis : estimate_.nis) nis = nan;
    if (!is_started_) {
      if (!begin(next, readings)) return finish(next, orbital, is_late);
      take(next, readings);
    } else {
      go_to(next, readings, time_s - before);
    }
    return finish(next, orbital, is_late);
  }

 private:
  SatelliteConfig<Real> config_;
  FilterModel<Real, States> model_;
  Gate gate_;
  GatedFilter<Real, States> filter_;
  SatelliteEstimate<Real, n> estimate_;
  Instant<Real> now_;
  bool is_begun_, is_started_, has_momentum_;
  double time_, read_s_[Sensor::count];
  int64_t instant_;
  uint32_t rejected_;

  static constexpr bool has(int state) { return States::places.place[state] >= 0; }
  static Vector<Real> vector(const Real *from) { return {{from[0], from[1], from[2]}}; }
  static bool copy(const Real *from, Vector<Real> &to) {
    if (!from) return false;
    to = vector(from);
    return to[0] == to[0] && to[1] == to[1] && to[2] == to[2];
  }
  static Real length(Real a, Real b) { return square_root(a * a + b * b); }
  static Real largest(const Vector<Real> &v) {
    Real most = 0;
    for (int i = 0; i < 3; ++i) most = most > __builtin_fabs(v[i]) ? most : Real(__builtin_fabs(v[i]));
    return most;
  }
  // The unit vector, first divided by its largest component so that no square overflows.
  static Vector<Real> unit(const Vector<Real> &v) { return normalised((1 / largest(v)) * v); }
  double longest_step() const {
    const double bridged =
        config_.longest_gap_s < most_steps * config_.step_s ? config_.longest_gap_s : most_steps * config_.step_s;
    return bridged > config_.step_s ? bridged : config_.step_s;
  }

  // Forget all readings.
  void restart() {
    now_ = {};
    is_begun_ = is_started_ = has_momentum_ = false;
    instant_ = 0, rejected_ = 0;
    filter_.start({});
    set_unknown(0);
  }
  void set_unknown(uint32_t flags) {
    __builtin_memset(&estimate_, 0, sizeof estimate_);
    for (Real &x : estimate_.q) x = Real(nan);
    for (Real &x : estimate_.sigma) x = Real(nan);
    for (Real &x : estimate_.states) x = Real(nan);
    for (Real &x : estimate_.rate) x = Real(nan);
    for (double &x : estimate_.nis) x = nan;
    estimate_.flags = satellite_starting | flags;
  }

  // The surroundings in the orbital frame, and its attitude, orbital from inertial frame.
  bool set_surroundings(const OrbitPoint<Real> &at, Instant<Real> &next, Quaternion<Real> &orbital) const {
    const Vector<Real> position = vector(at.position_m), velocity = vector(at.velocity_m_s);
    Vector<Real> field, sun;
    const Vector<Real> momentum = cross(position, velocity);
    const Real square = dot(position, position), turning = square_root(dot(momentum, momentum)),
               distance = square_root(square);
    // An orbit is above ground, below the Moon, and not faster than an escape; NaN fails, too.
    if (!(distance >= Real(6e6) && distance < Real(1e9) && dot(velocity, velocity) < Real(1e9) && turning > Real(1e9)))
      return false;
    if (!copy(at.field_T, field) || !(largest(field) <= 1) ||
        (config_.uses[Sensor::magnetometer] && !(largest(field) > 0)))
      return false;
    const bool has_sun = copy(at.sun, sun) && largest(sun) > 0 && largest(sun) < Real(1e30);
    if (!has_sun && config_.uses[Sensor::sun_sensor]) return false;
    orbital = attitude_of_two((1 / distance) * position, (1 / turning) * momentum, unit_vector<Real>(2),
                              unit_vector<Real>(1), 1, 1);
    next.around = {turning / square, Real(mu) / square / distance, rotate(orbital, field)};
    next.sun = has_sun ? rotate(orbital, unit(sun)) : Vector<Real>{};
    return true;
  }

  // The attitude that fits two directions in both frames with weights, exactly so their common normal (Wahba's
  // problem of two unit vectors).
  static Quaternion<Real> attitude_of_two(const Vector<Real> &body, const Vector<Real> &other_body,
                                          const Vector<Real> &reference, const Vector<Real> &other_reference,
                                          Real weight, Real other_weight) {
    const Vector<Real> normal = normalised(cross(body, other_body));
    const Quaternion<Real> q = turned_onto(Quaternion<Real>{1, {}}, normal, cross(reference, other_reference));
    const Vector<Real> there = rotate_back(q, reference), other = rotate_back(q, other_reference);
    const Real sine = weight * dot(normal, cross(body, there)) + other_weight * dot(normal, cross(other_body, other));
    return turned_by(q, normal, sine, weight * dot(body, there) + other_weight * dot(other_body, other));
  }

  // Check all readings; those that are missing become NaN.
  Status read(const SatelliteReadings<Real> &given, const Quaternion<Real> &orbital, Readings<Real> &readings,
              Instant<Real> &next) const {
    const Real missing = Real(nan);
    Vector<Real> v;
    readings.star.scalar = readings.gyro[0] = readings.field[0] = readings.sun[0] = missing;
    if (given.star && given.star[0] == given.star[0] && copy(given.star + 1, v)) {
      const Real scalar = Real(__builtin_fabs(given.star[0])), most = largest(v) > scalar ? largest(v) : scalar;
      if (!(most > 0 && most < Real(1e30))) return Status::bad_star;
      readings.star = orbital * normalised((1 / most) * Quaternion<Real>{given.star[0], v});
    }
    for (int i = 0; i < 3; ++i) readings.star_whitening.row[i] = unit_vector<Real>(i);
    if (given.star_covariance_rad2 && !whiten(given.star_covariance_rad2, readings.star_whitening))
      return Status::bad_star;
    if (copy(given.gyro_rad_s, v)) {
      if (!(largest(v) <= Real(1e4))) return Status::bad_gyro;
      readings.gyro = v;
    }
    if (copy(given.field_T, v)) {
      if (!(largest(v) <= 1)) return Status::bad_field;
      readings.field = v;
    }
    if (copy(given.sun, v)) {
      if (!(largest(v) > 0 && largest(v) < Real(1e30))) return Status::bad_sun;
      readings.sun = unit(v);
    }
    if (copy(given.wheels_Nms, v)) next.wheels.momentum = v;
    if (copy(given.torquers_Am2, v)) next.torquers = v;
    if (!(largest(next.wheels.momentum) <= Real(1e6) && largest(next.torquers) <= Real(1e6)))
      return Status::bad_momentum;
    return Status::ok;
  }

  // W of a covariance L L^T of rotations: 2 sigma L^-1. One with NaN is that of the star tracker.
  bool whiten(const Real *covariance, MatrixOf<Real> &W) const {
    for (int i = 0; i < 9; ++i)
      if (covariance[i] != covariance[i]) return true;
    Real L[3][3], inverse[3][3] = {};
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j <= i; ++j) {
        Real sum = covariance[3 * i + j];
        for (int k = 0; k < j; ++k) sum -= L[i][k] * L[j][k];
        if (i == j && !(sum > 0 && sum < Real(1e30))) return false;
        L[i][j] = i == j ? square_root(sum) : sum / L[j][j];
      }
    for (int j = 0; j < 3; ++j)
      for (int i = j; i < 3; ++i) {
        Real sum = Real(i == j);
        for (int k = j; k < i; ++k) sum -= L[i][k] * inverse[k][j];
        inverse[i][j] = sum / L[i][i];
        W.row[i][j] = 2 * config_.sigma_star * inverse[i][j];
      }
    return true;
  }

  void leave_out_unused(Readings<Real> &readings) const {
    Real *const first[Sensor::count] = {&readings.star.scalar, readings.gyro.at, readings.field.at, readings.sun.at};
    for (int k = 0; k < Sensor::count; ++k)
      if (!config_.uses[k]) *first[k] = Real(nan);
  }

  // Sigma at the start of a component of an optional state.
  Real start_sigma(int state, int component) const {
    if (state < Optional::field_gain) return config_.start_sigma[state];
    return state - Optional::field_gain == component ? config_.start_sigma[Optional::field_gain]
                                                     : config_.axes_sigma_rad;
  }
  // Call do_it(state, component, place) of each number of the optional states.
  template <class Do>
  static void for_each_number([[maybe_unused]] Do do_it) {
    if constexpr (n > 6)
      for (int state = 0; state < Optional::count; ++state)
        for (int j = 0; has(state) && j < 3; ++j) do_it(state, j, States::places.place[state] + j);
  }

  // Start from the readings of one instant: with a star tracker in use from any that tells of the attitude, else from
  // field and Sun unless they are nearly in line. Return whether it is done.
  bool begin(const Instant<Real> &at, const Readings<Real> &readings) {
    const bool has_star = is_finite(readings.star.scalar), has_field = is_finite(readings.field[0]),
               has_sun = is_finite(readings.sun[0]);
    if (!(has_star || has_field || has_sun)) return false;
    const Real strength = square_root(dot(at.around.field, at.around.field));
    const Real gain = length(config_.start_sigma[Optional::field_gain], config_.axes_sigma_rad);
    // At one instant errors of the field's model act as noise; constant errors do not average out.
    const Real sigma_field = length(config_.sigma_field_T, config_.field_error_T),
               constant = length(has(Optional::field_bias) ? config_.start_sigma[Optional::field_bias] : Real(0),
                                 has(Optional::field_gain) ? gain * strength : Real(0));
    Estimate<Real> first = {{Quaternion<Real>{1, {}}, {}}, {}};
    Quaternion<Real> &q = first.motion.q;
    if (has_star) {
      q = readings.star;
    } else {
      const Vector<Real> body = has_field ? unit(readings.field) : Vector<Real>{}, sun = cross(readings.sun, body);
      if (has_field && has_sun && dot(sun, sun) > Real(1e-12)) {
        const Real noise = length(sigma_field, constant) / strength;
        q = attitude_of_two(readings.sun, body, at.sun, unit(at.around.field), 1 / model_.variance[Sensor::sun_sensor],
                            1 / (noise * noise));
      } else {
        q = has_sun ? turned_onto(q, readings.sun, at.sun) : turned_onto(q, body, unit(at.around.field));
      }
    }
    Real information[3][3] = {}, open[3][3];
    for (int i = 0; i < 3; ++i) information[i][i] = Real(4 / (open_rad * open_rad));
    if (has_field)
      add_direction(rotate_back(q, at.around.field), length(Real(again) * sigma_field, constant), information);
    if (has_sun) add_direction(rotate_back(q, at.sun), Real(again) * config_.sigma_sun, information);
    const Real weight = 1 / (Real(again * again) * model_.variance[Sensor::star_tracker]);
    for (int k = 0; has_star && k < 3; ++k)
      for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j)
          information[i][j] += weight * readings.star_whitening(k, i) * readings.star_whitening(k, j);
    if (!config_.uses[Sensor::star_tracker]) {
      __builtin_memcpy(open, information, sizeof open);
      for (int i = 0; i < 3; ++i) open[i][i] -= Real(4 / (known_rad * known_rad));
      if (!(Ldl<Real, 3>(open, 0.0).definite() > 0)) return false;
    }
    Real rate_variance = Real(open_rate * open_rate);
    first.motion.w = at.around.orbital_rate * axis_back(q, 1);
    if (is_finite(readings.gyro[0])) {
      first.motion.w = readings.gyro;
      const Real bias = has(Optional::gyro_bias) ? config_.start_sigma[Optional::gyro_bias] : Real(0);
      rate_variance = Real(again * again) * model_.variance[Sensor::gyro] + bias * bias;
    }
    filter_.start(first);
    auto &P = filter_.main().P();
    const Ldl<Real, 3> factors(information, 0.0);
    for (int i = 0; i < 3; ++i) {
      Real column[3];
      factors.solve(unit_vector<Real>(i).at, column);
      for (int j = 0; j < 3; ++j) P[j][i] = column[j];
      P[3 + i][3 + i] = rate_variance;
    }
    for_each_number([&](int state, int j, int at_) { P[at_][at_] = start_sigma(state, j) * start_sigma(state, j); });
    is_started_ = true;
    return true;
  }
  static void add_direction(const Vector<Real> &v, Real noise, Real (&information)[3][3]) {
    const Real weight = 4 / (noise * noise), square = dot(v, v);
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) information[i][j] += weight * ((i == j ? square : Real(0)) - v[i] * v[j]);
  }

  void take(const Instant<Real> &at, const Readings<Real> &readings) {
    double log_determinant[Sensor::count];
    uint8_t rejected[Sensor::count] = {};
    filter_.update(model_, gate_, at, readings, instant_++, estimate_.nis, log_determinant, rejected);
    for (int k = 0; k < Sensor::count; ++k) rejected_ |= uint32_t(rejected[k]) << k;
  }

  // Go to the next instant, a longer way by steps as long as a usual one, and take its readings.
  void go_to(const Instant<Real> &next, const Readings<Real> &readings, double dt) {
    const Instant<Real> first = now_;
    const double ratio = dt / config_.step_s - 0.5;
    int64_t count = int64_t(ratio > 0.0 ? ratio : 0.0);
    count += double(count) < ratio;
    if (count < 1) count = 1;
    Readings<Real> none = {};
    none.star.scalar = none.gyro[0] = none.field[0] = none.sun[0] = Real(nan);
    now_.wheels.torque = Real(1 / dt) * (next.wheels.momentum - first.wheels.momentum);
    double done = 0.0;
    for (int64_t k = 1; k <= count; ++k) {
      const bool is_last = k == count;
      const double part = double(k) / double(count), there = dt * part;
      Instant<Real> then = is_last ? next : between(first, next, Real(part));
      then.wheels.torque = now_.wheels.torque;
      double step = there - done;
      if (__builtin_fabs(step - config_.step_s) < same_step * config_.step_s) step = config_.step_s;
      predict(then, step);
      now_ = then, done = there;
      take(then, is_last ? readings : none);
    }
  }
  static Instant<Real> between(const Instant<Real> &from, const Instant<Real> &to, Real part) {
    Instant<Real> there = from;
    there.wheels.momentum += part * (to.wheels.momentum - from.wheels.momentum);
    there.around.orbital_rate += part * (to.around.orbital_rate - from.around.orbital_rate);
    there.around.gravity += part * (to.around.gravity - from.around.gravity);
    there.around.field += part * (to.around.field - from.around.field);
    there.sun += part * (to.sun - from.sun);
    if (largest(there.sun) > 0) there.sun = normalised(there.sun);
    return there;
  }
  void predict(const Instant<Real> &then, double step) {
    Real kept[n], added[n];
    const double steps = step / config_.step_s;
    for (int i = 0; i < 6; ++i) {
      const Real noise = i < 3 ? config_.noise_attitude : config_.noise_rate_rad_s;
      kept[i] = 1, added[i] = noise * noise * Real(steps);
    }
    for_each_number([&](int state, int j, int at) {
      const int part = state < Optional::field_gain ? state : int(Optional::field_gain);
      const double lasts = config_.lasts_s[part], share = lasts > 0.0 ? exponential(-step / lasts) : 1.0;
      const Real noise = config_.noise[part], sigma = start_sigma(state, j);
      const Real walk = state == Optional::gyro_bias    ? config_.gyro_walk_rad_s
                        : state == Optional::field_bias ? config_.field_walk_T
                                                        : Real(0);
      kept[at] = Real(share);
      added[at] = noise * noise * Real(steps) + sigma * sigma * Real(1.0 - share * share) + walk * walk * Real(step);
    });
    filter_.predict(model_, now_, then, kept, added, step);
  }

  Status finish(const Instant<Real> &next, const Quaternion<Real> &orbital, bool is_late) {
    now_ = next;
    uint32_t flags = 0;
    for (int k = 0; k < Sensor::count; ++k)
      if (config_.uses[k] && time_ - read_s_[k] > silent_s) flags |= uint32_t(star_silent) << k;
    if (!is_started_) {
      set_unknown(flags);
      return Status::ok;
    }
    const Estimate<Real> &x = filter_.main().x;
    bool is_good = is_finite(x.motion.q.scalar) && is_finite(dot(x.motion.w, x.motion.w));
    for (int i = 0; i < n; ++i) is_good = is_good && covariance(i, i) > 0 && is_finite(covariance(i, i));
    if (!is_good) {
      restart();
      return Status::diverged;
    }
    const Quaternion<Real> q = conjugate(orbital) * x.motion.q;
    estimate_.q[0] = q.scalar;
    for (int i = 0; i < 3; ++i) estimate_.q[1 + i] = q.vector[i], estimate_.rate[i] = x.motion.w[i];
    for (int i = 0; i < n; ++i) estimate_.sigma[i] = square_root(covariance(i, i));
    for_each_number([&](int state, int j, int at) { estimate_.states[at - 6] = x.optional[state][j]; });
    estimate_.flags = flags | rejected_ << 4 | (is_late ? uint32_t(satellite_restarted) : 0u);
    return Status::ok;
  }
};
MAGLOC_END

namespace adcs {
using magloc::SatelliteFilter;
}  // namespace adcs
