// Heading of an inertial unit by its magnetometer, one reading at a time: means over blocks for the filter of
// heading.hpp, and the heading's sigma between them. Fields are in uT.
#pragma once
#include "adcs/heading.hpp"
#include "adcs/inertial.hpp"

MAGLOC_BEGIN
// Treatment of a field that contradicts the filter: automatic rejects it until turns show that it moves with the
// sensor, and then subtracts it.
enum class Disturbance : int32_t { automatic, reject, subtract, keep };

// Bits of an estimate's flags.
enum AttitudeFlag : uint32_t {
  starting = 1,           // less than the first second of readings
  field_left_out = 2,     // the field contradicts the filter: the gyro alone holds the heading
  magnet_subtracted = 4,  // the field of a magnet that moves with the sensor is subtracted
  heading_lost = 8,       // sigma of the heading is above half a radian
  heading_doubtful = 16,  // the field turned the heading by more than the gyro's errors and sigma allow
  heading_relative = 32,  // no field so far: the heading is relative to the first reading
  moving_start = 64,      // the unit was not at rest in the first second
  gyro_silent = 128,      // no reading for longer than a gap
  accelerometer_silent = 256,
  magnetometer_silent = 512
};

// Noise, time constants and limits; adcs.HeadingModel explains them and has the same defaults.
template <class Real>
struct HeadingParameters {
  Real noise_T = Real(2e-6), offset_T = Real(0.3e-6), offset_T_rts = Real(0.02e-6);
  Real room_T = Real(0.4e-6), room_s = Real(100.0), local_T = Real(2e-6), local_s = Real(0.3);
  Real gyro_drift_rad_s = Real(0.0007), gyro_drift_s = Real(20.0), gyro_scale = Real(0.005);
  Real gyro_walk_rad_rts = Real(0.0003), start_rad = Real(0.01), turning_rad_s = Real(0.05235987755982989);
  Real gap_rad_s = Real(0.1), long_gap_rad_s = Real(1.0), jump_T = Real(20e-6);
  Real gate = Real(25.0), mean_nis = Real(2.0), memory = Real(0.9);
  Real patience_s = Real(0.35), trial_s = Real(10.0), evidence = Real(100.0);
};

// Headings of the last minute. A magnet that the filter does not notice turns the heading slowly, by more than the gyro
// allows.
template <class Real>
class HeadingMinute {
  static constexpr int n = 21;
  static constexpr double every_s = 3.0, more = 2.0, doubt = 9.0;

 public:
  // What has grown since the start, at a time.
  struct Sums {
    double time;
    Real turned[3], turning, hidden;  // turn about the vertical by each axis, time in motion, variance of gaps
  };
  void clear() {
    entries_.clear();
    age_ = 0;
  }
  // Return by what a change exceeds its variance, at the most since a minute ago, and whether by far.
  template <class Change>
  Real excess(const Sums &now, Real heading, Real variance, Change change_variance, bool &is_doubtful) {
    if (entries_.size() == 0 || now.time >= entries_.at(0).sums.time + every_s) {
      entries_.add() = {now, heading, variance};
      if (age_ < entries_.size() - 1) ++age_;
    }
    while (age_ > 0 && entries_.at(age_).sums.time < now.time - 60.0) --age_;
    const Entry &other = entries_.at(age_);
    const Real allowed = other.variance + change_variance(other.sums);
    double change = heading - other.heading;
    constexpr double turn = 6.283185307179586;
    change -= turn * (double)(int64_t)(change / turn + (change < 0 ? -0.5 : 0.5));
    const Real square = Real(change * change), excess = square - Real(more) * allowed;
    is_doubtful = square > Real(doubt) * allowed;
    return excess > 0 ? excess : Real(0);
  }

 private:
  struct Entry {
    Sums sums;
    Real heading, variance;
  };
  Ring<Entry, n> entries_;
  int32_t age_;  // of the first entry within the minute
};

template <class Real>
class FieldHeading {
  static constexpr double start_s = 1.0, block_s = 0.035, long_step_s = 1.0, held_variance = 4.0, magnet = 5.0;
  static constexpr double micro = 1e6;
  typedef typename HeadingMinute<Real>::Sums Sums;

  bool has_heading_, is_offset_changed_, is_used_, has_reading_;
  double read_, block_end_, began_, first_time_;
  UsualStep<Real> usual_;
  Scatter<Real> first_;  // fields before the filter starts, level frame
  Real first_tilt_;
  Vector<Real> block_field_, block_level_[3], block_turned_;  // the second: to the level frame, at the middle
  int32_t block_count_, block_size_;
  Real block_hidden_, block_turning_;
  HeadingRules<Real> rules_;
  HeadingRun<Real> run_;
  Sums sums_;
  HeadingMinute<Real> minute_;

 public:
  static Real angle(const Vector<Real> &level) { return Real(arc_tangent(double(-level[0]), double(level[1]))); }
  void begin(double time) { began_ = sums_.time = time; }

  // A reading of the sensor, whether it is used or not.
  void count_reading(double time) {
    if (has_reading_) usual_.add(Real(time - read_));
    has_reading_ = true, read_ = time;
  }
  bool is_silent(double time) const { return has_reading_ && usual_.is_gap(Real(time - read_), 1); }
  void set_drift(Real sigma) {
    if (has_heading_) run_.filter().forget(state_drift, sigma * sigma);
  }

  // Turn by the gyro; up in body axes. The growth of the variance is that of gaps, which no block extends over.
  void turn(const HeadingParameters<Real> &model, double time, Real dt, const Vector<Real> &turn,
            const Vector<Real> &up, Real growth) {
    const Real largest = model.turning_rad_s * dt;
    sums_.time = time;
    for (int i = 0; i < 3; ++i) sums_.turned[i] += turn[i] * up[i];
    if (dot(turn, turn) > largest * largest) sums_.turning += dt, block_turning_ += dt;
    sums_.hidden += growth;
    block_hidden_ += growth;
    block_turned_ += turn;
    if (growth > 0) block_count_ = 0;
  }

  void start(const HeadingParameters<Real> &model, Disturbance disturbance, double time, const Vector<Real> &field,
             Real tilt) {
    HeadingFilter<Real> &filter = run_.filter();
    filter = {};
    const Real horizontal = square_root(field[0] * field[0] + field[1] * field[1]), vertical = field[2];
    filter.x[0] = angle(field);
    const Real offset = Real(micro) * model.offset_T, local = Real(micro) * model.local_T;
    const Real sigma[n_heading] = {model.start_rad,
                                   model.gyro_drift_rad_s,
                                   model.gyro_scale,
                                   model.gyro_scale,
                                   model.gyro_scale,
                                   offset,
                                   offset,
                                   offset,
                                   Real(0.1) * offset,
                                   offset,
                                   offset,
                                   local,
                                   local,
                                   Real(0.5) * local};
    for (int i = 0; i < n_heading; ++i) filter.P[i][i] = sigma[i] * sigma[i];
    const Real north = tilt * horizontal, up = tilt * vertical;
    const double turn = horizontal > 0 ? up / horizontal : unknown_angle;
    filter.P[0][0] += Real(turn < unknown_angle ? turn * turn : unknown_angle * unknown_angle);
    filter.P[9][9] += up * up, filter.P[10][10] += north * north;
    rules_ = {{0, horizontal, vertical},
              Real(micro) * model.noise_T,
              model.gate,
              model.mean_nis,
              model.memory,
              model.patience_s,
              model.trial_s,
              Real(micro) * model.jump_T,
              model.evidence,
              1};
    if (disturbance == Disturbance::keep) rules_.gate = rules_.mean_nis = Real(infinity);
    if (disturbance == Disturbance::reject) rules_.evidence = Real(infinity);
    if (disturbance == Disturbance::subtract) rules_.evidence = -Real(infinity);
    run_.start();
    minute_.clear();
    has_heading_ = is_used_ = true;
    end_block(time);
  }

  // Take a field in the level frame, of the attitude q: the mean of the first second is north, then blocks of them.
  void take(const HeadingParameters<Real> &model, Disturbance disturbance, double time, const Vector<Real> &level,
            const Quaternion<Real> &q, Real tilt) {
    if (!has_heading_) {
      if (first_.count == 0) first_time_ = time, first_tilt_ = tilt;
      first_.add(level);
      if (time >= first_time_ + start_s) start(model, disturbance, time, first_.mean(), first_tilt_);
      return;
    }
    if (block_count_ == 0) {
      const double size = usual_.seconds > 0 ? block_s / usual_.seconds + 0.500001 : 1.0;
      block_size_ = size < 1.0 ? 1 : size < 1000.0 ? (int32_t)size : 1000;
      block_field_ = {};
    }
    if (block_count_ == block_size_ / 2)
      for (int i = 0; i < 3; ++i) block_level_[i] = axis_back(q, i);
    block_field_ += level;
    if (++block_count_ == block_size_) take_block(model, time);
  }

  // The heading since the last block. In a gap of the gyro the turn that it hides counts more.
  struct Heading {
    Real angle, variance;
    uint32_t flags;
  };
  Heading now(const HeadingParameters<Real> &model, bool is_in_gap) {
    const double time = sums_.time;
    const auto change = [&](const Sums &since) {
      Real squares = 0;
      for (int i = 0; i < 3; ++i) {
        const Real turned = model.gyro_scale * (sums_.turned[i] - since.turned[i]);
        squares += turned * turned;
      }
      return squares + drift_variance(model, Real(time - since.time), sums_.turning - since.turning) +
             (sums_.hidden - since.hidden);
    };
    if (!has_heading_ && first_.count > 0) {
      const Vector<Real> field = first_.mean();
      const double horizontal = square_root(double(field[0] * field[0] + field[1] * field[1]));
      const double turn = horizontal > 0.0 ? first_tilt_ * field[2] / horizontal : unknown_angle;
      return {angle(field), model.start_rad * model.start_rad + Real(turn * turn), 0};
    }
    if (!has_heading_) {
      Sums begin = {};
      begin.time = began_;
      return {0, change(begin), heading_relative};
    }
    const HeadingFilter<Real> &filter = run_.filter();
    Heading heading = {filter.x[0], filter.P[0][0], 0};
    heading.variance += drift_variance(model, Real(time - block_end_), block_turning_) +
                        (is_in_gap ? Real(held_variance) : Real(1)) * block_hidden_;
    bool is_doubtful = false;
    heading.variance += minute_.excess(sums_, heading.angle, heading.variance, change, is_doubtful);
    if (is_doubtful) heading.flags |= heading_doubtful;
    if (!is_used_) heading.flags |= field_left_out;
    const Vector<Real> o = offset_tesla();
    const Real largest = Real(magnet) * model.offset_T;
    if (is_offset_changed_ && dot(o, o) > largest * largest) heading.flags |= magnet_subtracted;
    return heading;
  }
  Vector<Real> offset_tesla() const {
    const Real *offset = run_.filter().x + state_offset;
    return 1e-6 * Vector<Real>{{offset[0], offset[1], offset[2]}};
  }
  // The largest sigma of the offset's axes.
  Real offset_sigma_tesla() const {
    Real most = 0;
    for (int i = state_offset; i < state_offset + 3; ++i)
      if (run_.filter().P[i][i] > most) most = run_.filter().P[i][i];
    return Real(1e-6) * square_root(most);
  }

 private:
  void end_block(double time) {
    block_end_ = time;
    block_count_ = 0, block_turned_ = {}, block_hidden_ = block_turning_ = 0;
  }

  // The variance of the heading by the walk and the drift of the gyro; the drift is an Ornstein-Uhlenbeck process.
  static Real drift_variance(const HeadingParameters<Real> &model, Real seconds, Real turning) {
    const double time = model.gyro_drift_s, x = turning / time;
    const double integral = x < 0.1 ? x * x * (0.5 - x * (1 / 6.0 - x * (1 / 24.0 - x * (1 / 120.0 - x / 720.0))))
                                    : x - 1.0 + exponential(-x);
    const double walk = model.gyro_walk_rad_rts, drift = model.gyro_drift_rad_s * time;
    return Real(walk * walk * seconds + 2.0 * drift * drift * integral);
  }

  void take_block(const HeadingParameters<Real> &model, double now) {
    const Real seconds = Real(now - block_end_);
    const Vector<Real> rate = (1 / seconds) * block_turned_, mean = (1 / Real(block_size_)) * block_field_;
    const Real turns = dot(rate, rate) > model.turning_rad_s * model.turning_rad_s;
    const Real h = seconds < model.gyro_drift_s ? seconds : model.gyro_drift_s;
    double hidden =
        block_hidden_ + (seconds > Real(long_step_s) ? drift_variance(model, seconds, block_turning_) : Real(0));
    if (hidden > unknown_angle * unknown_angle) hidden = unknown_angle * unknown_angle;
    Real level[9], turn[4] = {h * turns}, kept[2][n_heading], growth[2][n_heading] = {};
    for (int i = 0; i < 9; ++i) level[i] = block_level_[i / 3][i % 3];
    for (int i = 0; i < 3; ++i) turn[1 + i] = h * level[6 + i] * rate[i];
    for (int k = 0; k < 2; ++k) {
      const Real room_T = k == 0 ? model.room_T : model.jump_T, room_s = k == 0 ? model.room_s : model.local_s;
      for (Real &part : kept[k]) part = 1;
      const auto decay = [&](int first, int count, double time, double sigma) {
        const double part = exponential(-time), variance = sigma * sigma * (1.0 - part * part);
        for (int i = first; i < first + count; ++i) kept[k][i] = Real(part), growth[k][i] = Real(variance);
      };
      decay(state_drift, 1, h * turns / model.gyro_drift_s, model.gyro_drift_rad_s);
      decay(state_room, 3, h * turns / room_s, micro * room_T);
      decay(state_local, 3, h / model.local_s, micro * model.local_T);
      growth[k][state_local + 2] *= Real(0.25);
      growth[k][0] = Real(model.gyro_walk_rad_rts * model.gyro_walk_rad_rts * h * turns + hidden);
      const Real offset = Real(micro) * model.offset_T_rts;
      for (int i = 0; i < 3; ++i) growth[k][state_offset + i] = offset * offset * h;
    }
    const auto outcome = run_.step(rules_, {mean.at, level, turn, h, {kept[0], growth[0]}, {kept[1], growth[1]}});
    is_used_ = outcome.is_used;
    if (outcome.accepted > 0) is_offset_changed_ = true;
    end_block(now);
    // Numbers that overflow begin anew.
    const HeadingFilter<Real> &filter = run_.filter();
    if (!(filter.P[0][0] >= 0 && filter.P[0][0] < 1e6 && filter.x[0] * filter.x[0] < 1e12)) {
      has_heading_ = false;
      first_.clear();
    }
  }
};
MAGLOC_END
