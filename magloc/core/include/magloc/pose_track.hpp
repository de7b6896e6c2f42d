// A body followed over rows: an iterated extended Kalman filter of its pose, its rates, and lasting errors of magnets
// and sensors. magloc/bodies/readable_filter.py is the readable reference.
//
// Readings depend on the pose and the errors only, the first d states. An update iterates a Kalman update about the
// last pose. The readings are linear in the sensors' errors, so their part of the gain is computed once a row.
#pragma once
#include "body.hpp"
#include "padded.hpp"

MAGLOC_BEGIN
template <class Channels>
class BodyFilter {
  static constexpr int64_t pose = 6, rates = 6;
  const magloc_pose_track &p_;
  Channels channels_;
  PoseFit<double> fit_;
  const int64_t q_, a_, p_states_, d_, n_, c_;  // p_states_: pose and errors of the magnets
  // By the states: covariance, derivatives of the channels H, H P, and the part of H P by the sensors' errors.
  const Padded<Lanes> P_, H_, HP_, of_sensors_;
  const Padded<Lanes> S_;      // of the channels: covariance I + H P H^T, and the innovation
  const Padded<Lanes> error_;  // one row of the states
  double weight_ = 0.0;        // of a row
  double *const rest_, *const multiplier_, *const ahead_, *const of_magnet_, *const strength_;
  double *const errors_, *const turned_;

 public:
  BodyFilter(const magloc_pose_track &p, Workspace &room)
      : p_(p),
        channels_(*p.fit->channels, p.fit->signals, room),
        fit_(*p.fit, channels_, room),
        q_(p.n_magnet_errors),
        a_(p.n_sensor_errors),
        p_states_(pose + q_),
        d_(p_states_ + a_),
        n_(d_ + rates),
        c_(p.fit->channels->n_channels),
        P_(room, n_, n_),
        H_(room, c_, n_),
        HP_(room, c_, n_),
        of_sensors_(room, c_, n_),
        S_(room, c_, c_ + 1),
        error_(room, 1, n_),
        rest_(room.take<double>(c_)),
        multiplier_(room.take<double>(c_)),
        ahead_(room.take<double>(c_)),
        of_magnet_(room.take<double>(c_)),
        strength_(room.take<double>(p.fit->n_magnets)),
        errors_(room.take<double>(q_)),
        turned_(room.take<double>(p_states_)) {}

  void follow(int64_t row) {
    if (!p_.progress[1]) return;
    P_.load(p_.covariance, n_, n_);
    predict(p_.steps + 10 * row, a_ ? p_.lasting + a_ * row : nullptr, a_ ? p_.added + a_ * row : nullptr);
    channels_.load(0, p_.fit->row[row]);
    const bool agrees = update(row);
    p_.status[row] = agrees ? 1 : 2;
    p_.progress[0] = agrees ? 0 : p_.progress[0] + 1;
    if (p_.progress[0] >= p_.most_contradictions) p_.progress[1] = 0;
    __builtin_memcpy(p_.poses + 12 * row, p_.pose, 12 * sizeof(double));
    __builtin_memcpy(p_.all_rates + rates * row, p_.rates, rates * sizeof(double));
    P_.store(p_.covariance, n_, n_);
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
    for (int64_t e = 0; e < a_; ++e) p_.errors[q_ + e] *= lasting[e];
    // F P F^T: rows of P, then its columns.
    propagate([this](int64_t i, int64_t j) -> double & { return P_[i][j]; }, steps, turn, lasting);
    propagate([this](int64_t i, int64_t j) -> double & { return P_[j][i]; }, steps, turn, lasting);
    for (int64_t i = 0; i < n_; ++i)
      for (int64_t j = 0; j < i; ++j) P_[i][j] = P_[j][i];
    for (int i = 0; i < 3; ++i) {
      add_noise(i, d_ + i, of_x + 2);
      add_noise(3 + i, d_ + 3 + i, of_turn + 2);
    }
    for (int64_t e = 0; e < a_; ++e) P_[p_states_ + e][p_states_ + e] += added[e] * added[e];
  }
  void add_noise(int64_t i, int64_t rate, const double *root) {
    P_[i][i] += root[0] * root[0];
    P_[i][rate] += root[0] * root[1];
    P_[rate][i] = P_[i][rate];
    P_[rate][rate] += root[1] * root[1] + root[2] * root[2];
  }
  template <class At>
  void propagate(At at, const double *steps, const double (&turn)[3], const double *lasting) {
    for (int64_t j = 0; j < n_; ++j) {
      double rotation[3], before[3];
      for (int i = 0; i < 3; ++i) before[i] = at(3 + i, j);
      cross(before, turn, rotation);
      for (int i = 0; i < 3; ++i) {
        double &velocity = at(d_ + i, j), &rate = at(d_ + 3 + i, j);
        at(i, j) += steps[0] * velocity;
        at(3 + i, j) += rotation[i] + steps[5] * rate;
        velocity *= steps[1], rate *= steps[6];
      }
    }
    for (int64_t e = 0; e < a_; ++e)
      for (int64_t j = 0; j < n_ && lasting[e] != 1.0; ++j) at(p_states_ + e, j) *= lasting[e];
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

  // Linearise about a state: columns of H by pose and magnets, and the residual about the predicted sensors' errors.
  void linearise(const PoseState<double> &trial, int64_t row) {
    PoseState<double> state = trial;
    for (int64_t k = 0; k < p_.fit->n_magnets; ++k) {
      strength_[k] = 1.0;
      for (int64_t e = 0; e < q_; ++e) strength_[k] += p_.magnet_errors[q_ * k + e] * errors_[e];
    }
    fit_.linearise(channels_, state, strength_);
    const bool is_first = !(weight_ > 0.0);
    if (is_first) weight_ = weight_of_row(row, state.nearest);
    for (int64_t c = 0; c < c_; ++c) {
      const double *const by_pose = fit_.columns() + 6 * c, *const r = by_pose + 3;
      rest_[c] = weight_ * fit_.residual()[c];
      for (int j = 0; j < 3; ++j) {
        H_[c][j] = weight_ * by_pose[j];
        H_[c][3 + j] = weight_ * (r[0] * state.R[0][j] + r[1] * state.R[1][j] + r[2] * state.R[2][j]);
      }
      for (int64_t e = 0; e < q_; ++e) H_[c][pose + e] = 0.0;
    }
    for (int64_t k = 0; q_ && k < p_.fit->n_magnets; ++k) {
      fit_.read_magnet(channels_, state, k, strength_[k], of_magnet_);
      for (int64_t e = 0; e < q_; ++e) {
        const double factor = weight_ * p_.magnet_errors[q_ * k + e];
        for (int64_t c = 0; c < c_; ++c) H_[c][pose + e] += factor * of_magnet_[c];
      }
    }
    if (is_first) fill_sensor_errors(row);
    for (int64_t c = 0; c < c_; ++c)
      for (int64_t e = 0; e < a_; ++e) rest_[c] -= H_[c][p_states_ + e] * p_.errors[q_ + e];
  }
  void fill_sensor_errors(int64_t row) {
    for (int64_t c = 0; c < c_; ++c) {
      for (int64_t e = 0; e < a_; ++e) H_[c][p_states_ + e] = weight_ * p_.sensor_errors[c_ * (a_ * row + e) + c];
      for (int64_t e = d_; e < H_.width() * n_lanes<Lanes>; ++e) H_[c][e] = 0.0;
      set_rows(of_sensors_.lanes(c), {H_[c] + p_states_}, P_.from(p_states_), a_);
    }
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
    for (int i = 0; i < 3; ++i) state.x[i] = p_.pose[i];
    for (int i = 0; i < 9; ++i) state.R[i / 3][i % 3] = p_.pose[3 + i];
    for (int64_t e = 0; e < q_; ++e) errors_[e] = p_.errors[e];
    for (int64_t i = 0; i < p_states_; ++i) turned_[i] = 0.0;
    for (int64_t c = 0; c < c_; ++c) multiplier_[c] = 0.0;
    double square = infinity;
    weight_ = 0.0;
    for (int64_t iteration = 0; iteration < p_.max_iterations; ++iteration) {
      linearise(state, row);
      const double promised = solve_row(square);
      if (!(promised < infinity)) return false;
      double *const error = error_[0];
      double turn[3];
      for (int i = 0; i < 3; ++i) {
        state.x[i] += error[i] - turned_[i];
        turn[i] = error[3 + i] - turned_[3 + i];
      }
      turn_body(&state.R[0][0], turn);
      for (int64_t e = 0; e < q_; ++e) errors_[e] = p_.errors[e] + error[pose + e];
      // The rotation from the prediction, of two rotations in succession to the second order.
      const double *const before = turned_ + 3;
      const double mixed[3] = {before[1] * turn[2] - before[2] * turn[1], before[2] * turn[0] - before[0] * turn[2],
                               before[0] * turn[1] - before[1] * turn[0]};
      for (int64_t i = 0; i < p_states_; ++i) turned_[i] = error[i];
      for (int i = 0; i < 3; ++i) turned_[3 + i] += 0.5 * mixed[i];
      if (promised < p_.tolerance) break;
    }
    p_.nis[row] = square;
    if (!(square < p_.nis_limits[row])) return false;
    for (int i = 0; i < 3; ++i) p_.pose[i] = state.x[i];
    for (int i = 0; i < 9; ++i) p_.pose[3 + i] = state.R[i / 3][i % 3];
    for (int64_t e = 0; e < q_ + a_; ++e) p_.errors[e] += error_[0][pose + e];
    for (int64_t i = 0; i < rates; ++i) p_.rates[i] += error_[0][d_ + i];
    solve_transposed(S_, c_, HP_);
    for (int64_t i = 0; i < n_; ++i) add_rows(P_.lanes(i), -HP_.column(i), HP_, c_);
    return true;
  }

  // Fill the error of the prediction that the readings show, and its normalised square. Return the square of the step
  // from the last one, in standard deviations.
  double solve_row(double &square) {
    for (int64_t c = 0; c < c_; ++c) {
      __builtin_memcpy(HP_[c], of_sensors_[c], HP_.width() * sizeof(Lanes));
      add_rows(HP_.lanes(c), {H_[c]}, P_, p_states_);
    }
    double promised = 0.0;
    for (int64_t c = 0; c < c_; ++c) {
      double innovation = rest_[c];
      for (int64_t i = 0; i < p_states_; ++i) innovation += H_[c][i] * turned_[i];
      S_[c][c_] = ahead_[c] = innovation;
      for (int64_t j = 0; j <= c; ++j)
        S_[j][c] = S_[c][j] = double(c == j) + dot(H_.lanes(c), HP_.lanes(j), H_.width());
    }
    for (int64_t c = 0; c < c_; ++c) {
      for (int64_t j = 0; j < c_; ++j) ahead_[c] -= S_[c][j] * multiplier_[j];
      promised += ahead_[c] * ahead_[c];
    }
    factorise(S_, c_);
    solve_transposed(S_, c_, ahead_);
    square = 0.0;
    for (int64_t c = 0; c < c_; ++c) {
      multiplier_[c] = S_[c][c_];
      square += multiplier_[c] * multiplier_[c];
      promised -= ahead_[c] * ahead_[c];
    }
    solve(S_, c_, multiplier_);
    set_rows(error_.lanes(0), {multiplier_}, HP_, c_);
    return promised;
  }
};
MAGLOC_END
