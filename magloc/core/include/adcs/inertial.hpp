// Readings of an inertial unit, one at a time: their steps, scatter and low-pass, the gyro's bias at rest and its
// turns, and the lag of the magnetometer. Real is float or double.
#pragma once
#include "adcs/rotation.hpp"
#include "magloc/elementary.hpp"

MAGLOC_BEGIN
// Standard deviation of an unknown angle, rad.
constexpr double unknown_angle = 1.8137993642342178;
// A gap is longer than so many usual steps.
constexpr double gap_steps = 2.5;

// exp(-a) cos a and exp(-a) sin a for a > 0, by the power series of exp((i - 1) a). A large a is halved until it is
// small enough, and the result squared as often.
inline void damped_rotation(double a, double &cosine, double &sine) {
  int halved = 0;
  for (; a > 0.05 && halved < 64; ++halved) a *= 0.5;
  cosine = 1.0, sine = 0.0;
  MAGLOC_UNROLL
  for (int n = 9; n > 0; --n) {
    const double sum = cosine + sine, difference = cosine - sine;
    cosine = 1.0 - a * (1.0 / n) * sum;
    sine = a * (1.0 / n) * difference;
  }
  for (; halved > 0; --halved) {
    const double square = cosine * cosine - sine * sine;
    sine = 2.0 * cosine * sine;
    cosine = square;
  }
}

// Butterworth low-pass of second order; adcs/complementary/inertial/integration.py has the formula.
template <class Real>
struct LowPass {
  Real output, slope, input;  // the slope in units of s

  void start(Real value) { output = input = value, slope = 0; }
  void step(double cosine, double sine, Real next) {
    const double mean = 0.5 * (input + next), z = output - mean, rate = slope;
    output = Real(mean + z * cosine + (rate + z) * sine);
    slope = Real(rate * cosine - (rate + 2.0 * z) * sine);
    input = next;
  }
};

// Usual step between readings: their mean, of about the last hundred. A gap counts as three steps.
template <class Real>
struct UsualStep {
  Real seconds, count;  // zero before the second reading
  void add(Real step) {
    if (count < 100) count += 1;
    const Real most = 3 * seconds;
    seconds += ((count > 1 && step > most ? most : step) - seconds) / count;
  }
  bool is_gap(Real since, Real least = 0) const {
    return count > 0 && since > least && since > Real(gap_steps) * seconds;
  }
};

// Mean and scatter of some vectors. Squares are of differences to the first one, so that few digits cancel.
template <class Real>
struct Scatter {
  Vector<Real> first, sum, squares;
  Real count;

  void clear() { *this = {}; }
  void add(const Vector<Real> &v) {
    if (count == 0) first = v;
    const Vector<Real> difference = v - first;
    for (int i = 0; i < 3; ++i) sum[i] += difference[i], squares[i] += difference[i] * difference[i];
    count += 1;
  }
  Vector<Real> mean() const { return first + (count > 0 ? 1 / count : Real(0)) * sum; }
  // The largest standard deviation of an axis.
  Real deviation() const {
    Real largest = 0;
    for (int i = 0; i < 3 && count > 0; ++i) {
      const Real mean = sum[i] / count, variance = squares[i] / count - mean * mean;
      if (variance > largest) largest = variance;
    }
    return square_root(largest);
  }
};

// The last n items, of ages 0 (the newest), 1, ...
template <class T, int n>
class Ring {
  T items_[n];
  int32_t next_, size_;

 public:
  int32_t size() const { return size_; }
  bool is_full() const { return size_ == n; }
  void clear() { next_ = size_ = 0; }
  // The place of a new item, that of the oldest one.
  T &add() {
    T &place = items_[next_];
    next_ = next_ + 1 < n ? next_ + 1 : 0;
    if (size_ < n) ++size_;
    return place;
  }
  T &at(int32_t age) {
    const int32_t i = next_ - 1 - age;
    return items_[i < 0 ? i + n : i];
  }
  const T &at(int32_t age) const { return const_cast<Ring *>(this)->at(age); }
};

// The bias of the gyro: the mean of the last rests, windows of 1.5 s with little scatter of rate and acceleration.
template <class Real>
class RestBias {
  static constexpr int n_rests = 20;
  static constexpr double window_s = 1.5, largest_rate = 0.008726646259971648, largest_acceleration = 0.15;
  Scatter<Real> rate_, acceleration_;
  Ring<Vector<Real>, n_rests> rests_;
  int64_t window_;

 public:
  // Add readings, null if missing, at a time since the start; return whether a rest ends there.
  bool add(double time, const Vector<Real> *rate, const Vector<Real> *acceleration, Real rate_step,
           Real acceleration_step) {
    const int64_t window = (int64_t)(time / window_s * (1.0 + 1e-9));
    const bool ends = window != window_, is_rest = ends && is_at_rest(rate_step, acceleration_step);
    if (is_rest) rests_.add() = rate_.mean();
    if (ends) window_ = window, rate_.clear(), acceleration_.clear();
    if (rate) rate_.add(*rate);
    if (acceleration) acceleration_.add(*acceleration);
    return is_rest;
  }
  Vector<Real> bias() const {
    Vector<Real> sum = {};
    for (int32_t age = rests_.size() - 1; age >= 0; --age) sum += rests_.at(age);
    return (1 / Real(rests_.size())) * sum;
  }

 private:
  bool is_at_rest(Real rate_step, Real acceleration_step) const {
    const Real enough = Real(0.5 * window_s);
    return rate_.count >= 2 && acceleration_.count >= 2 && rate_.count * rate_step >= enough &&
           acceleration_.count * acceleration_step >= enough && rate_.deviation() < Real(largest_rate) &&
           acceleration_.deviation() < Real(largest_acceleration);
  }
};

// Turns of the gyro from sample to sample, and the variance of the turn that a gap hides. A missing sample holds the
// last rate, and the next one corrects for it.
template <class Real>
class GyroSteps {
  static constexpr double tiny = 1e-12, change_s = 1.0, longest = 10.0;
  Vector<Real> last_;
  Real held_, hidden_, since_, mean_square_, count_;
  UsualStep<Real> usual_;
  bool is_read_;

 public:
  Real usual_step() const { return usual_.seconds; }
  Real since() const { return since_; }
  // The variance that a gap has hidden so far; of a gap that has ended it is still there until the next step.
  Real hidden() const { return hidden_; }
  bool is_gap() const { return usual_.is_gap(since_); }
  bool is_read() const { return is_read_; }

  // Return the turn of a step of dt, and how the variance grows.
  struct Turn {
    Vector<Real> vector;  // rad
    Real growth;          // rad^2
  };
  Turn step(Real dt, const Vector<Real> *rate, const Vector<Real> &bias, bool is_point, Real held_rate,
            Real usual_rate) {
    if (is_read_) since_ = hidden_ = held_ = 0;
    is_read_ = rate != nullptr;
    since_ += dt;
    Turn turn = {};
    const bool is_gap = usual_.is_gap(since_);
    if (is_gap) {
      const Real deviation = hidden_turn(since_, held_rate, usual_rate), variance = deviation * deviation;
      turn.growth = variance - hidden_ > Real(tiny) ? variance - hidden_ : Real(tiny);
      hidden_ += turn.growth;
    }
    if (!rate) {
      turn.vector = dt * (last_ - bias);
      held_ += dt;
      return turn;
    }
    const Vector<Real> mean = is_point || is_gap ? 0.5 * (last_ + *rate) : *rate;
    turn.vector = since_ * mean - held_ * last_ - dt * bias;
    usual_.add(since_);
    add(*rate);
    return turn;
  }
  // The first sample.
  void start(const Vector<Real> &rate) {
    is_read_ = true;
    add(rate);
  }
  bool has_sample() const { return count_ > 0; }

 private:
  void add(const Vector<Real> &rate) {
    last_ = rate;
    count_ += 1;
    mean_square_ += (dot(rate, rate) - mean_square_) / count_;
  }
  Real hidden_turn(Real seconds, Real held_rate, Real usual_rate) const {
    const Real squared = usual_rate * usual_rate, larger = mean_square_ > squared ? mean_square_ : squared;
    const double x = seconds < Real(longest * change_s) ? seconds / change_s : longest, part = x * x * x * x * x * x;
    const double usual = square_root(double(larger)) * part / (1.0 + part);
    const double turn = square_root(held_rate * held_rate + usual * usual) * seconds;
    return Real(turn < unknown_angle ? turn : unknown_angle);
  }
};

// Attitudes of the gyro over the last moments, for a magnetometer that lags behind it.
template <class Real>
class AttitudeHistory {
  static constexpr int n = 16;
  struct Attitude {
    double time;
    Quaternion<Real> q;
  };
  Ring<Attitude, n> last_;

 public:
  // Add an attitude, unless it is closer to the last one than a lag needs.
  void add(double time, const Quaternion<Real> &q, Real lag) {
    if (last_.size() == 0 || time - last_.at(0).time >= lag / (n - 4)) last_.add() = {time, q};
  }
  // The attitude at a time, between those before and after it; now is the latest one.
  Quaternion<Real> at(double time, double now_time, const Quaternion<Real> &now) const {
    Attitude after = {now_time, now};
    for (int32_t age = 0; age < last_.size(); ++age) {
      const Attitude &before = last_.at(age);
      if (before.time <= time) {
        const double step = after.time - before.time;
        const Real share = step > 0 ? Real((time - before.time) / step) : Real(0);
        return normalised((1 - share) * before.q + share * after.q);
      }
      after = before;
    }
    return after.q;
  }
};
MAGLOC_END
