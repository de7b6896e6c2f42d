// Kalman filter of the heading of an inertial unit with a magnetometer, and its smoother. adcs/complementary/heading.py
// explains the model; matrices are small, so that their products are written out as loops.
#pragma once
#include "adcs/rotation.hpp"
#include "magloc/elementary.hpp"
#include "magloc/kernel.hpp"

MAGLOC_BEGIN
// Where the state's parts begin: the heading, the gyro's drift, scales of its axes, the sensor's offset, and the slow
// and the quick variation of the room's field, in the frame whose heading is zero.
enum HeadingState { state_heading, state_drift, state_scale, state_offset = 5, state_room = 8, state_local = 11 };
constexpr int n_heading = 14;
constexpr int told_states[4] = {state_heading, state_offset, state_offset + 1, state_offset + 2};
// Beyond this variance of the heading the field tells it alone: it is too far for a linear update.
constexpr double lost_variance = 0.25;

// What a block's field says: innovation with its covariance S, and what a Kalman update needs.
struct FieldInnovation {
  double H[3][n_heading], HP[3][n_heading], gain[3][n_heading], innovation[3], S_inverse[3][3], nis, determinant;
  double turned;  // by which a lost heading was turned to the field

  void invert(const double (&S)[3][3]) {
    double cofactors[3][3];
    for (int a = 0; a < 3; ++a) cross(S[(a + 1) % 3], S[(a + 2) % 3], cofactors[a]);
    determinant = dot(S[0], cofactors[0]);
    nis = 0.0;
    for (int a = 0; a < 3; ++a)
      for (int b = 0; b < 3; ++b) {
        S_inverse[a][b] = cofactors[a][b] / determinant;
        nis += innovation[a] * S_inverse[a][b] * innovation[b];
      }
  }
};

struct HeadingFilter {
  double x[n_heading], P[n_heading][n_heading];

  // To block i. The heading grows by the drift and the scales times turn; all but the heading decay to a part that is
  // kept.
  void predict(const magloc_heading &p, const magloc_heading_room &room, int64_t i) {
    const double *turn = p.turn + 4 * i, *kept = room.kept + n_heading * i, *growth = room.growth + n_heading * i;
    double row[n_heading];
    for (int j = 0; j < n_heading; ++j) row[j] = P[0][j];
    for (int k = 0; k < 4; ++k) {
      x[0] += turn[k] * x[1 + k];
      for (int j = 0; j < n_heading; ++j) row[j] += turn[k] * P[1 + k][j];
    }
    for (int k = 0; k < 4; ++k) row[0] += turn[k] * row[1 + k];
    for (int j = 0; j < n_heading; ++j) P[0][j] = P[j][0] = row[j];
    for (int j = 0; j < n_heading; ++j) {
      x[j] *= kept[j];
      for (int k = 0; k < n_heading; ++k) P[j][k] *= kept[j] * kept[k];
      P[j][j] += growth[j];
    }
  }

  // Compare the field of block i with that which is expected; a heading that is lost is first turned to the field.
  void compare(const magloc_heading &p, int64_t i, FieldInnovation &update) {
    const double *measured = p.field + 3 * i,
                 *level = p.level + 9 * i;  // level: matrix to the level frame from the body
    const double field[3] = {p.start_field[0] + x[state_room] + x[state_local],
                             p.start_field[1] + x[state_room + 1] + x[state_local + 1],
                             p.start_field[2] + x[state_room + 2] + x[state_local + 2]};
    double seen[3];  // without the sensor's offset
    for (int a = 0; a < 3; ++a) {
      seen[a] = measured[a];
      for (int k = 0; k < 3; ++k) seen[a] -= level[3 * a + k] * x[state_offset + k];
    }
    update.turned = 0.0;
    if (P[0][0] > lost_variance) update.turned = arc_tangent(seen[1], seen[0]) - arc_tangent(field[1], field[0]) - x[0];
    x[0] += update.turned;
    const Quaternion<double> half = exponential({{0.0, 0.0, x[0]}});
    const double half_c = half.scalar, half_s = half.vector[2];
    const double c = half_c * half_c - half_s * half_s, s = 2.0 * half_c * half_s;
    const double expected[3] = {c * field[0] - s * field[1], s * field[0] + c * field[1], field[2]};
    double (&H)[3][n_heading] = update.H;
    for (auto &row : H)
      for (double &value : row) value = 0.0;
    H[0][state_heading] = -expected[1], H[1][state_heading] = expected[0];
    for (int begin = state_room; begin <= state_local; begin += 3) {
      H[0][begin] = c, H[0][begin + 1] = -s;
      H[1][begin] = s, H[1][begin + 1] = c;
      H[2][begin + 2] = 1.0;
    }
    for (int a = 0; a < 3; ++a) {
      update.innovation[a] = seen[a] - expected[a];
      for (int k = 0; k < 3; ++k) H[a][state_offset + k] = level[3 * a + k];
    }
    double S[3][3];
    for (int a = 0; a < 3; ++a) {
      for (double &value : update.HP[a]) value = 0.0;
      for (int k = 0; k < n_heading; ++k)
        for (int j = 0; j < n_heading; ++j) update.HP[a][j] += H[a][k] * P[k][j];
    }
    for (int a = 0; a < 3; ++a)
      for (int b = 0; b < 3; ++b) {
        S[a][b] = a == b ? p.noise * p.noise : 0.0;
        for (int j = 0; j < n_heading; ++j) S[a][b] += update.HP[a][j] * H[b][j];
      }
    update.invert(S);
  }

  void correct(FieldInnovation &update) {
    const double (&HP)[3][n_heading] = update.HP, (&nu)[3] = update.innovation;
    double (&gain)[3][n_heading] = update.gain;
    for (int a = 0; a < 3; ++a)
      for (int j = 0; j < n_heading; ++j)
        gain[a][j] =
            update.S_inverse[a][0] * HP[0][j] + update.S_inverse[a][1] * HP[1][j] + update.S_inverse[a][2] * HP[2][j];
    for (int j = 0; j < n_heading; ++j) {
      x[j] += gain[0][j] * nu[0] + gain[1][j] * nu[1] + gain[2][j] * nu[2];
      for (int k = 0; k < n_heading; ++k)
        P[j][k] -= HP[0][j] * gain[0][k] + HP[1][j] * gain[1][k] + HP[2][j] * gain[2][k];
    }
    for (int j = 0; j < n_heading; ++j)
      for (int k = 0; k < j; ++k) P[j][k] = P[k][j];
  }

  void grow(int first, double variance) {
    for (int k = first; k < first + 3; ++k) P[k][k] += variance;
  }
};

// The filter over all blocks. A block is left out where it, or the mean of the last ones, contradicts the state. When
// that goes on for a while, three others run beside the filter from there: one whose sensor's offset changed, one whose
// room's field did, and one in whose room it is another one everywhere. The first takes over when the blocks speak for
// it against both others, which only turns can make them do. All end when the filter agrees with its blocks again.
class HeadingRun {
  enum Explanation { offset_changed, room_changed, room_differs, n_explanations };
  HeadingFilter filter_, others_[n_explanations];
  double log_likelihoods_[n_explanations];
  double mean_nis_, wrong_s_, right_s_, trial_s_;  // trial: time since the others began, negative while there are none
  int64_t began_;
  FieldInnovation update_;

 public:
  void start(const magloc_heading &p) {
    for (int j = 0; j < n_heading; ++j) {
      filter_.x[j] = p.x[j];
      for (int k = 0; k < n_heading; ++k) filter_.P[j][k] = p.P[n_heading * j + k];
    }
    mean_nis_ = wrong_s_ = right_s_ = 0.0;
    trial_s_ = -1.0;
  }

  void step(const magloc_heading &p, int64_t i) {
    const HeadingFilter before = filter_;
    filter_.predict(p, *p.room, i);
    filter_.compare(p, i, update_);
    const double nis = update_.nis, largest = 2.0 * p.gate;
    mean_nis_ = p.memory * mean_nis_ + (1.0 - p.memory) * (largest < nis ? largest : nis) / 3.0;
    // A heading that was turned to the field agrees with any direction: length and dip have to be right.
    const double lost_gate = 3.0 * p.mean_nis;
    const double gate = filter_.P[0][0] > lost_variance && lost_gate < p.gate ? lost_gate : p.gate;
    if (nis <= gate && mean_nis_ <= p.mean_nis) {
      filter_.correct(update_);
      p.used[i] = p.known[i] = 1;
      right_s_ += p.dt[i];
      if (right_s_ >= p.patience) wrong_s_ = 0.0;
    } else {
      wrong_s_ += p.dt[i];
      right_s_ = 0.0;
    }
    if (trial_s_ < 0.0 && wrong_s_ > p.patience && p.evidence < infinity) begin_trial(p, i, before);
    if (trial_s_ >= 0.0) try_others(p, i);
    for (int k = 0; k < 4; ++k) {
      p.told[4 * i + k] = filter_.x[told_states[k]];
      p.variances[4 * i + k] = filter_.P[told_states[k]][told_states[k]];
    }
  }

 private:
  void begin_trial(const magloc_heading &p, int64_t i, const HeadingFilter &before) {
    trial_s_ = 0.0, began_ = i;
    for (int k = 0; k < n_explanations; ++k) {
      others_[k] = before;
      others_[k].grow(k == offset_changed ? state_offset : state_room, p.jump * p.jump);
      log_likelihoods_[k] = 0.0;
    }
  }
  void try_others(const magloc_heading &p, int64_t i) {
    trial_s_ += p.dt[i];
    for (int k = 0; k < n_explanations; ++k) {
      others_[k].predict(p, k == room_differs ? *p.other_room : *p.room, i);
      others_[k].compare(p, i, update_);
      others_[k].correct(update_);
      // Any constant factor of the determinant does; no reading counts for more than 50.
      const double log_likelihood = -0.5 * (update_.nis + logarithm(1e36 * update_.determinant));
      log_likelihoods_[k] += log_likelihood < -50.0 ? -50.0 : log_likelihood;
    }
    const double odds =
        log_likelihoods_[offset_changed] - maximum(log_likelihoods_[room_changed], log_likelihoods_[room_differs]);
    if (right_s_ > 3.0 * p.patience) {
      trial_s_ = -1.0, wrong_s_ = 0.0;
    } else if (odds > p.evidence && trial_s_ > p.patience) {
      filter_ = others_[offset_changed];
      for (int64_t k = began_; k <= i; ++k) p.known[k] = k == began_ ? 2 : 1;
      mean_nis_ = wrong_s_ = 0.0, trial_s_ = -1.0;
    } else if (odds < -__builtin_fabs(p.evidence) || trial_s_ > p.trial) {
      trial_s_ = -1.0;
    }
  }
};

// Smoother of the blocks that are used in hindsight, after Bryson and Frazier in Bierman's form: what later blocks say
// of a state is a score and an information matrix that are carried backwards, so that nothing larger than an
// innovation's covariance is inverted.
class HeadingSmoother {
  HeadingFilter filter_;
  double score_[n_heading], information_[n_heading][n_heading];
  FieldInnovation update_;

 public:
  void start(const magloc_heading &p) {
    for (int j = 0; j < n_heading; ++j) {
      filter_.x[j] = p.x[j], score_[j] = 0.0;
      for (int k = 0; k < n_heading; ++k) filter_.P[j][k] = p.P[n_heading * j + k], information_[j][k] = 0.0;
    }
  }

  void forward(const magloc_heading &p, int64_t i, HeadingFilter *filtered) {
    advance(p, i);
    filtered[i] = filter_;
    // Blocks before a heading was found again are turned with it.
    if (p.known[i] > 0 && update_.turned != 0.0)
      for (int64_t k = i - 1; k >= 0 && filtered[k].P[0][0] > lost_variance; --k) filtered[k].x[0] += update_.turned;
  }

  void backward(const magloc_heading &p, int64_t i, const HeadingFilter *filtered) {
    for (int k = 0; k < 4; ++k) {
      const int j = told_states[k];
      const double *row = filtered[i].P[j];
      double x = filtered[i].x[j], variance = row[j];
      for (int a = 0; a < n_heading; ++a) {
        double information = 0.0;
        for (int b = 0; b < n_heading; ++b) information += information_[a][b] * row[b];
        x -= row[a] * score_[a];
        variance -= row[a] * information;
      }
      p.told[4 * i + k] = x;
      p.variances[4 * i + k] = variance;
    }
    if (i == 0) return;
    filter_ = filtered[i - 1];
    advance(p, i);
    if (p.known[i] > 0) add_reading();
    back_over_step(p.turn + 4 * i, p.room->kept + n_heading * i);
  }

 private:
  void advance(const magloc_heading &p, int64_t i) {
    if (p.known[i] == 2) filter_.grow(state_offset, p.jump * p.jump);
    filter_.predict(p, *p.room, i);
    if (p.known[i] == 0) return;
    filter_.compare(p, i, update_);
    filter_.correct(update_);
  }
  // (I - K H)^T L (I - K H) + H^T S^-1 H = L + H^T M + M^T H, with M = (S^-1 + K^T L K) H / 2 - K^T L.
  void add_reading() {
    const double (&H)[3][n_heading] = update_.H, (&K)[3][n_heading] = update_.gain;
    double M[3][n_heading] = {}, of_reading[3], halves[3][3];
    for (int a = 0; a < 3; ++a) {
      of_reading[a] = dot(update_.S_inverse[a], update_.innovation);
      for (int k = 0; k < n_heading; ++k) {
        of_reading[a] += K[a][k] * score_[k];
        for (int j = 0; j < n_heading; ++j) M[a][j] -= K[a][k] * information_[k][j];
      }
    }
    for (int a = 0; a < 3; ++a)
      for (int b = 0; b < 3; ++b) {
        halves[a][b] = 0.5 * update_.S_inverse[a][b];
        for (int k = 0; k < n_heading; ++k) halves[a][b] -= 0.5 * M[a][k] * K[b][k];
      }
    for (int a = 0; a < 3; ++a)
      for (int k = 0; k < n_heading; ++k)
        M[a][k] += halves[a][0] * H[0][k] + halves[a][1] * H[1][k] + halves[a][2] * H[2][k];
    for (int j = 0; j < n_heading; ++j)
      for (int a = 0; a < 3; ++a) {
        score_[j] -= H[a][j] * of_reading[a];
        for (int k = 0; k < n_heading; ++k) information_[j][k] += H[a][j] * M[a][k] + M[a][j] * H[a][k];
      }
  }
  // Phi^T L Phi: each state, times what is kept of it, and times what the heading gets of it.
  void back_over_step(const double *turn, const double *kept) {
    double with_turn[n_heading] = {};
    for (int k = 0; k < 4; ++k) with_turn[1 + k] = turn[k];
    for (int k = 1; k < n_heading; ++k) {
      score_[k] = kept[k] * score_[k] + with_turn[k] * score_[0];
      for (int j = 0; j < n_heading; ++j)
        information_[k][j] = kept[k] * information_[k][j] + with_turn[k] * information_[0][j];
    }
    for (auto &row : information_)
      for (int k = 1; k < n_heading; ++k) row[k] = kept[k] * row[k] + with_turn[k] * row[0];
  }
};
MAGLOC_END
