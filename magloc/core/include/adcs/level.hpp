// The direction up of an inertial unit, one reading at a time: the acceleration, smoothed in a frame that does not
// rotate. adcs/complementary/inertial/level.py explains the method.
#pragma once
#include "adcs/inertial.hpp"

MAGLOC_BEGIN
// The time constants of the low-pass among which predictions choose, s; the first one is as published for VQF.
constexpr double gravity_times[3] = {3.0, 1.5, 0.7};
constexpr double tilt_floor = 0.006981317007977318;  // rad; a shorter time constant has to gain more

template <class Real>
class DirectionUp {
  static constexpr int n_times = 3, n_predictions = 8;
  static constexpr double predicted_s = 2.0, gravity = 9.81, mean_s = 0.5, window_s = 1.5, least_acceleration = 0.1;
  static constexpr double least_gap_s = 1.0, least_hidden = 0.025, much = 2.0, held_variance = 4.0;
  enum Mode { from_rest, continued, fresh };
  struct Prediction {
    double time;
    Vector<Real> up[n_times], later;  // the integral of the acceleration since then
  };

  LowPass<Real> smooth_[n_times][3];
  Mode mode_;
  Scatter<Real> restart_, window_;  // readings since a restart, and of the window
  double restarted_, window_end_, read_;
  Real before_, scatter_before_;             // sigma at the last restart, and of one reading then
  Real scatter_, mean_scatter_, n_windows_;  // of a reading, m/s^2
  Real held_sigma_, held_growth_, sigma_;    // before a gap, the variance that it adds, and now
  Ring<Prediction, n_predictions> predictions_;
  Real mean_squares_[n_times], n_later_;
  int32_t best_;
  UsualStep<Real> usual_;
  bool restarts_;

 public:
  Real sigma() const { return sigma_; }
  Real usual_step() const { return usual_.seconds; }
  bool is_fresh(double time) const { return mode_ == fresh && time - restarted_ < gravity_times[best_]; }
  bool is_gap(double time) const { return usual_.is_gap(Real(time - read_), Real(least_gap_s)); }
  Vector<Real> up() const { return smoothed(best_); }
  // Sigma of the drift of a gyro for which the longest time constant is too long.
  Real drift() const { return best_ > 0 ? square_root(mean_squares_[0] - mean_squares_[best_]) : Real(0); }
  void count_step(Real step) { usual_.add(step); }

  // Start from the mean of readings at rest, or without them from the next reading.
  void start(double time, const Scatter<Real> &readings, bool is_at_rest) {
    for (auto &low_pass : smooth_)
      for (int i = 0; i < 3; ++i) low_pass[i].start(readings.mean()[i]);
    scatter_ = mean_scatter_ = readings.deviation(), n_windows_ = 1;
    mode_ = from_rest, restarts_ = !is_at_rest;
    read_ = restarted_ = time, window_end_ = time + window_s;
    held_sigma_ = sigma_ = is_at_rest ? Real(0) : Real(unknown_angle);
  }

  // A gap of the gyro hides a turn; the readings within it are not used.
  void hide(Real growth) {
    if (!restarts_) held_sigma_ = sigma_, held_growth_ = 0, restarts_ = true;
    held_growth_ += growth;
    sigma_ = square_root(held_sigma_ * held_sigma_ + Real(held_variance) * held_growth_);
  }
  static bool hides_much(Real hidden) { return hidden > Real(least_hidden * least_hidden); }

  // Take a reading in the frame that does not rotate. The drift of the gyro counts in a gap of the accelerometer.
  // Return how the variance of the attitude grows if the acceleration shows a larger turn than a gap may hide.
  Real step(double time, const Vector<Real> &acceleration, Real drift_rate) {
    const Real since = Real(time - read_), dt = since;
    Real growth = 0;
    if (usual_.is_gap(since, Real(least_gap_s)) && !restarts_) {
      held_sigma_ = sigma_at(read_), held_growth_ = drift_rate * since * drift_rate * since, restarts_ = true;
    } else if (restarts_ && held_growth_ > 0) {
      const Real unknown = square_root(held_sigma_ * held_sigma_ + held_growth_), seen = angle_to(acceleration);
      if (seen > unknown && seen > 3 * scatter_angle()) growth = seen * seen - unknown * unknown;
      held_growth_ += growth;
    }
    usual_.add(since);
    read_ = time;
    if (restarts_)
      restart(time, acceleration);
    else
      smooth(time, dt, acceleration);
    add_to_window(time, acceleration);
    predict(time, dt, acceleration);
    sigma_ = sigma_at(time);
    return growth;
  }
  // Go on without a reading.
  void wait(double time, Real drift_rate) {
    if (restarts_) return;
    sigma_ = sigma_at(is_gap(time) ? read_ : time);
    if (!is_gap(time)) return;
    const Real turn = drift_rate * Real(time - read_);
    sigma_ = square_root(sigma_ * sigma_ + Real(held_variance) * turn * turn);
  }

 private:
  Vector<Real> smoothed(int k) const {
    return normalised(Vector<Real>{{smooth_[k][0].output, smooth_[k][1].output, smooth_[k][2].output}});
  }
  Real scatter_angle() const {
    const double larger = scatter_ > mean_scatter_ ? scatter_ : mean_scatter_;
    return Real(square_root(larger * larger + least_acceleration * least_acceleration) / gravity);
  }
  Real angle_to(const Vector<Real> &acceleration) const {
    const Vector<Real> one = up(), other = normalised(acceleration), across = cross(one, other);
    return Real(arc_tangent(double(square_root(dot(across, across))), double(dot(one, other))));
  }
  void restart(double time, const Vector<Real> &acceleration) {
    before_ = square_root(held_sigma_ * held_sigma_ + held_growth_);
    if (before_ > Real(unknown_angle)) before_ = Real(unknown_angle);
    scatter_before_ = scatter_angle();
    mode_ = before_ < Real(much) * scatter_before_ ? continued : fresh;
    restarted_ = time, restarts_ = false, held_growth_ = 0;
    predictions_.clear();
    if (mode_ == fresh) restart_.clear(), restart_.add(acceleration);
    for (auto &low_pass : smooth_)
      for (int i = 0; i < 3; ++i) {
        low_pass[i].start(mode_ == fresh ? acceleration[i] : low_pass[i].output);
        low_pass[i].input = acceleration[i];
      }
  }
  void smooth(double time, Real dt, const Vector<Real> &acceleration) {
    const double age = time - restarted_;
    if (mode_ == fresh && age < gravity_times[0]) restart_.add(acceleration);
    for (int k = 0; k < n_times; ++k) {
      if (mode_ == fresh && age < gravity_times[k]) {
        const Vector<Real> mean = restart_.mean();
        for (int i = 0; i < 3; ++i) smooth_[k][i].start(mean[i]), smooth_[k][i].input = acceleration[i];
        continue;
      }
      double cosine, sine;
      damped_rotation(dt / gravity_times[k], cosine, sine);
      for (int i = 0; i < 3; ++i) smooth_[k][i].step(cosine, sine, acceleration[i]);
    }
  }
  Real sigma_at(double time) const {
    const double age = time - restarted_, constant = gravity_times[best_];
    if (mode_ == from_rest) return 0;
    if (mode_ == continued) return Real(before_ * (1.0 + age / constant) * exponential(-age / constant));
    const double late = age > constant ? (age - constant) / constant : 0.0;
    return Real(scatter_before_ / (1.0 + age / mean_s) * exponential(-late));
  }
  void add_to_window(double time, const Vector<Real> &acceleration) {
    if (time >= window_end_) {
      if (window_.count > 1) {
        scatter_ = window_.deviation();
        n_windows_ += 1;
        mean_scatter_ += (scatter_ - mean_scatter_) / n_windows_;
      }
      window_.clear();
      window_end_ = time + window_s;
    }
    window_.add(acceleration);
  }
  // Compare the mean of the acceleration with earlier directions up, and choose the time constant that is nearest.
  void predict(double time, Real dt, const Vector<Real> &acceleration) {
    for (int32_t age = 0; age < predictions_.size(); ++age) predictions_.at(age).later += dt * acceleration;
    if (predictions_.size() > 0 && time < predictions_.at(0).time + predicted_s / n_predictions) return;
    if (predictions_.is_full()) compare(predictions_.at(n_predictions - 1));
    Prediction &place = predictions_.add();
    place.time = time, place.later = {};
    for (int k = 0; k < n_times; ++k) place.up[k] = smoothed(k);
  }
  void compare(const Prediction &place) {
    if (!(dot(place.later, place.later) > 0 && dot(place.up[0], place.up[0]) > 0)) return;
    const Vector<Real> later = normalised(place.later);
    n_later_ += 1;
    int32_t least = 0;
    for (int k = 0; k < n_times; ++k) {
      const Vector<Real> error = later - place.up[k];
      mean_squares_[k] += (dot(error, error) - mean_squares_[k]) / n_later_;
      if (mean_squares_[k] < mean_squares_[least]) least = k;
    }
    best_ = mean_squares_[0] - mean_squares_[least] > Real(tilt_floor * tilt_floor) ? least : 0;
  }
};
MAGLOC_END
