// Readings that contradict a filter, and the second hypothesis that they may begin. The readable reference, which says
// why the rules are as they are, is tests/adcs/kalman/readable.py.
#pragma once
#include "adcs/mekf.hpp"

MAGLOC_BEGIN
// The numbers of the readable reference, which explains them.
struct ContestRules {
  static constexpr int agree = 3, strain = 4, open = 80, patient_readings = 10;
  static constexpr double clip = 25.0, better = 15.0, worse = -30.0, far = 6.0;
};

struct Gate {
  double limit;                     // largest eased NIS of a reading that is used
  int64_t patience[Sensor::count];  // instants
};

// The counts by which the main hypothesis and the second one, where there is one, are compared.
class Contest {
  int64_t instant_ = 0;
  struct {
    int64_t taken = 0, last_taken = 0;  // readings by the main hypothesis
    int64_t last_read = 0, interval = 1;
    int strain = 0;  // of rejections that nothing explains
  } sensors_[Sensor::count];
  int began_ = -1;  // sensor of the reading that began the second hypothesis
  int agreed_ = 0, main_agreed_ = 0, missed_ = 0;
  bool after_gap_ = false;
  double score_ = 0.0;  // log-likelihood ratio of the other sensors, second over main

 public:
  enum Verdict { undecided, believed, dropped };
  struct Use {
    bool main, second;
  };

  bool has_second() const { return began_ >= 0; }
  void set_instant(int64_t instant) { instant_ = instant; }

  // Decide who takes a reading.
  Use decide(const Gate &gate, int sensor, const Fit &main, const Fit &second) {
    auto &counts = sensors_[sensor];
    const bool fits = main.eased <= gate.limit;
    Use use = {fits || counts.strain >= ContestRules::open, has_second() && second.eased <= gate.limit};
    if (fits)
      counts.strain -= counts.strain > 0;
    else if (sensor != began_ || agreed_ < ContestRules::patient_readings)
      counts.strain = counts.strain + ContestRules::strain < 2 * ContestRules::open
                          ? counts.strain + ContestRules::strain
                          : 2 * ContestRules::open;
    if (has_second() && sensor == began_) {
      if (use.main && use.second && agreed_ >= ContestRules::agree) {
        use.main = main.eased + main.log_determinant <= second.eased + second.log_determinant + ContestRules::far;
        use.second = !use.main;
      }
      agreed_ += use.second;
      main_agreed_ += use.main;
      missed_ = use.second ? 0 : missed_ + 1;
    } else if (has_second() && agreed_ > 1) {
      score_ += 0.5 * (clipped(main.eased) - clipped(second.eased));
    }
    if (use.main) {
      ++counts.taken;
      counts.last_taken = instant_;
    }
    return use;
  }

  // Return whether a rejected reading can begin a second hypothesis; both: field and Sun are read at this instant.
  template <class Model>
  bool may_begin(const Gate &gate, const Model &model, int sensor, bool both) const {
    if (has_second() || (sensor == Sensor::gyro && !model.has(Optional::gyro_bias))) return false;
    return sensor == Sensor::star_tracker || sensor == Sensor::gyro || both || waited(gate, sensor);
  }

  // Count from a reading that begins a second hypothesis.
  void begin(int sensor) {
    const auto &counts = sensors_[sensor];
    began_ = sensor;
    agreed_ = 1;
    main_agreed_ = missed_ = 0;
    after_gap_ = instant_ - counts.last_read > ContestRules::patient_readings * counts.interval;
    score_ = 0.0;
  }

  // Count a reading, after it has been decided on.
  void count(int sensor) {
    auto &counts = sensors_[sensor];
    const int64_t gap = instant_ - counts.last_read;
    if (gap <= 0) return;
    if (gap <= ContestRules::patient_readings * counts.interval || counts.last_read == 0) counts.interval = gap;
    counts.last_read = instant_;
  }

  // Return the verdict at the end of an instant; one that decides ends the contest.
  Verdict verdict(const Gate &gate) {
    auto &counts = sensors_[began_];
    Verdict found = undecided;
    if (score_ < ContestRules::worse) {
      counts.strain = 0;
      found = dropped;
    } else if (missed_ >= ContestRules::agree || main_agreed_ >= ContestRules::patient_readings) {
      found = dropped;
    } else if (agreed_ >= ContestRules::agree) {
      const bool unsupported = after_gap_ || counts.taken < ContestRules::agree || waited(gate, began_);
      if (score_ > ContestRules::better || (unsupported && score_ > -ContestRules::better)) {
        found = believed;
        counts.taken = agreed_;
        counts.last_taken = instant_;
      }
    }
    if (found != undecided) began_ = -1;
    return found;
  }

 private:
  static double clipped(double eased) { return eased < ContestRules::clip ? eased : ContestRules::clip; }
  bool waited(const Gate &gate, int sensor) const {
    return instant_ - sensors_[sensor].last_taken >= gate.patience[sensor];
  }
};

inline bool is_finite(double x) { return x - x == 0.0; }

// The attitude after the turn about a unit axis by an angle of which a length times sine and cosine are known.
template <class T>
inline Quaternion<T> turned_by(const Quaternion<T> &q, const Vector<T> &axis, T sine, T cosine) {
  // tan(a/2) = sin(a)/(1 + cos(a)) = (1 - cos(a))/sin(a): of both the one that does not cancel.
  const T length = square_root(sine * sine + cosine * cosine);
  Quaternion<T> turn = {length + cosine, sine * axis};
  if (cosine < 0) turn = {sine, (length - cosine) * axis};
  if (length == 0) turn = {1, {}};
  return normalised(q * turn);
}

// The attitude after the turn about a unit axis that brings a direction nearest to that of the reference frame.
template <class T>
inline Quaternion<T> turned_about(const Quaternion<T> &q, const Vector<T> &axis, const Vector<T> &body,
                                  const Vector<T> &reference) {
  const Vector<T> there = rotate_back(q, reference);
  return turned_by(q, axis, dot(axis, cross(body, there)), dot(body, there) - dot(axis, body) * dot(axis, there));
}

// The filter of one satellite, with its gate and second hypothesis.
template <class Real = double, class States = RuntimeStates>
class GatedFilter {
  typedef FilterModel<Real, States> Model;
  Hypothesis<Real, States> main_, second_;
  Contest contest_;

 public:
  void start(const Estimate<Real> &first) {
    main_.start(first);
    contest_ = Contest();
  }
  Hypothesis<Real, States> &main() { return main_; }
  const Hypothesis<Real, States> &main() const { return main_; }

  void predict(const Model &model, const Instant<Real> &now, const Instant<Real> &next, const Real *kept,
               const Real *added_variance, double dt) {
    main_.predict(model, now, next, kept, added_variance, dt);
    if (contest_.has_second()) second_.predict(model, now, next, kept, added_variance, dt);
  }

  // Take the readings of an instant; those of a sensor that is not in use are NaN. The results are of each sensor.
  void update(const Model &model, const Gate &gate, const Instant<Real> &now, const Readings<Real> &readings,
              int64_t instant, double *nis, double *log_determinant, uint8_t *rejected) {
    contest_.set_instant(instant);
    main_.begin_readings();
    if (contest_.has_second()) second_.begin_readings();
    const bool both = is_finite(readings.field[0]) && is_finite(readings.sun[0]);
    for (int sensor = 0; sensor < Sensor::count; ++sensor) {
      if (!is_finite(readings.first_number(sensor))) continue;
      const bool has_second = contest_.has_second();
      Fit fit_second = {nan, nan, nan};
      const Fit fit = main_.update(model, now, readings, sensor);
      if (has_second) fit_second = second_.update(model, now, readings, sensor);
      const Contest::Use use = contest_.decide(gate, sensor, fit, fit_second);
      if (!use.main) main_.undo();
      if (has_second && !use.second) second_.undo();
      if (!use.main && contest_.may_begin(gate, model, sensor, both)) {
        begin_second(model, now, readings, sensor);
        second_.update(model, now, readings, sensor);
        contest_.begin(sensor);
      }
      contest_.count(sensor);
      nis[sensor] = fit.nis;
      log_determinant[sensor] = fit.log_determinant;
      rejected[sensor] = !use.main;
    }
    main_.correct(model);
    if (contest_.has_second()) {
      second_.correct(model);
      if (contest_.verdict(gate) == Contest::believed) main_ = second_;
    }
  }

 private:
  // Make the second hypothesis one in which a reading is right, before that reading. Of a gyro its bias is open; else
  // the attitude is that of the readings, and all is open.
  void begin_second(const Model &model, const Instant<Real> &now, const Readings<Real> &readings, int sensor) {
    if (sensor == Sensor::gyro) {
      second_ = main_;
      Covariance<Real, States> &P = second_.P();
      for (int j = 0; j < 3; ++j) {
        const int at = model.place(Optional::gyro_bias) + j;
        for (int i = 0; i < model.n(); ++i) P[at][i] = P[i][at] = 0;
        P[at][at] = model.open_variance[at];
      }
    } else {
      second_.start(main_.x);
      second_.x.motion.q = read_attitude(main_.x.motion.q, now, readings, sensor);
      for (int i = 0; i < model.n(); ++i) second_.P()[i][i] = model.open_variance[i];
    }
    second_.keep_attitude_variance();
  }

  static Quaternion<Real> read_attitude(const Quaternion<Real> &q, const Instant<Real> &now,
                                        const Readings<Real> &readings, int sensor) {
    if (sensor == Sensor::star_tracker) return normalised(readings.star);
    if (!is_finite(readings.sun[0])) return turned_onto(q, readings.field, now.around.field);
    const Quaternion<Real> by_sun = turned_onto(q, readings.sun, now.sun);
    return is_finite(readings.field[0]) ? turned_about(by_sun, readings.sun, readings.field, now.around.field) : by_sun;
  }
};
MAGLOC_END
