// A body followed over rows: an iterated extended Kalman filter of its pose, its rates, and lasting errors of magnets
// and sensors. magloc/bodies/readable_filter.py is the readable reference.
//
// Readings depend on the pose and the errors only, the first d states. An update is Gauss-Newton on these,
// with the inverse of their predicted covariance as information of the prior; the rates follow by regression.
#pragma once
#include "body.hpp"

MAGLOC_BEGIN
// Square matrices in the caller's memory, row by row.
struct Square {
  double *a;
  int64_t n;

  double *operator[](int64_t i) const { return a + n * i; }
};

// Invert a symmetric positive matrix in place, by the sweep operator; it is scaled to a unit diagonal first.
inline void invert(const Square &m, double *scale, double *column) {
  const int64_t n = m.n;
  for (int64_t i = 0; i < n; ++i) scale[i] = m[i][i] > 0.0 ? 1.0 / square_root(m[i][i]) : 1.0;
  for (int64_t i = 0; i < n; ++i)
    for (int64_t j = 0; j < n; ++j) m[i][j] *= scale[i] * scale[j];
  for (int64_t k = 0; k < n; ++k) {
    const double inverse = 1.0 / m[k][k];
    for (int64_t i = 0; i < n; ++i) column[i] = m[i][k];
    for (int64_t i = 0; i < n; ++i) {
      if (i == k) continue;
      const double share = inverse * column[i];
      for (int64_t j = 0; j < n; ++j) m[i][j] -= share * column[j];
    }
    for (int64_t i = 0; i < n; ++i) m[i][k] = m[k][i] = inverse * column[i];
    m[k][k] = -inverse;
  }
  for (int64_t i = 0; i < n; ++i)
    for (int64_t j = 0; j < n; ++j) m[i][j] *= -scale[i] * scale[j];
}

template <class Channels>
class BodyFilter {
  static constexpr int64_t pose = 6, rates = 6;
  const magloc_pose_track &p_;
  Channels channels_;
  PoseFit<double> fit_;
  const int64_t q_, a_, d_, n_, c_;
  const Square P_, moved_, prior_, posterior_;
  double weight_ = 0.0;  // of a row
  double *const F_,
      *const columns_, *const error_, *const gradient_,
                                          *const step_, *const scale_, *const column_,
                                                                           *const gain_, *const lost_,
                                                                                             *const rest_,
                                                                                                 *const of_magnet_,
                                                                                                     *const strength_,
                                                                                                         *const errors_;

 public:
  BodyFilter(const magloc_pose_track &p, Workspace &room)
      : p_(p),
        channels_(*p.fit->channels, p.fit->signals, room),
        fit_(*p.fit, channels_, room),
        q_(p.n_magnet_errors),
        a_(p.n_sensor_errors),
        d_(pose + q_ + a_),
        n_(d_ + rates),
        c_(p.fit->channels->n_channels),
        P_{p.covariance, n_},
        moved_{room.take<double>(n_ * n_), n_},
        prior_{room.take<double>(d_ * d_), d_},
        posterior_{room.take<double>(d_ * d_), d_},
        F_(room.take<double>(n_ * n_)),
        columns_(room.take<double>(d_ * c_)),
        error_(room.take<double>(d_)),
        gradient_(room.take<double>(d_)),
        step_(room.take<double>(d_)),
        scale_(room.take<double>(d_)),
        column_(room.take<double>(d_)),
        gain_(room.take<double>(rates * d_)),
        lost_(room.take<double>(d_)),
        rest_(room.take<double>(c_)),
        of_magnet_(room.take<double>(c_)),
        strength_(room.take<double>(p.fit->n_magnets)),
        errors_(room.take<double>(q_ + a_)) {}

  void follow(int64_t row) {
    if (!p_.progress[1]) return;
    predict(p_.steps + 10 * row, a_ ? p_.lasting + a_ * row : nullptr, a_ ? p_.added + a_ * row : nullptr);
    channels_.load(0, p_.fit->row[row]);
    const bool agrees = update(row);
    p_.status[row] = agrees ? 1 : 2;
    p_.progress[0] = agrees ? 0 : p_.progress[0] + 1;
    if (p_.progress[0] >= p_.most_contradictions) p_.progress[1] = 0;
    __builtin_memcpy(p_.poses + 12 * row, p_.pose, 12 * sizeof(double));
    __builtin_memcpy(p_.all_rates + rates * row, p_.rates, rates * sizeof(double));
    double *const covariance = p_.covariances + 144 * row;
    for (int64_t i = 0; i < 12; ++i)
      for (int64_t j = 0; j < 12; ++j) covariance[12 * i + j] = P_[i < 6 ? i : d_ + i - 6][j < 6 ? j : d_ + j - 6];
  }

 private:
  // The state after a step; rates fade, and their noise moves the pose.
  void predict(const double *steps, const double *lasting, const double *added) {
    const double *const of_x = steps, *const of_turn = steps + 5;
    double turn[3];
    for (int i = 0; i < 3; ++i) {
      p_.pose[i] += of_x[0] * p_.rates[i];
      turn[i] = of_turn[0] * p_.rates[3 + i];
      p_.rates[i] *= of_x[1];
      p_.rates[3 + i] *= of_turn[1];
    }
    turn_body(p_.pose + 3, turn);
    for (int64_t i = 0; i < n_ * n_; ++i) F_[i] = 0.0;
    for (int64_t i = 0; i < n_; ++i) F_[n_ * i + i] = 1.0;
    for (int i = 0; i < 3; ++i) {
      const int64_t x = i, theta = 3 + i, v = d_ + i, omega = d_ + 3 + i, j = 3 + (i + 1) % 3, k = 3 + (i + 2) % 3;
      F_[n_ * x + v] = of_x[0], F_[n_ * v + v] = of_x[1];
      F_[n_ * theta + omega] = of_turn[0], F_[n_ * omega + omega] = of_turn[1];
      F_[n_ * theta + k] = -turn[(i + 1) % 3], F_[n_ * theta + j] = turn[(i + 2) % 3];  // -[turn]x
    }
    for (int64_t e = 0; e < a_; ++e) {
      F_[(n_ + 1) * (pose + q_ + e)] = lasting[e];
      p_.errors[q_ + e] *= lasting[e];
    }
    propagate();
    for (int i = 0; i < 3; ++i) {
      add_noise(i, d_ + i, of_x + 2);
      add_noise(3 + i, d_ + 3 + i, of_turn + 2);
    }
    for (int64_t e = 0; e < a_; ++e) P_[pose + q_ + e][pose + q_ + e] += added[e] * added[e];
  }
  void add_noise(int64_t i, int64_t rate, const double *root) {
    P_[i][i] += root[0] * root[0];
    P_[i][rate] += root[0] * root[1];
    P_[rate][i] = P_[i][rate];
    P_[rate][rate] += root[1] * root[1] + root[2] * root[2];
  }
  // P becomes F P F^T; rows of F have few numbers that are not zero.
  void propagate() {
    for (int64_t i = 0; i < n_; ++i) {
      for (int64_t j = 0; j < n_; ++j) moved_[i][j] = 0.0;
      for (int64_t k = 0; k < n_; ++k) {
        const double f = F_[n_ * i + k];
        if (f == 0.0) continue;
        for (int64_t j = 0; j < n_; ++j) moved_[i][j] += f * P_[k][j];
      }
    }
    for (int64_t i = 0; i < n_; ++i)
      for (int64_t j = 0; j <= i; ++j) {
        double sum = 0.0;
        for (int64_t k = 0; k < n_; ++k)
          if (F_[n_ * j + k] != 0.0) sum += moved_[i][k] * F_[n_ * j + k];
        P_[i][j] = sum;
      }
    for (int64_t i = 0; i < n_; ++i)
      for (int64_t j = 0; j < i; ++j) P_[j][i] = P_[i][j];
  }

  // Rotate a body by a small vector in its own frame: R exp([turn]x).
  static void turn_body(double *R, const double (&turn)[3]) {
    double transposed[3][3], result[3][3];
    const double back[3] = {-turn[0], -turn[1], -turn[2]};
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) transposed[i][j] = R[3 * j + i];
    PoseFit<double>::rotate(back, transposed, result);
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) R[3 * j + i] = result[i][j];
  }

  // Linearise about the trial state: columns (d, n_channels) and the residual, whose square is returned.
  double linearise(const PoseState<double> &trial, int64_t row) {
    PoseState<double> state = trial;
    for (int64_t k = 0; k < p_.fit->n_magnets; ++k) {
      strength_[k] = 1.0;
      for (int64_t e = 0; e < q_; ++e) strength_[k] += p_.magnet_errors[q_ * k + e] * errors_[e];
    }
    fit_.linearise(channels_, state, strength_);
    const double *by_pose = fit_.columns();
    for (int64_t c = 0; c < c_; ++c) {
      rest_[c] = fit_.residual()[c];
      for (int j = 0; j < 3; ++j) {
        const double *const r = by_pose + 6 * c + 3;
        columns_[c_ * j + c] = by_pose[6 * c + j];
        columns_[c_ * (3 + j) + c] = r[0] * state.R[0][j] + r[1] * state.R[1][j] + r[2] * state.R[2][j];
      }
    }
    for (int64_t e = 0; e < q_; ++e)
      for (int64_t c = 0; c < c_; ++c) columns_[c_ * (pose + e) + c] = 0.0;
    for (int64_t k = 0; q_ && k < p_.fit->n_magnets; ++k) {
      double *const of_magnet = of_magnet_;
      fit_.read_magnet(channels_, state, k, strength_[k], of_magnet);
      for (int64_t e = 0; e < q_; ++e)
        for (int64_t c = 0; c < c_; ++c) columns_[c_ * (pose + e) + c] += p_.magnet_errors[q_ * k + e] * of_magnet[c];
    }
    for (int64_t e = 0; e < a_; ++e) {
      const double *const effect = p_.sensor_errors + c_ * (a_ * row + e);
      for (int64_t c = 0; c < c_; ++c) {
        columns_[c_ * (pose + q_ + e) + c] = effect[c];
        rest_[c] -= effect[c] * errors_[q_ + e];
      }
    }
    if (!(weight_ > 0.0)) weight_ = weight_of_row(row, state.nearest);
    for (int64_t i = 0; i < d_ * c_; ++i) columns_[i] *= weight_;
    double square = 0.0;
    for (int64_t c = 0; c < c_; ++c) {
      rest_[c] *= weight_;
      square += rest_[c] * rest_[c];
    }
    return square;
  }

  // A pose that is uncertain bends the readings by their size times the square of the uncertainty, relative to the
  // distance. This counts as noise: otherwise the first rows would be believed as if they were exact.
  double weight_of_row(int64_t row, double nearest) const {
    double square = 0.0;
    for (int64_t c = 0; c < c_; ++c) square += channels_.y[c] * channels_.y[c];
    const double of_place = P_[0][0] + P_[1][1] + P_[2][2], of_turn = P_[3][3] + P_[4][4] + P_[5][5];
    const double spread = 6.0 * nearest * nearest * of_place + 0.5 * of_turn;
    const double bend = p_.curvature[row] * spread * square_root(square / (double)c_);
    return 1.0 / square_root(1.0 + bend * bend);
  }

  // Update by a row; return whether it agrees with the prediction. Otherwise the state stays as predicted.
  bool update(int64_t row) {
    PoseState<double> state;
    PoseFit<double>::clear(state);
    double turned[3] = {};
    for (int i = 0; i < 3; ++i) state.x[i] = p_.pose[i];
    for (int i = 0; i < 9; ++i) state.R[i / 3][i % 3] = p_.pose[3 + i];
    for (int64_t e = 0; e < q_ + a_; ++e) errors_[e] = p_.errors[e];
    for (int64_t i = 0; i < d_; ++i) {
      error_[i] = 0.0;
      for (int64_t j = 0; j < d_; ++j) prior_[i][j] = P_[i][j];
    }
    invert(prior_, scale_, column_);
    double cost = infinity;
    weight_ = 0.0;
    for (int64_t iteration = 0; iteration < p_.max_iterations; ++iteration) {
      cost = linearise(state, row);
      for (int64_t i = 0; i < d_; ++i) {
        double sum = 0.0, of_prior = 0.0;
        for (int64_t c = 0; c < c_; ++c) sum += columns_[c_ * i + c] * rest_[c];
        for (int64_t j = 0; j < d_; ++j) of_prior += prior_[i][j] * error_[j];
        gradient_[i] = sum - of_prior;
        cost += error_[i] * of_prior;
        for (int64_t j = 0; j <= i; ++j) {
          double product = prior_[i][j];
          for (int64_t c = 0; c < c_; ++c) product += columns_[c_ * i + c] * columns_[c_ * j + c];
          posterior_[i][j] = posterior_[j][i] = product;
        }
      }
      invert(posterior_, scale_, column_);
      double promised = 0.0;
      for (int64_t i = 0; i < d_; ++i) {
        step_[i] = 0.0;
        for (int64_t j = 0; j < d_; ++j) step_[i] += posterior_[i][j] * gradient_[j];
        promised += step_[i] * gradient_[i];
      }
      if (!(promised < infinity)) return false;
      double turn[3];
      for (int i = 0; i < 3; ++i) {
        state.x[i] += step_[i];
        turn[i] = step_[3 + i];
      }
      turn_body(&state.R[0][0], turn);
      for (int64_t i = 0; i < d_; ++i) error_[i] += step_[i];
      // The rotation from the prediction, of two rotations in succession to the second order.
      for (int i = 0; i < 3; ++i) {
        const int j = (i + 1) % 3, k = (i + 2) % 3;
        error_[3 + i] += 0.5 * (turned[j] * turn[k] - turned[k] * turn[j]);
      }
      for (int i = 0; i < 3; ++i) turned[i] = error_[3 + i];
      for (int64_t e = 0; e < q_ + a_; ++e) errors_[e] += step_[pose + e];
      cost -= promised;
      if (promised < p_.tolerance) break;
    }
    p_.nis[row] = cost;
    if (!(cost < p_.nis_limits[row])) return false;
    for (int i = 0; i < 3; ++i) p_.pose[i] = state.x[i];
    for (int i = 0; i < 9; ++i) p_.pose[3 + i] = state.R[i / 3][i % 3];
    for (int64_t e = 0; e < q_ + a_; ++e) p_.errors[e] = errors_[e];
    regress_rates();
    return true;
  }

  // Rates and the covariance after an update of the first d states, whose covariance was P and is the posterior.
  void regress_rates() {
    for (int64_t r = 0; r < rates; ++r) {
      double *const gain = gain_ + d_ * r;
      for (int64_t j = 0; j < d_; ++j) {
        gain[j] = 0.0;
        for (int64_t k = 0; k < d_; ++k) gain[j] += P_[d_ + r][k] * prior_[k][j];
      }
      for (int64_t j = 0; j < d_; ++j) p_.rates[r] += gain[j] * error_[j];
    }
    for (int64_t r = 0; r < rates; ++r) {
      double *const lost = lost_;
      for (int64_t j = 0; j < d_; ++j) {
        double sum = 0.0;
        for (int64_t k = 0; k < d_; ++k) sum += gain_[d_ * r + k] * posterior_[k][j];
        lost[j] = P_[d_ + r][j] - sum;
        moved_[d_ + r][j] = sum;
      }
      for (int64_t s = 0; s <= r; ++s) {
        double sum = 0.0;
        for (int64_t j = 0; j < d_; ++j) sum += lost[j] * gain_[d_ * s + j];
        moved_[d_ + r][d_ + s] = P_[d_ + r][d_ + s] - sum;
      }
    }
    for (int64_t i = 0; i < d_; ++i)
      for (int64_t j = 0; j < d_; ++j) P_[i][j] = posterior_[i][j];
    for (int64_t r = 0; r < rates; ++r) {
      for (int64_t j = 0; j < d_; ++j) P_[d_ + r][j] = P_[j][d_ + r] = moved_[d_ + r][j];
      for (int64_t s = 0; s <= r; ++s) P_[d_ + r][d_ + s] = P_[d_ + s][d_ + r] = moved_[d_ + r][d_ + s];
    }
  }
};
MAGLOC_END
