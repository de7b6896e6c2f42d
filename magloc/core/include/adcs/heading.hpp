// Kalman filter of the heading of an inertial unit with a magnetometer, and its smoother. adcs/complementary/heading.py
// explains the model; matrices are small, so that their products are written out as loops.
#pragma once
#include "adcs/rotation.hpp"
#include "magloc.h"
#include "magloc/elementary.hpp"

MAGLOC_BEGIN
// Where the state's parts begin: the heading, the gyro's drift, scales of its axes, the sensor's offset, and the slow
// and the quick variation of the room's field, in the frame whose heading is zero.
enum HeadingState { state_heading, state_drift, state_scale, state_offset = 5, state_room = 8, state_local = 11 };
constexpr int n_heading = 14;
constexpr int told_states[4] = {state_heading, state_offset, state_offset + 1, state_offset + 2};
// Beyond this variance of the heading the field tells it alone: it is too far for a linear update.
constexpr double lost_variance = 0.25;

// How a room's field changes: the part of each state that remains after a block, and the growth of its variance.
template <class Real>
struct RoomStep {
  const Real *kept, *growth;  // (n_heading)
};

// Means over a block of time. Fields have any unit.
template <class Real>
struct HeadingBlock {
  const Real *field;                // (3,), in the frame that is level and whose heading is the gyro's
  const Real *level;                // (3, 3), to that frame from the body
  const Real *turn;                 // (4,), what drift and scales add to the heading
  Real dt;                          // s
  RoomStep<Real> room, other_room;  // the latter where the field is another one everywhere
};

// Noise and limits; magloc_heading explains them.
template <class Real>
struct HeadingRules {
  Real start_field[3], noise, gate, mean_nis, memory, patience, trial, jump, evidence;
  Real per_field;  // the field's unit over 1 uT
};
inline HeadingRules<double> rules_of(const magloc_heading &p) {
  return {{p.start_field[0], p.start_field[1], p.start_field[2]},
          p.noise,
          p.gate,
          p.mean_nis,
          p.memory,
          p.patience,
          p.trial,
          p.jump,
          p.evidence,
          1e6};
}
inline HeadingBlock<double> block_of(const magloc_heading &p, int64_t i) {
  const int64_t row = n_heading * i;
  return {p.field + 3 * i,
          p.level + 9 * i,
          p.turn + 4 * i,
          p.dt[i],
          {p.room->kept + row, p.room->growth + row},
          {p.other_room->kept + row, p.other_room->growth + row}};
}

// What a block's field says: innovation with its covariance S, and what a Kalman update needs.
template <class Real>
struct FieldInnovation {
  Real H[3][n_heading], HP[3][n_heading], gain[3][n_heading], innovation[3], S_inverse[3][3], nis, determinant;
  Real turned;  // by which a lost heading was turned to the field

  void invert(const Real (&S)[3][3]) {
    Real cofactors[3][3];
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

template <class Real>
struct HeadingFilter {
  Real x[n_heading], P[n_heading][n_heading];

  // To the next block. The heading grows by the drift and the scales times turn; all but the heading decay to a part
  // that is kept.
  void predict(const Real *turn, const RoomStep<Real> &room) {
    const Real *kept = room.kept, *growth = room.growth;
    Real row[n_heading];
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

  // Compare the field of a block with that which is expected; a heading that is lost is first turned to the field.
  void compare(const HeadingRules<Real> &p, const HeadingBlock<Real> &block, FieldInnovation<Real> &update) {
    const Real *measured = block.field, *level = block.level;
    const Real field[3] = {p.start_field[0] + x[state_room] + x[state_local],
                           p.start_field[1] + x[state_room + 1] + x[state_local + 1],
                           p.start_field[2] + x[state_room + 2] + x[state_local + 2]};
    Real seen[3];  // without the sensor's offset
    for (int a = 0; a < 3; ++a) {
      seen[a] = measured[a];
      for (int k = 0; k < 3; ++k) seen[a] -= level[3 * a + k] * x[state_offset + k];
    }
    update.turned = 0.0;
    if (P[0][0] > lost_variance)
      update.turned = Real(arc_tangent(seen[1], seen[0]) - arc_tangent(field[1], field[0]) - x[0]);
    x[0] += update.turned;
    const Quaternion<double> half = exponential(Vector<double>{{0.0, 0.0, x[0]}});
    const Real half_c = Real(half.scalar), half_s = Real(half.vector[2]);
    const Real c = half_c * half_c - half_s * half_s, s = 2 * half_c * half_s;
    const Real expected[3] = {c * field[0] - s * field[1], s * field[0] + c * field[1], field[2]};
    Real(&H)[3][n_heading] = update.H;
    for (auto &row : H)
      for (Real &value : row) value = 0.0;
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
    Real S[3][3];
    for (int a = 0; a < 3; ++a) {
      for (Real &value : update.HP[a]) value = 0.0;
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

  void correct(FieldInnovation<Real> &update) {
    const Real(&HP)[3][n_heading] = update.HP, (&nu)[3] = update.innovation;
    Real(&gain)[3][n_heading] = update.gain;
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

  // Begin again to estimate a state.
  void forget(int state, Real variance) {
    x[state] = 0;
    for (int k = 0; k < n_heading; ++k) P[state][k] = P[k][state] = 0;
    P[state][state] = variance;
  }
  void grow(int first, Real variance) {
    for (int k = first; k < first + 3; ++k) P[k][k] += variance;
  }
};

// The filter over all blocks. A block is rejected where it, or the mean of the last ones, contradicts the state. When
// that goes on for a while, three others run beside the filter from there: one whose sensor's offset changed, one whose
// room's field did, and one in whose room it is another one everywhere. The first takes over when the blocks speak for
// it against both others, which only turns can make them do. All end when the filter agrees with its blocks again.
template <class Real>
class HeadingRun {
  enum Explanation { offset_changed, room_changed, room_differs, n_explanations };
  HeadingFilter<Real> filter_, others_[n_explanations];
  Real log_likelihoods_[n_explanations];
  Real mean_nis_, wrong_s_, right_s_, trial_s_;  // trial: time since the others began, negative while there are none
  int32_t tried_;                                // blocks since then

 public:
  const HeadingFilter<Real> &filter() const { return filter_; }
  HeadingFilter<Real> &filter() { return filter_; }
  void start() {
    mean_nis_ = wrong_s_ = right_s_ = 0;
    trial_s_ = -1, tried_ = 0;
  }

  struct Outcome {
    bool is_used;
    int32_t accepted;  // number of the last blocks of which the offset is found to be another one
  };
  Outcome step(const HeadingRules<Real> &p, const HeadingBlock<Real> &block) {
    FieldInnovation<Real> update;
    if (trial_s_ < 0) others_[0] = filter_;  // where a trial would begin
    filter_.predict(block.turn, block.room);
    filter_.compare(p, block, update);
    const Real nis = update.nis, largest = 2 * p.gate;
    mean_nis_ = p.memory * mean_nis_ + (1 - p.memory) * (largest < nis ? largest : nis) / 3;
    // A heading that was turned to the field agrees with any direction: length and dip have to be right.
    const Real lost_gate = 3 * p.mean_nis;
    const Real gate = filter_.P[0][0] > lost_variance && lost_gate < p.gate ? lost_gate : p.gate;
    Outcome outcome = {nis <= gate && mean_nis_ <= p.mean_nis, 0};
    if (outcome.is_used) {
      filter_.correct(update);
      right_s_ += block.dt;
      if (right_s_ >= p.patience) wrong_s_ = 0;
    } else {
      wrong_s_ += block.dt;
      right_s_ = 0;
    }
    if (trial_s_ < 0 && wrong_s_ > p.patience && p.evidence < infinity) begin_trial(p);
    if (trial_s_ >= 0) outcome.accepted = try_others(p, block, update);
    return outcome;
  }

 private:
  void begin_trial(const HeadingRules<Real> &p) {
    trial_s_ = 0, tried_ = 0;
    for (int k = 1; k < n_explanations; ++k) others_[k] = others_[0];
    for (int k = 0; k < n_explanations; ++k) {
      others_[k].grow(k == offset_changed ? state_offset : state_room, p.jump * p.jump);
      log_likelihoods_[k] = 0;
    }
  }
  int32_t try_others(const HeadingRules<Real> &p, const HeadingBlock<Real> &block, FieldInnovation<Real> &update) {
    trial_s_ += block.dt, ++tried_;
    const double unit = p.per_field, scale = unit * unit * unit * unit * unit * unit;
    for (int k = 0; k < n_explanations; ++k) {
      others_[k].predict(block.turn, k == room_differs ? block.other_room : block.room);
      others_[k].compare(p, block, update);
      others_[k].correct(update);
      // Any constant factor of the determinant does; no reading counts for more than 50.
      const Real log_likelihood = Real(-0.5 * (update.nis + logarithm(scale * update.determinant)));
      log_likelihoods_[k] += log_likelihood < -50 ? Real(-50) : log_likelihood;
    }
    const Real room = log_likelihoods_[room_changed], other = log_likelihoods_[room_differs];
    const Real odds = log_likelihoods_[offset_changed] - (room > other ? room : other);
    if (right_s_ > 3 * p.patience) {
      trial_s_ = -1, wrong_s_ = 0;
    } else if (odds > p.evidence && trial_s_ > p.patience) {
      filter_ = others_[offset_changed];
      mean_nis_ = wrong_s_ = 0, trial_s_ = -1;
      return tried_;
    } else if (odds < (p.evidence < 0 ? p.evidence : -p.evidence) || trial_s_ > p.trial) {
      trial_s_ = -1;
    }
    return 0;
  }
};

// Smoother of the blocks that are used in hindsight, after Bryson and Frazier in Bierman's form: what later blocks say
// of a state is a score and an information matrix that are carried backwards, so that nothing larger than an
// innovation's covariance is inverted.
class HeadingSmoother {
  HeadingFilter<double> filter_;
  double score_[n_heading], information_[n_heading][n_heading];
  FieldInnovation<double> update_;

 public:
  void start(const magloc_heading &p) {
    for (int j = 0; j < n_heading; ++j) {
      filter_.x[j] = p.x[j], score_[j] = 0.0;
      for (int k = 0; k < n_heading; ++k) filter_.P[j][k] = p.P[n_heading * j + k], information_[j][k] = 0.0;
    }
  }

  void forward(const magloc_heading &p, int64_t i, HeadingFilter<double> *filtered) {
    advance(p, i);
    filtered[i] = filter_;
    // Blocks before a heading was found again are turned with it.
    if (p.known[i] > 0 && update_.turned != 0.0)
      for (int64_t k = i - 1; k >= 0 && filtered[k].P[0][0] > lost_variance; --k) filtered[k].x[0] += update_.turned;
  }

  void backward(const magloc_heading &p, int64_t i, const HeadingFilter<double> *filtered) {
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
    const HeadingBlock<double> block = block_of(p, i);
    filter_.predict(block.turn, block.room);
    if (p.known[i] == 0) return;
    filter_.compare(rules_of(p), block, update_);
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
