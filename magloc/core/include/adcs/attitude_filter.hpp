// Attitude of an inertial unit with a magnetometer, one reading at a time: no heap, no library, float or double.
//
//     adcs::AttitudeFilter<float> filter;
//     filter.start({});
//     if (filter.update(time_s, gyro, acceleration, field) == adcs::Status::ok) use(filter.estimate());
//
// A filter is a plain struct: its bytes are its state, and a copy of them resumes bit for bit.
#pragma once
#include "adcs/field_heading.hpp"
#include "adcs/level.hpp"
#include "adcs/status.hpp"

MAGLOC_BEGIN
template <class Real>
struct AttitudeConfig {
  HeadingParameters<Real> model;
  Real lag_s = 0;                // of the magnetometer behind the gyro, at most 40 ms
  bool is_point_sample = false;  // a gyro's sample is the rate at a point in time, not the mean since the last one
  Disturbance disturbance = Disturbance::automatic;
};

template <class Real>
struct AttitudeEstimate {
  Real q[4];                         // east, north, up from body, scalar first
  Real sigma_tilt, sigma_heading;    // of the angles between up and its estimate, and about up, rad
  Real rate[3], bias[3];             // of the gyro without its bias, and the bias, body axes, rad/s
  Real offset_T[3], sigma_offset_T;  // of the magnetometer, body axes, and the largest sigma of an axis
  uint32_t flags;                    // of AttitudeFlag

  bool disturbed() const { return (flags & (field_left_out | magnet_subtracted)) != 0; }
};

template <class Real>
class AttitudeFilter {
  static constexpr double start_s = 1.0, turn_s = 0.5, useful_tilt = 0.0349065850398866, settled_s = 10.0;
  static constexpr double up_step = 0.15, longest_up_step = 0.5 / up_step, usual_length = 0.1, unknown_bias = 0.01;
  static constexpr double start_rate = 0.0349065850398866, start_acceleration = 0.3, start_bias = 0.08726646259971647;
  static constexpr double shown_rad = 0.15, shown_s = 0.3, change_s = 1.0, lost_rad = 0.5, micro = 1e6;
  static constexpr double largest_time = 1e14, least_scatter = 0.1;

 public:
  static constexpr uint32_t version = 1;  // of the state's bytes

  void start(const AttitudeConfig<Real> &config) {
    __builtin_memset(static_cast<void *>(this), 0, sizeof *this);
    config_ = config;
    q_gyro_ = level_ = {1, {}};
    model_ = config.model;
    estimate_.q[0] = 1;
    estimate_.sigma_tilt = estimate_.sigma_heading = Real(unknown_angle);
    estimate_.flags = starting | heading_relative;
  }
  AttitudeFilter() noexcept { start({}); }
  explicit AttitudeFilter(const AttitudeConfig<Real> &config) noexcept { start(config); }

  const AttitudeEstimate<Real> &estimate() const { return estimate_; }
  double time_s() const { return time_; }

  // Take the readings of a time, each (3,) in body axes: rad/s, m/s^2, T. Null, or a component that is NaN, is a
  // missing reading. A time that does not ascend or is beyond 1e14 s, and a reading that is infinite, beyond all
  // sensors, or a zero vector (but for the gyro), change nothing.
  Status update(double time_s, const Real *gyro_rad_s, const Real *acceleration_m_s2, const Real *field_T) {
    if (!(time_s >= -largest_time && time_s <= largest_time) || (is_begun_ && !(time_s > time_)))
      return Status::bad_time;
    Vector<Real> rate, acceleration, field;
    const bool has_rate = copy(gyro_rad_s, rate), has_acceleration = copy(acceleration_m_s2, acceleration),
               has_field = copy(field_T, field);
    if (has_rate && !(largest(rate) <= 1e4)) return Status::bad_gyro;
    if (has_acceleration && !(largest(acceleration) <= 1e6 && largest(acceleration) > 0))
      return Status::bad_acceleration;
    if (has_field && !(largest(field) <= 1 && largest(field) > 0)) return Status::bad_field;
    field = micro * field;
    if (!is_begun_) is_begun_ = true, begin_ = time_ = time_s;
    const Real dt = Real(time_s - time_);
    time_ = time_s;
    const Vector<Real> *const found[3] = {has_rate ? &rate : nullptr, has_acceleration ? &acceleration : nullptr,
                                          has_field ? &field : nullptr};
    if (has_field) heading_.count_reading(time_s);
    const bool rests = rest_.add(time_s - begin_, found[0], found[1], gyro_.usual_step(), up_.usual_step());
    if (!is_started_) {
      const bool is_over = time_s >= begin_ + start_s && first_rate_.count > 0 && first_acceleration_.count > 0;
      if (is_over)
        finish_start(time_ - dt);
      else
        return gather(dt, found);
    }
    if (rests) set_bias(rest_.bias());
    step(dt, found);
    return Status::ok;
  }

 private:
  AttitudeConfig<Real> config_;
  AttitudeEstimate<Real> estimate_;
  HeadingParameters<Real> model_;  // with the drift of a gyro that has not yet rested
  bool is_begun_, is_started_, was_hidden_, was_fresh_, has_steady_, was_gap_;
  double begin_, time_, started_, acceleration_read_;
  UsualStep<Real> row_step_;
  // The first second.
  Scatter<Real> first_rate_, first_acceleration_, first_field_;
  Real first_length_;
  // Gyro, direction up and bias.
  GyroSteps<Real> gyro_;
  RestBias<Real> rest_;
  Vector<Real> bias_;
  Real bias_sigma_;
  Quaternion<Real> q_gyro_, level_;  // of the gyro alone, and to the level frame from there
  DirectionUp<Real> up_;
  Real best_up_;
  LowPass<Real> tilt_;
  // The field, uT: of usual length in the frame of the gyro, now and before a gap of the gyro.
  AttitudeHistory<Real> history_;
  Vector<Real> steady_field_, field_before_gap_;
  double steady_time_, field_before_gap_time_;
  Real gap_seconds_, gap_variance_;
  FieldHeading<Real> heading_;

  static bool copy(const Real *from, Vector<Real> &to) {
    if (!from) return false;
    to = {{from[0], from[1], from[2]}};
    return to[0] == to[0] && to[1] == to[1] && to[2] == to[2];
  }
  static Real largest(const Vector<Real> &v) {
    Real most = 0;
    for (int i = 0; i < 3; ++i) {
      const Real size = v[i] < 0 ? -v[i] : v[i];
      if (size > most) most = size;
    }
    return most;
  }
  static Real length(const Vector<Real> &v) { return square_root(dot(v, v)); }

  // Within the first second: the attitude of the means so far.
  Status gather(Real dt, const Vector<Real> *const (&found)[3]) {
    if (found[0]) {
      gyro_.has_sample() ? (void)gyro_.step(dt, found[0], {}, false, 0, 0) : gyro_.start(*found[0]);
      first_rate_.add(*found[0]);
    } else if (gyro_.has_sample()) {
      gyro_.step(dt, nullptr, {}, false, 0, 0);
    }
    if (dt > 0) row_step_.add(dt);
    if (found[1]) {
      if (first_acceleration_.count > 0) up_.count_step(Real(time_ - acceleration_read_));
      acceleration_read_ = time_;
      first_acceleration_.add(*found[1]);
    }
    if (found[2]) {
      first_field_.add(*found[2]);
      first_length_ += (length(*found[2]) - first_length_) / first_field_.count;
    }
    if (first_acceleration_.count > 0) level_ = turned_onto({1, {}}, first_acceleration_.mean(), unit_vector<Real>(2));
    double tilt = unknown_angle * unknown_angle, heading = 0, variance = 0;
    if (first_acceleration_.count > 0) {
      const double scatter = first_acceleration_.deviation(), least = least_scatter;
      tilt = tilt_floor * tilt_floor + (scatter * scatter + least * least / first_acceleration_.count) / (9.81 * 9.81);
    }
    if (first_field_.count > 0) {
      const Vector<Real> field = rotate(level_, first_field_.mean());
      const double noise = micro * model_.noise_T, horizontal = field[0] * field[0] + field[1] * field[1];
      heading = heading_.angle(field);
      variance = model_.start_rad * model_.start_rad + noise * noise / (first_field_.count * horizontal);
    }
    if (found[0])
      for (int i = 0; i < 3; ++i) estimate_.rate[i] = (*found[0])[i];
    finish(Real(heading), Real(square_root(tilt)), Real(variance),
           starting | (first_field_.count > 0 ? 0u : uint32_t(heading_relative)));
    return Status::ok;
  }

  // At the end of the first second: bias, direction up and field of a unit at rest.
  void finish_start(double last) {
    const Vector<Real> mean = first_rate_.mean();
    const bool is_at_rest = first_rate_.deviation() < Real(start_rate) &&
                            first_acceleration_.deviation() < Real(start_acceleration) &&
                            length(mean) < Real(start_bias);
    bias_ = is_at_rest ? mean : Vector<Real>{};
    bias_sigma_ = is_at_rest ? Real(0) : Real(unknown_bias);
    if (bias_sigma_ > model_.gyro_drift_rad_s) model_.gyro_drift_rad_s = bias_sigma_;
    level_ = turned_onto({1, {}}, first_acceleration_.mean(), unit_vector<Real>(2));
    up_.start(acceleration_read_, first_acceleration_, is_at_rest);
    is_started_ = true, started_ = time_;
    heading_.begin(last);
    best_up_ = Real(unknown_angle);
    estimate_.flags = is_at_rest ? 0u : uint32_t(moving_start);
    if (is_at_rest && first_field_.count > 0) {
      has_steady_ = true, steady_field_ = first_field_.mean(), steady_time_ = time_;
      heading_.start(model_, config_.disturbance, last, rotate(level_, first_field_.mean()), 0);
    }
  }

  void set_bias(const Vector<Real> &bias) {
    bias_ = bias;
    if (bias_sigma_ == 0) return;
    bias_sigma_ = 0, model_.gyro_drift_rad_s = config_.model.gyro_drift_rad_s;
    heading_.set_drift(model_.gyro_drift_rad_s);
  }

  void step(Real dt, const Vector<Real> *const (&found)[3]) {
    row_step_.add(dt);
    const auto turn = gyro_.step(dt, found[0], bias_, config_.is_point_sample, model_.gap_rad_s, model_.long_gap_rad_s);
    const Vector<Real> rate = (1 / dt) * turn.vector;
    if (config_.lag_s > 0) history_.add(time_ - dt, q_gyro_, config_.lag_s);
    q_gyro_ = normalised(q_gyro_ * exponential(turn.vector));
    const bool is_gap = gyro_.is_gap(), is_in_gap = is_gap && !gyro_.is_read();
    Real growth = turn.growth;
    hide(growth);
    if (is_gap && !was_gap_) {
      was_gap_ = true;
      field_before_gap_ = steady_field_, field_before_gap_time_ = has_steady_ ? steady_time_ : time_ - 1e9;
    }
    if (is_gap) gap_seconds_ = gyro_.since(), gap_variance_ = gyro_.hidden();
    if (found[2] && !is_in_gap) growth += observed_growth(*found[2]);
    if (found[1] && !is_in_gap)
      growth += up_.step(time_, rotate(q_gyro_, *found[1]), model_.gyro_drift_rad_s);
    else
      up_.wait(time_, model_.gyro_drift_rad_s);
    set_level(dt);
    if (up_.sigma() < best_up_) best_up_ = up_.sigma();
    const Real tilt = tilt_sigma(dt, rate, growth);
    const Quaternion<Real> q = level_ * q_gyro_;
    heading_.turn(model_, time_, dt, turn.vector, axis_back(q, 2), growth);
    if (found[2] && !is_in_gap && is_useful()) {
      Vector<Real> field = *found[2];
      if (config_.lag_s > 0)
        field = rotate_back(q_gyro_, rotate(history_.at(time_ - config_.lag_s, time_, q_gyro_), field));
      if (!(first_length_ > 0)) first_length_ = length(field);
      heading_.take(model_, config_.disturbance, time_, rotate(q, field), q, up_.sigma());
    }
    const auto heading = heading_.now(model_, is_in_gap);
    const Vector<Real> offset = heading_.offset_tesla();
    for (int i = 0; i < 3; ++i) estimate_.rate[i] = rate[i], estimate_.offset_T[i] = offset[i];
    estimate_.sigma_offset_T = heading_.offset_sigma_tesla();
    uint32_t flags = (estimate_.flags & moving_start) | heading.flags;
    if (is_in_gap) flags |= gyro_silent;
    if (up_.is_gap(time_)) flags |= accelerometer_silent;
    if (heading_.is_silent(time_)) flags |= magnetometer_silent;
    finish(heading.angle, tilt, heading.variance, flags);
  }
  // Whether the tilt is known well enough to use the field.
  bool is_useful() const {
    return up_.sigma() <= Real(useful_tilt) || (time_ > started_ + settled_s && up_.sigma() <= Real(1.5) * best_up_);
  }

  // A gap that hides a turn: the direction up starts anew after it.
  void hide(Real growth) {
    const bool hides = DirectionUp<Real>::hides_much(gyro_.hidden());
    if (hides && growth > 0) up_.hide(was_hidden_ ? growth : gyro_.hidden());
    was_hidden_ = hides;
  }

  // The variance to add after a gap over which the field turns by more than sigma.
  Real observed_growth(const Vector<Real> &field) {
    const Real difference = length(field) - first_length_;
    if (first_length_ > 0 && (difference < 0 ? -difference : difference) >= Real(usual_length) * first_length_)
      return 0;
    const Vector<Real> steady = rotate(q_gyro_, field);
    Real growth = 0;
    if (was_gap_) {
      was_gap_ = false;
      const bool is_soon = time_ - field_before_gap_time_ < gap_seconds_ + change_s && gap_seconds_ >= shown_s;
      const Vector<Real> across = cross(field_before_gap_, steady);
      const double turned = arc_tangent(double(length(across)), double(dot(field_before_gap_, steady))),
                   variance = gap_variance_;
      if (is_soon && turned > shown_rad && turned > square_root(variance)) growth = Real(turned * turned - variance);
      if (growth > 0 && DirectionUp<Real>::hides_much(growth)) up_.hide(growth);
    }
    has_steady_ = true, steady_field_ = steady, steady_time_ = time_;
    return growth;
  }

  void set_level(Real dt) {
    const Vector<Real> up = up_.up();
    if (!(dot(up, up) > 0)) return;  // means that cancel
    const bool is_fresh = up_.is_fresh(time_);
    if (is_fresh && !was_fresh_) level_ = turned_onto(level_, up, unit_vector<Real>(2));
    was_fresh_ = is_fresh;
    const Real steps = row_step_.seconds > 0 ? dt / row_step_.seconds : Real(1);
    const Real part =
        is_fresh ? Real(1) : Real(up_step) * (steps < Real(longest_up_step) ? steps : Real(longest_up_step));
    const Vector<Real> there = rotate(level_, up);
    level_ = normalised(exponential(Vector<Real>{{part * there[1], -part * there[0], 0}}) * level_);
  }

  Real tilt_sigma(Real dt, const Vector<Real> &rate, Real growth) {
    const Real scale = model_.gyro_scale;
    const Real square = scale * scale * dot(rate, rate) + growth / Real(turn_s * turn_s);
    if (started_ == time_) {
      tilt_.start(square);
    } else {
      double cosine, sine;
      damped_rotation(dt / gravity_times[0], cosine, sine);
      tilt_.step(cosine, sine, square);
    }
    const double smooth = tilt_.output > 0 ? tilt_.output : Real(0), of_bias = gravity_times[0] * bias_sigma_;
    const double variance = tilt_floor * tilt_floor + turn_s * turn_s * smooth + up_.sigma() * up_.sigma() +
                            of_bias * of_bias + up_.drift() * up_.drift();
    return Real(variance < unknown_angle * unknown_angle ? square_root(variance) : unknown_angle);
  }

  void finish(Real heading, Real tilt, Real variance, uint32_t flags) {
    const Quaternion<Real> turn = exponential(Vector<Real>{{0, 0, -heading}});
    const Quaternion<Real> q = normalised(turn * (level_ * q_gyro_));
    const Real most = Real(unknown_angle * unknown_angle);
    estimate_.q[0] = q.scalar;
    for (int i = 0; i < 3; ++i) estimate_.q[1 + i] = q.vector[i], estimate_.bias[i] = bias_[i];
    estimate_.sigma_tilt = tilt;
    // NaN counts as unknown.
    estimate_.sigma_heading = variance < most ? square_root(variance) : Real(unknown_angle);
    if (!(estimate_.sigma_heading <= Real(lost_rad))) flags |= heading_lost;
    estimate_.flags = flags;
  }
};
MAGLOC_END

namespace adcs {
using magloc::AttitudeConfig;
using magloc::AttitudeEstimate;
using magloc::AttitudeFilter;
using magloc::Disturbance;
}  // namespace adcs
