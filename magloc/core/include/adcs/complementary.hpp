// Filters of a gyro and two vectors: complementary ones with fixed gains, and the adaptive error-state filter.
// tests/adcs/complementary/readable.py is the readable reference and has the formulas.
#pragma once
#include "adcs/rotation.hpp"
#include "magloc.h"

MAGLOC_BEGIN
// What is measured of a vector, and what it is in the reference frame.
struct VectorPair {
  Vector<double> body, reference;

  bool is_there() const { return is_read(body) && is_read(reference); }
  VectorPair units() const { return {normalised(body), normalised(reference)}; }
};

// Row of an array (n_runs, n_steps, 3) or (n_references, n_steps, 3), and so on, for an instant of a run.
struct RecordInstant {
  const magloc_vector_record &record;
  int64_t run, i;

  int64_t row() const { return run * record.n_steps + i; }
  int64_t shared_row() const { return (record.n_references == 1 ? 0 : run) * record.n_steps + i; }
  double dt() const { return record.dt[i]; }
  Vector<double> rate() const { return vector_at(record.rate + 3 * row()); }
  Quaternion<double> frame_turn() const { return quaternion_at(record.frame_turn + 4 * shared_row()); }
  VectorPair first() const {
    return {vector_at(record.first + 3 * row()), vector_at(record.first_reference + 3 * shared_row())};
  }
  VectorPair second() const {
    return {vector_at(record.second + 3 * row()), vector_at(record.second_reference + 3 * shared_row())};
  }
};

// Call step(instant) for the items begin, ..., end - 1 of a record.
template <class Step>
inline void for_instants(const magloc_vector_record &record, int64_t begin, int64_t end, Step step) {
  RecordInstant at = {record, begin / record.n_steps, begin % record.n_steps};
  for (int64_t item = begin; item < end; ++item) {
    step(at);
    if (++at.i == record.n_steps) at.i = 0, ++at.run;
  }
}

// One step towards the quaternion that two measured vectors state, by Gauss and Newton. With q + dq = q eta the normal
// equations fall apart into one for the scalar part of eta and three for the vector part, with the matrix
// 4 sum (I - v v^T) + mu I.
inline Quaternion<double> gauss_newton_step(const Quaternion<double> &q, const VectorPair (&pairs)[2], double mu) {
  double xx = mu, yy = mu, zz = mu, xy = 0.0, xz = 0.0, yz = 0.0, along = 0.0, count = 0.0;
  Vector<double> g = {};
  for (const VectorPair &pair : pairs) {
    if (!pair.is_there()) continue;
    const Vector<double> v = pair.body, predicted = rotate_back(q, pair.reference);
    xx += 4.0 * (1.0 - v[0] * v[0]), yy += 4.0 * (1.0 - v[1] * v[1]), zz += 4.0 * (1.0 - v[2] * v[2]);
    xy -= 4.0 * v[0] * v[1], xz -= 4.0 * v[0] * v[2], yz -= 4.0 * v[1] * v[2];
    g += 2.0 * cross(v, predicted);
    along += 2.0 * (dot(v, predicted) - 1.0);
    count += 4.0;
  }
  if (count == 0.0) return q;
  // Rows of the matrix of cofactors, which is symmetric.
  const Vector<double> first = {{yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy}};
  const Vector<double> second = {{first[1], xx * zz - xz * xz, xy * xz - xx * yz}};
  const Vector<double> third = {{first[2], second[2], xx * yy - xy * xy}};
  const double inverse = 1.0 / (xx * first[0] + xy * first[1] + xz * first[2]);
  const Vector<double> turn = {{dot(first, g), dot(second, g), dot(third, g)}};
  return normalised(q * Quaternion<double>{1.0 + along / (count + mu), inverse * turn});
}

// Complementary filter of one run.
class ComplementaryFilter {
  Quaternion<double> q_, measured_, body_turned_, frame_turned_;  // the last two since the start
  Vector<double> integral_, smoothed_error_;

 public:
  static ComplementaryFilter start(const Quaternion<double> &q, const Vector<double> &integral) {
    ComplementaryFilter filter;
    filter.q_ = filter.measured_ = q;
    filter.body_turned_ = filter.frame_turned_ = identity;
    filter.integral_ = integral;
    filter.smoothed_error_ = {};
    return filter;
  }
  const Quaternion<double> &attitude() const { return q_; }
  const Quaternion<double> &measured() const { return measured_; }
  const Vector<double> &integral() const { return integral_; }

  void turn(const magloc_complementary &p, const RecordInstant &at) {
    const Quaternion<double> body = exponential(at.dt() * (at.rate() + integral_)), frame = at.frame_turn();
    q_ = normalised(conjugate(frame) * q_ * body);
    if (p.is_transported) {
      body_turned_ = normalised(body_turned_ * body);
      frame_turned_ = normalised(frame_turned_ * frame);
    }
  }

  // Correct attitude and integral by the vectors of an instant. delayed (p.delay) holds the last first vectors, turned
  // back to the start.
  void correct(const magloc_complementary &p, const RecordInstant &at, VectorPair *delayed) {
    VectorPair pairs[2] = {at.first().units(), at.second().units()};
    const bool is_outage = !is_read(pairs[1].body);
    if (p.is_substituted) {
      VectorPair &place = delayed[at.i % p.delay];
      if (is_outage && at.i >= p.delay)
        pairs[1] = {rotate_back(body_turned_, place.body), rotate_back(frame_turned_, place.reference)};
      place = {rotate(body_turned_, pairs[0].body), rotate(frame_turned_, pairs[0].reference)};
    }
    const Vector<double> error = p.is_gauss_newton ? measured_error(pairs, p.mu) : explicit_error(pairs, p.weights);
    const double *gains = is_outage ? p.outage_gains : p.gains, counted = p.counted[at.i];
    smoothed_error_ = p.boost_memory * smoothed_error_ + (1.0 - p.boost_memory) * error;
    const bool is_boosted = dot(smoothed_error_, smoothed_error_) > p.boost_level * p.boost_level;
    integral_ += (is_boosted ? p.boost * gains[1] : gains[1]) * counted * error;
    q_ = normalised(q_ * exponential(gains[0] * counted * error));
  }

 private:
  Vector<double> explicit_error(const VectorPair (&pairs)[2], const double (&weights)[2]) const {
    Vector<double> e = {};
    for (int k = 0; k < 2; ++k)
      if (pairs[k].is_there()) e += weights[k] * cross(pairs[k].body, rotate_back(q_, pairs[k].reference));
    return e;
  }
  Vector<double> measured_error(const VectorPair (&pairs)[2], double mu) {
    // One vector leaves the turn around it to the estimate.
    const bool both = pairs[0].is_there() && pairs[1].is_there();
    measured_ = gauss_newton_step(both ? measured_ : q_, pairs, mu);
    return 2.0 * error_vector(q_, measured_);
  }
};

// Adaptive error-state filter of one run: attitude, and bias of the gyro with a covariance that grows faster where the
// innovations are larger than they should be.
class AdaptiveFilter {
  static constexpr int n = 6;
  Quaternion<double> q_;
  Vector<double> bias_;
  double covariance_[n][n], smoothed_nis_, more_growth_;

 public:
  static AdaptiveFilter start(const Quaternion<double> &q, const Vector<double> &bias, const double *covariance) {
    AdaptiveFilter filter;
    filter.q_ = q, filter.bias_ = bias;
    filter.smoothed_nis_ = 1.0, filter.more_growth_ = 0.0;
    for (int i = 0; i < n; ++i)
      for (int j = 0; j < n; ++j) filter.covariance_[i][j] = covariance[n * i + j];
    return filter;
  }
  void store(const magloc_adaptive &p, int64_t row) const {
    magloc::store(q_, p.q + 4 * row);
    magloc::store(bias_, p.bias + 3 * row);
    p.smoothed_nis[row] = smoothed_nis_;
    for (int i = 0; i < n; ++i)
      for (int j = 0; j < n; ++j) p.covariance[n * (n * row + i) + j] = covariance_[i][j];
  }

  // To the next instant. The error angle turns back with the body, and grows by that of the bias.
  void predict(const magloc_adaptive &p, const RecordInstant &at) {
    const double dt = at.dt();
    const Quaternion<double> turn = exponential(dt * (at.rate() - bias_));
    q_ = normalised(conjugate(at.frame_turn()) * q_ * turn);
    double (&P)[n][n] = covariance_, M[n][n];
    for (int j = 0; j < n; ++j) {
      const Vector<double> angle = rotate_back(turn, column(0, j)) - dt * column(3, j);
      for (int i = 0; i < n; ++i) M[i][j] = i < 3 ? angle[i] : P[i][j];
    }
    for (auto &row : M) magloc::store(rotate_back(turn, vector_at(row)) - dt * vector_at(row + 3), row);
    for (int i = 0; i < n; ++i)
      for (int j = 0; j <= i; ++j) P[i][j] = P[j][i] = 0.5 * (M[i][j] + M[j][i]);
    for (int i = 0; i < 3; ++i) {
      P[i][i] += p.attitude_growth * dt;
      P[3 + i][3 + i] += (p.bias_growth + more_growth_) * dt;
    }
  }

  void update(const magloc_adaptive &p, const RecordInstant &at) {
    const VectorPair first = at.first(), second = at.second();
    double x[n] = {}, nis = 0.0, degrees = 0.0;
    if (is_read(first.body)) {
      nis += vector_update(first, p.first_sigma * p.first_sigma / dot(first.body, first.body), x);
      degrees += 2.0;
    }
    if (is_read(second.body)) {
      nis += vector_update(second, p.second_sigma * p.second_sigma, x);
      degrees += 2.0;
    }
    q_ = normalised(q_ * exponential(vector_at(x)));
    bias_ += vector_at(x + 3);
    if (degrees > 0.0) smoothed_nis_ = p.memory * smoothed_nis_ + (1.0 - p.memory) * nis / degrees;
    // Only readings show that the bias changes.
    more_growth_ = degrees > 0.0 && smoothed_nis_ > p.threshold ? p.changed_growth : 0.0;
  }

 private:
  Vector<double> column(int first, int j) const {
    return {{covariance_[first][j], covariance_[first + 1][j], covariance_[first + 2][j]}};
  }
  // By a unit vector, along two axes across the predicted one; returns the normalised innovation squared.
  double vector_update(const VectorPair &pair, double variance, double (&x)[n]) {
    const VectorPair units = pair.units();
    const Vector<double> v = rotate_back(q_, units.reference);
    int across = 0;  // the axis that is most across v
    for (int i = 1; i < 3; ++i)
      if (__builtin_fabs(v[i]) < __builtin_fabs(v[across])) across = i;
    const Vector<double> one = normalised(cross(v, unit_vector<double>(across))), other = cross(v, one);
    return scalar_update(cross(one, v), dot(one, units.body), variance, x) +
           scalar_update(cross(other, v), dot(other, units.body), variance, x);
  }
  // Kalman update of the error x by z = h . (error angle) + noise; returns the normalised innovation squared.
  double scalar_update(const Vector<double> &h, double z, double variance, double (&x)[n]) {
    double (&P)[n][n] = covariance_, Ph[n];
    for (int i = 0; i < n; ++i) Ph[i] = dot(h, vector_at(P[i]));
    const double S = variance + dot(h, vector_at(Ph)), innovation = z - dot(h, vector_at(x));
    for (int i = 0; i < n; ++i) {
      const double gain = Ph[i] / S;
      x[i] += gain * innovation;
      for (int j = 0; j <= i; ++j) P[i][j] = P[j][i] = P[i][j] - gain * Ph[j];
    }
    return innovation * innovation / S;
  }
};
MAGLOC_END
